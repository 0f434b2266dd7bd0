"""Real spherical harmonics of degrees 0 to 3 in gsplat's convention (Sloan, "Efficient Spherical Harmonic Evaluation",
JCGT 2013), evaluated in the direction from the camera to the Gaussian."""

from __future__ import annotations

import torch
from torch import Tensor

from turbogs_plugin.types import SH_C0


def num_bands(degree: int) -> int:
    """Coefficients of degrees 1 .. `degree`: what `Gaussians.shN` holds."""
    return (degree + 1) ** 2 - 1


def unit_directions(offsets: Tensor) -> Tensor:
    """Normalise [..., 3] offsets. A zero offset has the zero direction and no gradient."""
    squares = (offsets * offsets).sum(dim=-1, keepdim=True)
    usable = squares > 0
    return torch.where(usable, offsets * torch.where(usable, squares, 1.0).rsqrt(), 0.0)


def basis(directions: Tensor, degree: int) -> Tensor:
    """[R, num_bands(degree)]: the basis functions of degrees 1 .. `degree`, 0 .. 3, at unit `directions` [R, 3]."""
    x, y, z = directions.unbind(dim=-1)
    values = []
    if degree >= 1:
        c1 = 0.48860251190292
        values += [-c1 * y, c1 * z, -c1 * x]
    if degree >= 2:
        zz, cos2, sin2 = z * z, x * x - y * y, 2 * x * y
        c20, c21, c22 = 0.9461746957575601, -1.092548430592079, 0.5462742152960395
        values += [c22 * sin2, c21 * z * y, c20 * zz - 0.3153915652525201, c21 * z * x, c22 * cos2]
    if degree >= 3:
        ring, c32, c33 = 0.4570457994644658 - 2.285228997322329 * zz, 1.445305721320277, -0.5900435899266435
        cos3, sin3 = x * cos2 - y * sin2, x * sin2 + y * cos2
        axis = z * (1.865881662950577 * zz - 1.119528997770346)
        values += [c33 * sin3, c32 * z * sin2, ring * y, axis, ring * x, c32 * z * cos2, c33 * cos3]
    if not values:
        return directions.new_zeros(directions.shape[0], 0)
    return torch.stack(values, dim=-1)


def evaluate(sh0: Tensor, shN: Tensor, directions: Tensor, degree: int) -> Tensor:
    """[R, 3]: colours before the offset of 0.5 and the clamp. `sh0`: [R, 1, 3]; `shN`: [R, B, 3], with at least
    `num_bands(degree)` bands; `directions`: [R, 3] unit vectors from the camera centre to the Gaussian."""
    values = basis(directions, degree)  # [R, B]
    return SH_C0 * sh0[:, 0] + (values[:, :, None] * shN[:, : values.shape[1]]).sum(dim=1)
