"""Rendering in plain torch that autograd differentiates: gsplat's projection and harmonics (its `_torch_impl`), and
compositing front to back as gsplat documents it. Slow, and no line is shared with what is tested."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci, _spherical_harmonics
from torch import Tensor

from turbogs_plugin.engine.render_pass import DEFAULT_SETTINGS, RasterSettings
from turbogs_plugin.types import Cameras, Gaussians, PixelSamples


@dataclass
class Drawn:
    """What was drawn of one view. The gradients of the distances are the terms of the gradient on the screen."""

    order: Tensor  # [S] the Gaussians in the order of drawing
    slots: Tensor  # [n] the samples of the view
    distances: Tensor  # [n, S, 2] of the Gaussians' means from the pixels' centres
    weights: Tensor  # [n, S], see `weights_of`
    sigmas: Tensor  # [n, S]


def gsplat_torch_render(
    gaussians: Gaussians,
    cameras: Cameras,
    samples: PixelSamples,
    sh_degree: int | None = None,
    settings: RasterSettings = DEFAULT_SETTINGS,
    drawn: list[Drawn] | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Colours [P, 3], alphas [P] and expected depths [P] at the samples; zero in empty slots. `drawn` takes what was
    drawn of each view; the distances there keep their gradients."""
    degree = gaussians.sh_degree if sh_degree is None else sh_degree
    covars, _ = _quat_scale_to_covar_preci(gaussians.quats, gaussians.scales.exp(), True, False)
    coefficients = torch.cat([gaussians.sh0, gaussians.shN], dim=1)
    opacities = torch.sigmoid(gaussians.opacities)
    places, views = samples.coordinates().to(gaussians.means) + 0.5, samples.view_of_slot()
    result = gaussians.means.new_zeros(len(samples), 5)
    for view, (width, height) in enumerate(cameras.sizes.tolist()):
        camera = (cameras.viewmats[view : view + 1], cameras.Ks[view : view + 1], width, height)
        limits = (settings.eps2d, settings.near_plane, settings.far_plane)
        projected = _fully_fused_projection(gaussians.means, covars, *camera, *limits)
        radii, means2d, depths, conics = (value[0] for value in projected[:4])
        directions = gaussians.means - cameras.centers[view]
        colors = (_spherical_harmonics(degree, directions, coefficients) + 0.5).clamp(min=0)
        order = depths.argsort(stable=True)
        order = order[(radii > 0).all(dim=-1)[order]]
        slots = torch.nonzero((views == view) & samples.filled).squeeze(-1)
        distances = means2d[order] - places[slots][:, None]  # [n, S, 2]
        if drawn is not None:
            distances.requires_grad_()
        weights, sigmas = weights_of(distances, conics[order], opacities[order], settings)
        if drawn is not None:
            drawn.append(Drawn(order, slots, distances, weights.detach(), sigmas.detach()))
        values = torch.cat([colors[order], depths[order, None], torch.ones_like(depths[order, None])], dim=1)
        result = result.index_add(0, slots, weights @ values)
    alphas = result[:, 4]
    return result[:, :3], alphas, result[:, 3] / alphas.clamp(min=1e-10)


def weights_of(
    distances: Tensor, conics: Tensor, opacities: Tensor, settings: RasterSettings = DEFAULT_SETTINGS
) -> tuple[Tensor, Tensor]:
    """[n, S] the weight of each Gaussian in each pixel, and half its squared Mahalanobis distance from there, given
    `Drawn.distances`, conics [S, 3] and opacities [S] after the sigmoid."""
    dx, dy = distances.unbind(dim=-1)
    a, b, c = conics.unbind(dim=-1)
    sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    alphas = (opacities * torch.exp(-sigma)).clamp(max=settings.alpha_max)
    alphas = torch.where((sigma >= 0) & (alphas >= settings.alpha_min), alphas, 0)
    alphas = torch.where((1 - alphas).cumprod(dim=1) > settings.transmittance_min, alphas, 0)
    before = torch.cat([torch.ones_like(alphas[:, :1]), (1 - alphas).cumprod(dim=1)[:, :-1]], dim=1)
    return alphas * before, sigma
