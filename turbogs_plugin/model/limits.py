"""Limits that no training view enforces: free space around the training cameras, and the size of distant Gaussians."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.types import Gaussians, RowUpdate

POINTS, SHARE = 10, 0.9
"""Nearest points of a camera, as single ones may be wrong, and the largest share of its distance from them that its
radius may be: objects photographed from near by stay."""
RARE = 0.002
"""Share of the points that have a camera within the largest radius. A wall without points before a camera stays."""
POINTS_LOOKED_AT, DISTANCES_AT_ONCE = 100_000, 1 << 22
"""Points that are used at most, evenly in their order; points times cameras at a time, which bounds memory."""
DISTANT = 2.0
"""Gaussians farther than this from the cameras' centre, in extents, are limited. All cameras lie within one extent of
it, so these Gaussians are at least one extent away from every camera. A nearer limit would affect the scene itself."""
RESTRAIN_EVERY = 10
"""Iterations between two limitations, in which a standard deviation grows by a quarter at most."""


@dataclass(frozen=True)
class Clearance:
    """A sphere around each training camera, at `centers` [V, 3] and of `radii` [V], that is kept free of Gaussians.

    Faint Gaussians before a camera cost it little, but veil a test view from there; no training view corrects that."""

    centers: Tensor
    radii: Tensor

    @classmethod
    def of(cls, points: Tensor, centers: Tensor) -> Clearance | None:
        """The spheres by points [M, 3], on the device of `centers` [V, 3]; None for fewer than `POINTS` points."""
        if len(points) < POINTS:
            return None
        from scipy.spatial import cKDTree

        places, cameras = points[:: -(-len(points) // POINTS_LOOKED_AT)].cpu().numpy(), centers.cpu().numpy()
        to_points = cKDTree(places).query(cameras, POINTS)[0][:, -1]  # [V]
        to_cameras, rank = cKDTree(cameras).query(places, workers=-1)[0], max(1, int(RARE * len(places))) - 1
        radii = np.minimum(SHARE * to_points, np.partition(to_cameras, rank)[rank])
        return cls(centers, torch.from_numpy(radii).to(centers))

    @torch.no_grad()
    def clear(self, update: RowUpdate, gaussians: Gaussians) -> RowUpdate:
        """`update` of `gaussians` without the rows that would lie in a sphere. To be called before it is applied."""
        means, reach = update.new("means", gaussians), self.radii.amax()
        low, high = self.centers.amin(dim=0) - reach, self.centers.amax(dim=0) + reach
        among = ((means > low) & (means < high)).all(dim=1).nonzero()[:, 0]  # the cameras: others are in no sphere
        parts = means[among].split(max(1, DISTANCES_AT_ONCE // max(1, len(self.centers))))
        # By differences: cdist takes a block of threads for each number.
        inside = [((part[:, None] - self.centers).norm(dim=-1) < self.radii).any(dim=1) for part in parts]
        cleared = among[torch.cat(inside)]
        if len(cleared) == 0:
            return update
        free = torch.ones(len(means), dtype=torch.bool, device=means.device).index_fill_(0, cleared, False)
        return replace(update.taking(free.nonzero()[:, 0]), num_pruned=update.num_pruned + len(cleared))


@torch.no_grad()
def restrain_distant(gaussians: Gaussians, extent: float, size: float) -> None:
    """Limit the size of Gaussians beyond `DISTANT` extents, in place: the ratio of a standard deviation to the distance
    from the nearest place of a camera is at most `size`. The cameras' centre is the origin, and all lie within an
    extent.

    A Gaussian beside a camera reaches the middle of the image, whatever its depth and perhaps in front of everything,
    once its deviation is a third of its distance (splats are cut at 3.33): size and place of a splat are both divided
    by the depth. It may happen that no training view shows it."""
    distances = gaussians.means.norm(dim=-1, keepdim=True)  # [N, 1]
    limits = torch.where(distances > DISTANT * extent, (size * (distances - extent)).log(), torch.inf)
    torch.minimum(gaussians.scales, limits, out=gaussians.scales)
