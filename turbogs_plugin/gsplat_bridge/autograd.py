"""A rendering pass under torch autograd, for losses written in plain torch: one wrapper, whatever the engine."""

from __future__ import annotations

import weakref
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from turbogs_plugin.engine.layout import ScreenRecord
from turbogs_plugin.engine.render import rasterize
from turbogs_plugin.engine.render_pass import Projected, Rendered
from turbogs_plugin.errors import InputError
from turbogs_plugin.gsplat_bridge.gaussian_errors import residuals
from turbogs_plugin.gsplat_bridge.host import GROUND_TRUTH, PREDICTION, STATISTICS
from turbogs_plugin.gsplat_bridge.sparse_pixels import gather_pixels
from turbogs_plugin.types import PARAMETER_NAMES, Cameras, Gaussians, GaussianStats, PixelSamples


class Info(dict):
    """A dict that can be referred to weakly: the graph knows it, and hosts put what the pass gave into it."""


class DifferentiableRender(NamedTuple):
    """A forward pass connected to autograd, zero in empty slots."""

    colors: Tensor  # [P, 3]
    alphas: Tensor  # [P]
    depths: Tensor | None  # [P] expected, along the camera's axis; None if not asked for
    means2d: Tensor  # [K, N, 2] pixels, zero where nothing is drawn; a leaf, with grad and absgrad after backward
    projected: Projected  # what was drawn, without gradients


def rasterize_differentiable(
    gaussians: Gaussians, cameras: Cameras, samples: PixelSamples, info: Info | None = None, **options: Any
) -> DifferentiableRender:
    """`rasterize` under torch autograd, with gradients to the Gaussians and none to the cameras.

    Args:
        gaussians: the model; any of its tensors may require gradients.
        info: where the backward pass finds prediction and ground truth, if anywhere, and then leaves its statistics.
        options: the fields of `RenderOptions`.

    Raises:
        InputError: as `Engine.render`; and at a second backward of one pass.
    """
    rendered = rasterize(
        gaussians.map(lambda value: value.detach().contiguous()),
        Cameras(cameras.viewmats.detach(), cameras.Ks.detach(), cameras.sizes),
        samples,
        **options,
    )
    projected = rendered.projected()
    means2d = projected.means2d.detach().requires_grad_(torch.is_grad_enabled())
    parameters = (value for _, value in gaussians.items())
    known = weakref.ref(Info() if info is None else info)
    colors, alphas, depths = _Pass.apply(rendered, samples, known, means2d, *parameters)
    return DifferentiableRender(colors, alphas, depths, means2d, projected)


class _Pass(torch.autograd.Function):
    """Connects a finished `Rendered` pass to autograd: its outputs to the parameters they depend on."""

    @staticmethod
    def forward(
        ctx, rendered: Rendered, samples: PixelSamples, info: weakref.ref[Info], means2d: Tensor, *parameters: Tensor
    ) -> tuple:
        ctx.rendered, ctx.samples, ctx.info, ctx.means2d, ctx.spent = rendered, samples, info, means2d, False
        ctx.set_materialize_grads(False)
        outputs = (rendered.colors, rendered.alphas, rendered.depths)
        return tuple(None if value is None else value.clone() for value in outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx, *upstream: Tensor | None) -> tuple:
        if ctx.spent:
            raise InputError("backward of one rendering a second time: sum the losses first, or render again")
        ctx.spent = True
        info = ctx.info() or {}
        errors = _sample_errors(info, ctx.samples)
        colors, alphas, depths = (None if value is None else value.contiguous() for value in upstream)
        screen = ctx.rendered.backward(
            torch.zeros_like(ctx.rendered.colors) if colors is None else colors,
            errors,
            with_statistics=True,  # among them the absolute gradients
            alpha_gradients=alphas,
            depth_gradients=depths,
        )
        records = screen.full_records()
        stats = GaussianStats.zeros(records.shape[1], records.device)
        gradients = screen.parameter_gradients(rows=False, stats=stats)
        ctx.means2d.absgrad = records[..., ScreenRecord.ABSOLUTE].clone()
        if errors is not None:
            info[STATISTICS] = stats
        means2d = records[..., ScreenRecord.MEAN].clone()
        return None, None, None, means2d, *(gradients.summed(name) for name in PARAMETER_NAMES)


def _sample_errors(info: dict[str, Any], samples: PixelSamples) -> Tensor | None:
    """[P] errors to carry to the Gaussians, or None where `info` has none."""
    errors = residuals(info)
    if errors is not None and errors.dim() == 3:
        errors = gather_pixels(errors[..., None], samples)[:, 0]
    if errors is not None and errors.shape != (len(samples),):
        raise InputError(
            f"info['{PREDICTION}'] and info['{GROUND_TRUTH}'] are of shape {(*errors.shape, 3)}: expected "
            f"{(len(samples), 3)}, as there are samples, or [C, H, W, 3]"
        )
    return errors
