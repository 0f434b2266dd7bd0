"""A bound on the size of far Gaussians, which grow where no training view shows it."""

from __future__ import annotations

import torch

from turbogs_plugin.types import Gaussians

DISTANT = 2.0
"""Gaussians farther than this from the cameras' centre, in extents, are bounded. All cameras lie within one extent of
it. So these Gaussians are at least one extent away from every camera; a nearer limit would bound the scene itself."""
RESTRAIN_EVERY = 10
"""Iterations from one bounding to the next. In so few, a standard deviation grows by a quarter at most."""


@torch.no_grad()
def restrain_distant(gaussians: Gaussians, extent: float, size: float) -> None:
    """Keep Gaussians beyond `DISTANT` extents from growing, in place, past a share of their distance from all cameras.

    A splat is as large as its Gaussian over its depth, and as far from the image's middle as its centre over that
    depth. So one beside a camera reaches the middle of its image, whatever its depth and perhaps in front of all else,
    once its deviation is a third of its distance (splats are cut at 3.33). No training view need show it.

    Args:
        gaussians: about the cameras' centre.
        extent: the scene's, which holds all cameras.
        size: largest standard deviation over the distance from the nearest place where a camera may be.
    """
    distances = gaussians.means.norm(dim=-1, keepdim=True)  # [N, 1]
    limits = (size * (distances - extent)).log()
    limits = torch.where(distances > DISTANT * extent, limits, torch.inf)
    torch.minimum(gaussians.scales, limits, out=gaussians.scales)
