"""Distances to the nearest neighbours of every point of a cloud, exact, without a k-d tree library."""

from __future__ import annotations

import torch
from torch import Tensor

BUCKET_SIZE = 64
FIRST_BOXES, MOST_BOXES = 4, 32
"""How many boxes a bucket's points are compared with at a time: few near ones tighten the bound for many far ones."""
GAPS_AT_ONCE = 1 << 18
"""Of buckets to boxes: it bounds memory."""


def mean_neighbor_distances(points: Tensor, neighbors: int) -> Tensor:
    """[M]: mean distance of each point to its `neighbors` nearest other points (fewer, if the cloud has fewer).

    Points are cut into compact buckets of one size. A bucket's points are compared among themselves first, which bounds
    how far their neighbours can be; then each point with every bucket whose bounding box comes nearer than its bound.

    Args:
        points: [M, 3] float, finite, M >= 2, on any device. Points may coincide.
        neighbors: at least 1.
    """
    neighbors = min(neighbors, len(points) - 1)
    members, places = _buckets(points, BUCKET_SIZE)
    cloud = _Buckets(places, members < len(points))
    groups = torch.arange(len(places), device=places.device).split(max(1, GAPS_AT_ONCE // len(places)))
    nearest = torch.cat([cloud.nearest(rows, neighbors) for rows in groups])  # [B, S, k], squared
    result = points.new_empty(len(points))
    result[members[cloud.counts]] = nearest[cloud.counts].sqrt().mean(dim=1)
    return result


class _Buckets:
    """Points in buckets of one size.

    Args:
        places: [B, S, 3].
        counts: [B, S] bool: False is a copy of a point of the cloud, which fills a bucket.
    """

    def __init__(self, places: Tensor, counts: Tensor) -> None:
        self.places, self.counts = places, counts
        self.lows, self.highs = places.amin(dim=1), places.amax(dim=1)  # [B, 3]

    def nearest(self, rows: Tensor, neighbors: int) -> Tensor:
        """[G, S, k]: squared distances of the points of some buckets to their nearest, zero for copies."""
        within = self._squared(self.places[rows], rows)
        within.diagonal(dim1=1, dim2=2).fill_(torch.inf)
        if within.shape[2] < neighbors:
            within = torch.nn.functional.pad(within, (0, neighbors - within.shape[2]), value=torch.inf)
        nearest = within.topk(neighbors, largest=False).values
        nearest[~self.counts[rows]] = 0.0  # so that they search nothing

        gaps = _outside(self.lows[rows, None], self.highs[rows, None], self.lows, self.highs)  # [G, B]
        gaps.scatter_(1, rows[:, None], torch.inf)
        near = int((gaps < nearest[:, :, -1].amax(dim=1, keepdim=True)).sum(dim=1).max())
        gaps, boxes = gaps.topk(near, dim=1, largest=False)  # [G, C], none of them a bucket's own
        active, first, count = torch.arange(len(rows), device=rows.device), 0, FIRST_BOXES
        while first < near:
            active = active[gaps[active, first] < nearest[active, :, -1].amax(dim=1)]
            if not len(active):
                break
            self._compare(nearest, active, rows[active], boxes[active, first : first + count])
            first, count = first + count, min(2 * count, MOST_BOXES)
        return nearest

    def _compare(self, nearest: Tensor, active: Tensor, rows: Tensor, boxes: Tensor) -> None:
        """Bring `nearest` [G, S, k] of the active buckets up to date with the points in `boxes` [A, b]."""
        places = self.places[rows][:, :, None]  # [A, S, 1, 3]
        gaps = _outside(places, places, self.lows[boxes][:, None], self.highs[boxes][:, None])  # [A, S, b]
        wanted = gaps < nearest[active][:, :, -1:]
        bucket, place = wanted.any(dim=2).nonzero(as_tuple=True)
        pairs, box = wanted[bucket, place].nonzero(as_tuple=True)  # of these points with boxes
        if not len(pairs):
            return
        others = self._squared(places[bucket[pairs], place[pairs]], boxes[bucket[pairs], box])[:, 0]  # [pairs, S]
        neighbors = nearest.shape[2]
        found = nearest.new_full((len(bucket), boxes.shape[1], min(neighbors, others.shape[1])), torch.inf)
        found[pairs, box] = others.topk(found.shape[2], largest=False).values
        bucket = active[bucket]
        merged = torch.cat([nearest[bucket, place], found.flatten(1)], dim=1)
        nearest[bucket, place] = merged.topk(neighbors, largest=False).values

    def _squared(self, places: Tensor, buckets: Tensor) -> Tensor:
        """[A, n, S]: squared distances of places [A, n, 3] to the points of a bucket [A] each, infinite for copies.

        From differences: exact for near points, unlike the expanded square.
        """
        # One axis after the other: sums of three over the last dimension are slow.
        others = self.places[buckets]
        x, y, z = ((places[:, :, None, axis] - others[:, None, :, axis]).square_() for axis in range(3))
        return x.add_(y).add_(z).masked_fill_(~self.counts[buckets][:, None], torch.inf)


def _outside(low: Tensor, high: Tensor, lows: Tensor, highs: Tensor) -> Tensor:
    """[...]: squared distances between boxes, given by their corners [..., 3]; zero where they overlap."""
    x, y, z = (
        (lows[..., axis] - high[..., axis]).maximum(low[..., axis] - highs[..., axis]).clamp_(min=0).square_()
        for axis in range(3)
    )
    return x.add_(y).add_(z)


def _buckets(points: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Buckets of at most `size` points, of one size: recursive halves along the longest side.

    Returns:
        [B, S] the points of each, M and above for copies that fill the buckets up; [B, S, 3] where these are.
    """
    levels = max(0, (-(-len(points) // size) - 1).bit_length())
    full = -(-len(points) >> levels) << levels if levels else len(points)
    copies = torch.linspace(0, len(points) - 1, full - len(points), device=points.device).long()
    places = torch.cat([points, points[copies]])
    parts = torch.arange(full, device=points.device)[None]
    for _ in range(levels):
        members = places[parts]  # [P, n, 3]
        axis = (members.amax(dim=1) - members.amin(dim=1)).argmax(dim=1)  # [P]
        along = members.gather(2, axis[:, None, None].expand(-1, members.shape[1], 1))[:, :, 0]
        parts = parts.gather(1, along.argsort(dim=1, stable=True)).view(2 * len(parts), -1)
    return parts, places[parts]
