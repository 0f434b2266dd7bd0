"""A limit on the size of distant Gaussians, which can grow without any training view showing it."""

from __future__ import annotations

import torch

from turbogs_plugin.types import Gaussians

DISTANT = 2.0
"""Gaussians farther than this from the cameras' centre, in extents, are limited. All cameras lie within one extent of
it, so these Gaussians are at least one extent away from every camera. A nearer limit would affect the scene itself."""
RESTRAIN_EVERY = 10
"""The limit is applied every so many iterations, in which a standard deviation grows by a quarter at most."""


@torch.no_grad()
def restrain_distant(gaussians: Gaussians, extent: float, size: float) -> None:
    """Limit the size of Gaussians beyond `DISTANT` extents, in place, to a share of their distance from all cameras.

    A splat's size is its Gaussian's size over its depth, and its distance from the image's middle is its centre's
    distance from the axis over the same depth. So a Gaussian beside a camera reaches the middle of the image, whatever
    its depth and perhaps in front of everything, once its deviation is a third of its distance (splats are cut at
    3.33). It may happen that no training view shows it.

    Args:
        gaussians: the model, with the cameras' centre as origin.
        extent: the scene's; all cameras lie within it.
        size: largest allowed ratio of a standard deviation to the distance from the nearest place of a camera.
    """
    distances = gaussians.means.norm(dim=-1, keepdim=True)  # [N, 1]
    limits = (size * (distances - extent)).log()
    limits = torch.where(distances > DISTANT * extent, limits, torch.inf)
    torch.minimum(gaussians.scales, limits, out=gaussians.scales)
