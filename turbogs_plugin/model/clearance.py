"""Free space around the training cameras, in which a photo shows that nothing can be."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from turbogs_plugin.types import Gaussians, RowUpdate

POINTS, SHARE = 10, 0.9
"""A camera's radius is at most this share of its distance from the nearest points: so many of them, as single ones may
be wrong. So what a photo was taken of from near by stays."""
RARE = 0.002
"""No radius is larger than the distance within which this share of the points have a camera: where a camera stands
before a wall without points, the wall stays."""
POINTS_LOOKED_AT = 100_000
"""Of more points so many, evenly in their order."""
DISTANCES_AT_ONCE = 1 << 22
"""Points times cameras: it bounds memory."""


@dataclass(frozen=True)
class Clearance:
    """A sphere around each training camera that is kept free of Gaussians.

    Faint Gaussians before a camera cost it little, but veil a test view from there: a haze that no training view
    corrects.

    Args:
        centers: [V, 3] of the cameras.
        radii: [V].
    """

    centers: Tensor
    radii: Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, points: Tensor, centers: Tensor) -> Clearance | None:
        """The spheres of a capture; None where it has fewer than `POINTS` points.

        Args:
            points: [M, 3] that were reconstructed, on the device of `centers` [V, 3].
        """
        if len(points) < POINTS:
            return None
        points = points[:: -(-len(points) // POINTS_LOOKED_AT)]
        nearest = centers.new_full((POINTS, len(centers)), torch.inf)
        of_points = []
        for distances in _distances(points, centers):
            of_points.append(distances.amin(dim=1))
            nearest = torch.cat([nearest, distances]).topk(POINTS, dim=0, largest=False).values  # [POINTS, V]
        rare = torch.cat(of_points).kthvalue(max(1, int(RARE * len(points)))).values
        return cls(centers, (SHARE * nearest.amax(dim=0)).clamp(max=rare))

    @torch.no_grad()
    def clear(self, update: RowUpdate, gaussians: Gaussians) -> RowUpdate:
        """The same change without the rows that would lie in a sphere. To be called before the change is applied.

        Args:
            update: a change of `gaussians`.
        """
        means, reach = update.new("means", gaussians), self.radii.amax()
        low, high = self.centers.amin(dim=0) - reach, self.centers.amax(dim=0) + reach
        among = ((means > low) & (means < high)).all(dim=1).nonzero()[:, 0]  # the cameras: others are in no sphere
        inside = [(distances < self.radii).any(dim=1) for distances in _distances(means[among], self.centers)]
        cleared = among[torch.cat(inside)]
        if len(cleared) == 0:
            return update
        free = torch.ones(len(means), dtype=torch.bool, device=means.device).index_fill_(0, cleared, False)
        return replace(update.taking(free.nonzero()[:, 0]), num_pruned=update.num_pruned + len(cleared))


def _distances(points: Tensor, centers: Tensor) -> Iterator[Tensor]:
    """[n, V] of some points after the others. By differences: cdist takes a block of threads for each number."""
    for part in points.split(max(1, DISTANCES_AT_ONCE // max(1, len(centers)))):
        yield (part[:, None] - centers).norm(dim=-1)
