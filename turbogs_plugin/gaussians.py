"""Gaussians in gsplat's layout: made from points, and to and from .ply."""

from __future__ import annotations

import math
import warnings

from torch import Tensor

from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.nearest import mean_neighbor_distances
from turbogs_plugin.types import Gaussians

SH_C0 = 0.28209479177387814
"""Band 0 of the spherical harmonics: colour = SH_C0 * sh0 + 0.5."""

INITIAL_OPACITY = 0.1
SMALLEST_SCALE = 1e-4
"""Of a new Gaussian, in extents: coincident points would otherwise give a scale of zero."""
LONELY_SCALE = 0.01
"""Scale of a Gaussian without neighbours, in extents."""


def gaussians_from_points(points: Tensor, colors: Tensor, sh_degree: int, extent: float) -> Gaussians:
    """One isotropic Gaussian a point, as 3DGS starts (Kerbl et al. 2023, section 5.1).

    Its scale is the mean distance to the three nearest points, its opacity 0.1, its colour the point's; the higher
    bands are zero.

    Args:
        points: [M, 3] float. Points that are not finite are left out, with a warning that counts them.
        colors: [M, 3] uint8.
        sh_degree: the degree to make room for, 0 .. 4.
        extent: the scene's, in the points' unit; bounds the scales from below where points coincide.

    Raises:
        InputError: no finite points, a degree out of range, an extent that is not positive.
    """
    if not 0 <= sh_degree <= 4:
        raise InputError(f"sh_degree is {sh_degree}: it must be 0 .. 4")
    if not (math.isfinite(extent) and extent > 0):
        raise InputError(f"extent is {extent}: it must be finite and positive")
    finite = points.isfinite().all(dim=1)
    if not finite.all():
        warnings.warn(f"{int((~finite).sum())} of {len(points)} points are not finite and left out", stacklevel=2)
        points, colors = points[finite], colors[finite]
    count = len(points)
    if count == 0:
        raise InputError("there are no points to start from")
    distances = (
        mean_neighbor_distances(points, neighbors=3) if count > 1 else points.new_full((1,), LONELY_SCALE * extent)
    )
    scales = distances.clamp(min=SMALLEST_SCALE * extent).log()
    quats = points.new_zeros(count, 4)
    quats[:, 0] = 1.0
    return Gaussians(
        means=points.clone(),
        quats=quats,
        scales=scales[:, None].repeat(1, 3),
        opacities=points.new_full((count,), math.log(INITIAL_OPACITY / (1.0 - INITIAL_OPACITY))),
        sh0=((colors.to(points) / 255.0 - 0.5) / SH_C0)[:, None, :],
        shN=points.new_zeros(count, (sh_degree + 1) ** 2 - 1, 3),
    )
