"""The error that each Gaussian carries, from what a host's `info` has (paper equation for the per-Gaussian sums).

Three sources, best first:

1. `sparse_rasterization` was given the prediction and the ground truth: its backward pass leaves all sums in `info`.
2. gsplat's rasterizer, and prediction and ground truth in `info`: the *zero channel*. Colour channels that are zero
   everywhere, with the pixel error as their upstream gradient, have the sum of e * w as the gradient of their values,
   w = T * alpha the compositing weight; with 1 upstream, the sum of w. No other gradient is touched. The zero channel
   costs one further pass over the tiles, of three channels, as gsplat may be built for chosen numbers of channels and
   always has a colour's. The distance sums stay zero.
3. Neither: there is no error, only the gradient on the screen. The squares of a view's absolute gradients stand for
   the sums of squares over its samples: both are large where samples of one view want different things.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.errors import InputError
from turbogs_plugin.gsplat_bridge.host import GROUND_TRUTH, PREDICTION, STATISTICS, require_keys
from turbogs_plugin.types import GaussianStats

WITHOUT_GRADIENT = (
    "info['means2d'] takes no gradient, as from a render with with_ut or with_eval3d, or under no_grad: "
    "TurboDensityStrategy needs it; render without these options, or keep gsplat's MCMCStrategy"
)
RENDERED = "pass what the rasterization returned"


def residuals(info: dict[str, Any]) -> Tensor | None:
    """[...] L1 norm over RGB of the residual at each pixel, or None where `info` has neither of its two parts. Raises
    `InputError`: only one of them is there, or their shapes differ."""
    present = [key for key in (PREDICTION, GROUND_TRUTH) if key in info]
    if not present:
        return None
    require_keys(info, (PREDICTION, GROUND_TRUTH), "info", f"'{present[0]}' is there, error-driven control needs both")
    prediction, truth = info[PREDICTION].detach(), info[GROUND_TRUTH].detach()
    if prediction.shape != truth.shape or prediction.shape[-1] != 3:
        found = f"info['{PREDICTION}'] has shape {tuple(prediction.shape)}, info['{GROUND_TRUTH}'] {tuple(truth.shape)}"
        raise InputError(f"{found}: expected both [C, H, W, 3], or both [P, 3] with sparse pixels")
    errors = (prediction - truth).abs().sum(dim=-1)
    return errors[None] if errors.dim() == 2 else errors  # of one image [H, W, 3]


def iteration_stats(info: dict[str, Any], count: int, absgrad: bool = True) -> tuple[GaussianStats, bool]:
    """The statistics of the pass of N = `count` Gaussians that `info` tells of, packed or not, after its backward; and
    whether they have error sums. Without `absgrad`, absolute gradients are not looked at. Raises `InputError` where
    `info` lacks a key or a gradient, or is of another N."""
    stats = screen_statistics(info, count, absgrad)
    if info.get(STATISTICS) is not None:  # with the screen gradients as the host left them: unscaled, say
        return replace(info[STATISTICS], grad_sums=stats.grad_sums, absgrad_sums=stats.absgrad_sums), True
    sums = _error_sums(info, count)
    if sums is None:
        return stats, False
    stats.error_sums += sums[:, 0]
    stats.weight_sums += sums[:, 1]
    return stats, True


def _error_sums(info: dict[str, Any], count: int) -> Tensor | None:
    """[N, 2] sums of e * w and of w by the zero channel; None without errors."""
    errors = residuals(info)
    if errors is None:
        return None
    if info.get("flatten_ids") is None:
        remedy = "put them in before loss.backward(), into the info of a render by gsplat's or our rasterization"
        trouble = f"info has '{PREDICTION}' and '{GROUND_TRUTH}' but neither '{STATISTICS}' nor 'flatten_ids'"
        raise InputError(f"{trouble}: {remedy}")
    ones = torch.ones_like(errors)
    sums = zero_channel_sums(info, torch.stack([errors, ones, torch.zeros_like(ones)], dim=-1))[..., :2]
    if info["gaussian_ids"] is None:
        return sums.reshape(-1, count, 2).sum(dim=0)
    return sums.new_zeros(count, 2).index_add(0, info["gaussian_ids"].long(), sums)


def screen_statistics(info: dict[str, Any], count: int, absgrad: bool = True) -> GaussianStats:
    """Sums of screen gradients and their squares, of views, and largest radii, in gsplat's units; the sums over pixels
    stay zero. Squares are of absolute gradients, where the pass has them and `absgrad` asks for them."""
    require_keys(info, ("means2d", "radii", "width", "height", "n_cameras", "gaussian_ids"), "info", RENDERED)
    means2d, radii, ids = info["means2d"], info["radii"], info["gaussian_ids"]
    if radii.dim() < means2d.dim():  # before gsplat 1.5 both axes have one radius
        radii = radii[..., None]
    if means2d.grad is None:
        raise InputError("info['means2d'] has no gradient: call step_pre_backward before loss.backward()")
    width, height, cameras = info["width"], info["height"], info["n_cameras"]
    half = means2d.new_tensor([0.5 * width * cameras, 0.5 * height * cameras])
    # Statistics are in single precision, whatever the host's.
    norms = [(means2d.grad * half).norm(dim=-1).float()]
    absolute = getattr(means2d, "absgrad", None) if absgrad else None
    norms.append(torch.zeros_like(norms[0]) if absolute is None else (absolute * half).norm(dim=-1).float())
    if ids is None:
        visible = (radii > 0).all(dim=-1)
        if visible.shape[-1] != count:
            remedy = "pass the info of this step's rasterization, from before rows were added or removed"
            raise InputError(f"info is of {visible.shape[-1]} Gaussians, the parameters are {count}: {remedy}")
        ids = torch.where(visible)[-1]
        norms, radii = [norm[visible] for norm in norms], radii[visible]
    stats, ids = GaussianStats.zeros(count, means2d.device), ids.long()
    stats.grad_sums.index_add_(0, ids, norms[0])
    stats.absgrad_sums.index_add_(0, ids, norms[1])
    stats.square_sums.index_add_(0, ids, norms[0 if absolute is None else 1].square())
    stats.view_counts.index_add_(0, ids, torch.ones_like(norms[0]))
    stats.max_radii.scatter_reduce_(0, ids, radii.amax(dim=-1).float() / max(width, height), "amax")
    return stats


def zero_channel_sums(info: dict[str, Any], upstream: Tensor) -> Tensor:
    """[C, N, D], or [nnz, D] where packed: the sum over pixels of ``upstream * w``, by gsplat's rasterizer.
    `info`: of a pass of gsplat's `rasterization`; `upstream`: [C, H, W, D]."""
    from gsplat import rasterize_to_pixels

    tiles = ("width", "height", "tile_size", "isect_offsets", "flatten_ids")
    require_keys(info, ("gaussian_ids", "conics", "opacities", *tiles), "info", RENDERED)
    means2d, images = info["means2d"], (info["isect_offsets"].shape[0], info["height"], info["width"])
    if means2d.grad is None and not means2d.requires_grad:
        raise InputError(WITHOUT_GRADIENT)
    if upstream.shape[:-1] != images:
        found = f"info['{PREDICTION}'] and info['{GROUND_TRUTH}'] are of shape {(*upstream.shape[:-1], 3)}"
        raise InputError(f"{found}: expected {(*images, 3)}, what gsplat.rasterization rendered")
    means2d, conics, opacities = (value.detach() for value in (means2d, info["conics"], info["opacities"]))
    with torch.enable_grad():
        channels = means2d.new_zeros(*means2d.shape[:-1], upstream.shape[-1]).requires_grad_()
        places, packed = (info[key] for key in tiles), info["gaussian_ids"] is not None
        image, _ = rasterize_to_pixels(means2d, conics, channels, opacities, *places, packed=packed)
    return torch.autograd.grad(image, channels, upstream.to(image.dtype))[0]
