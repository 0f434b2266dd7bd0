"""Where some of a scene's points are in its photos."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from turbogs_plugin.scene import PosedImages

POINTS_AT_MOST = 2000
"""3D points examined."""


@dataclass(frozen=True)
class Sight:
    """Where Q of the points are in V photos.

    Args:
        depths: [V, Q].
        inside: [V, Q] bool, in front of the camera, within the photo and not masked.
        flat: [V, Q] int64, flat pixel; 0 where not inside.
        distances: [V, V] between camera centres, infinite on the diagonal.
    """

    depths: Tensor
    inside: Tensor
    flat: Tensor
    distances: Tensor

    @classmethod
    def of(cls, views: PosedImages, points: Tensor) -> Sight:
        cameras = views.cameras.to("cpu", torch.float64)
        chosen = points[:: max(1, -(-len(points) // POINTS_AT_MOST))].cpu().double()  # [Q, 3]
        seen = chosen @ cameras.viewmats[:, :3, :3].transpose(1, 2) + cameras.viewmats[:, None, :3, 3]  # [V, Q, 3]
        depths = seen[..., 2]
        pixels = (seen @ cameras.Ks.transpose(1, 2))[..., :2] / depths.clamp(min=1e-9)[..., None]
        sizes = torch.from_numpy(cameras.sizes)[:, None]  # [V, 1, 2]
        inside = (depths > 1e-9) & (pixels >= 0).all(dim=-1) & (pixels < sizes).all(dim=-1)
        x, y = torch.where(inside[..., None], pixels, 0.0).long().unbind(dim=-1)
        if views.masks is not None:
            inside &= torch.stack([views.masks.image(view)[y[view], x[view]] for view in range(len(views))])
        flat = torch.from_numpy(views.photos.offsets[:-1])[:, None] + y * sizes[..., 0] + x
        distances = torch.cdist(cameras.centers, cameras.centers, compute_mode="donot_use_mm_for_euclid_dist")
        return cls(depths, inside, torch.where(inside, flat, 0), distances.fill_diagonal_(torch.inf))
