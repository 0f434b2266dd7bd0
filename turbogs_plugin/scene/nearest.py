"""Distances to the nearest neighbours of every point of a cloud, exact, without a k-d tree library."""

from __future__ import annotations

import torch
from torch import Tensor

BUCKET_SIZE = 64
CANDIDATE_BLOCK = 8192
"""Candidate points compared at a time with one bucket, so that memory is bounded."""


def mean_neighbor_distances(points: Tensor, neighbors: int) -> Tensor:
    """[M]: mean distance of each point to its `neighbors` nearest other points (fewer, if the cloud has fewer).

    Points are cut into compact buckets. A bucket's points are compared among themselves first, which bounds how far
    their neighbours can be; then with every bucket whose bounding box comes nearer than that bound.

    Args:
        points: [M, 3] float, finite, M >= 2, on any device. Points may coincide.
        neighbors: at least 1.
    """
    neighbors = min(neighbors, len(points) - 1)
    order, starts = _buckets(points, max(BUCKET_SIZE, neighbors + 1))
    ordered = points[order]
    buckets = [ordered[start:end] for start, end in zip(starts, starts[1:], strict=False)]
    lows = torch.stack([bucket.amin(dim=0) for bucket in buckets])  # [B, 3]
    highs = torch.stack([bucket.amax(dim=0) for bucket in buckets])  # [B, 3]
    means = torch.empty_like(ordered[:, 0])
    for number, bucket in enumerate(buckets):
        nearest = _pairwise(bucket, bucket).fill_diagonal_(torch.inf).topk(neighbors, largest=False).values
        gaps = (lows - highs[number]).clamp(min=0).maximum((lows[number] - highs).clamp(min=0))  # [B, 3]
        near = gaps.square().sum(dim=1) <= nearest.max()
        near[number] = False
        candidates = torch.cat([bucket[:0], *(buckets[other] for other in near.nonzero()[:, 0].tolist())])
        for block in candidates.split(CANDIDATE_BLOCK):
            merged = torch.cat([nearest, _pairwise(bucket, block)], dim=1)
            nearest = merged.topk(neighbors, largest=False).values
        means[starts[number] : starts[number + 1]] = nearest.sqrt().mean(dim=1)
    result = torch.empty_like(means)
    result[order] = means
    return result


def _pairwise(a: Tensor, b: Tensor) -> Tensor:
    """[A, B] squared distances, from differences: exact for near points, unlike the expanded square."""
    return (a[:, None, :] - b[None, :, :]).square_().sum(dim=-1)


def _buckets(points: Tensor, size: int) -> tuple[Tensor, list[int]]:
    """An order of the points [M] int64 and the start of each bucket in it: recursive halves along the longest side."""
    parts = [torch.arange(len(points), device=points.device)]
    while max(len(part) for part in parts) > 2 * size:
        halves = []
        for part in parts:
            members = points[part]
            axis = int((members.amax(dim=0) - members.amin(dim=0)).argmax())
            sorted_part = part[members[:, axis].argsort(stable=True)]
            halves += [sorted_part[: len(part) // 2], sorted_part[len(part) // 2 :]]
        parts = halves
    starts = [0]
    for part in parts:
        starts.append(starts[-1] + len(part))
    return torch.cat(parts), starts
