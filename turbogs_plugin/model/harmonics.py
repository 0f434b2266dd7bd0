"""Which degrees of spherical harmonics a model needs, by the energy of its colours."""

from __future__ import annotations

from dataclasses import replace

import torch

from turbogs_plugin.errors import require
from turbogs_plugin.types import SH_C0, Gaussians


def band_energy(gaussians: Gaussians) -> list[float]:
    """Share of each degree, 0 first, in the energy of a model's colours.

    The harmonics are orthonormal, so the energy of a Gaussian's colour, over all directions and channels, is the sum of
    its squared coefficients. That of degree 0 includes the offset of 0.5. Gaussians are weighted by their opacity;
    those that are not finite are left out.
    """
    constant = gaussians.sh0.double() + 0.5 / SH_C0  # [N, 1, 3]
    squares = torch.cat([constant, gaussians.shN.double()], dim=1).square().sum(dim=2)  # [N, (degree + 1)^2]
    weighted = torch.sigmoid(gaussians.opacities.double())[:, None] * squares
    energies = weighted[weighted.isfinite().all(dim=1)].sum(dim=0)
    degrees = [energies[degree**2 : (degree + 1) ** 2].sum() for degree in range(gaussians.sh_degree + 1)]
    total = float(energies.sum())
    return [float(energy) / total if total > 0 else 0.0 for energy in degrees]


def drop_faint_bands(gaussians: Gaussians, threshold: float) -> Gaussians:
    """The model without its highest degrees: as many as together have at most this share of its colours' energy.

    Args:
        gaussians: the model; the result shares its means and shapes.
        threshold: 0 .. 1; 0 drops only zeros. The relative change of colours is about its root: 1e-4 means 1 %.

    Raises:
        InputError: the threshold is out of range.
    """
    require(0 <= threshold < 1, "threshold", threshold, "at least 0 and less than 1")
    shares = band_energy(gaussians)
    degree = next(degree for degree in range(len(shares)) if sum(shares[degree + 1 :]) <= threshold)
    return replace(gaussians, shN=gaussians.shN[:, : (degree + 1) ** 2 - 1].contiguous())


def with_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """The model with room for exactly this degree: higher bands are dropped, missing ones are zero."""
    bands = (degree + 1) ** 2 - 1
    missing = gaussians.shN.new_zeros(len(gaussians), max(0, bands - gaussians.shN.shape[1]), 3)
    return replace(gaussians, shN=torch.cat([gaussians.shN[:, :bands], missing], dim=1))
