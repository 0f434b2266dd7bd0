"""Distances to the nearest neighbours of every point of a cloud, exact, without a k-d tree library."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

BUCKET_SIZE = 64
BUCKETS_AT_ONCE = 32
"""How many buckets are compared with one at a time: it bounds memory, and near ones tighten the bound for far ones."""


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
    buckets = [ordered[start:end] for start, end in itertools.pairwise(starts)]
    lows = torch.stack([bucket.amin(dim=0) for bucket in buckets])  # [B, 3]
    highs = torch.stack([bucket.amax(dim=0) for bucket in buckets])  # [B, 3]
    means = torch.empty_like(ordered[:, 0])
    for number, bucket in enumerate(buckets):
        nearest = _pairwise(bucket, bucket).fill_diagonal_(torch.inf).topk(neighbors, largest=False).values
        means[starts[number] : starts[number + 1]] = _search(bucket, nearest, number, buckets, lows, highs)
    result = torch.empty_like(means)
    result[order] = means
    return result


def _search(bucket: Tensor, nearest: Tensor, number: int, buckets: list[Tensor], lows: Tensor, highs: Tensor) -> Tensor:
    """[A]: mean of the nearest distances of a bucket's points, `nearest` [A, k] (squared) being those within it."""
    gaps = (lows - highs[number]).maximum(lows[number] - highs).clamp(min=0).square().sum(dim=1)  # [B]
    gaps[number] = torch.inf
    near = (gaps < nearest.max()).nonzero()[:, 0]
    near = near[gaps[near].argsort()]
    for block in near.split(BUCKETS_AT_ONCE):
        # Distances of points to boxes: most points of a bucket need none of the farther boxes.
        outside = (lows[block] - bucket[:, None]).maximum(bucket[:, None] - highs[block]).clamp(min=0)  # [A, b, 3]
        wanted = outside.square().sum(dim=2) < nearest[:, -1:]  # [A, b]
        rows, members = wanted.any(dim=1).nonzero()[:, 0], block[wanted.any(dim=0)].tolist()
        if members:
            found = _pairwise(bucket[rows], torch.cat([buckets[member] for member in members]))
            merged = torch.cat([nearest[rows], found], dim=1)
            nearest[rows] = merged.topk(nearest.shape[1], largest=False).values
    return nearest.sqrt().mean(dim=1)


def _pairwise(a: Tensor, b: Tensor) -> Tensor:
    """[A, B] squared distances, from differences: exact for near points, unlike the expanded square."""
    # One axis after the other: sums of three over the last dimension are slow.
    x, y, z = ((a[:, None, axis] - b[None, :, axis]).square_() for axis in range(3))  # [A, B] each
    return x.add_(y).add_(z)


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
    return torch.cat(parts), [0, *itertools.accumulate(map(len, parts))]
