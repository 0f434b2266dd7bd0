"""A rendering pass under torch autograd, for losses written in plain torch: one wrapper, whatever the engine."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from turbogs_plugin.engine.layout import ScreenRecord
from turbogs_plugin.engine.render import rasterize
from turbogs_plugin.engine.render_pass import Projected, Rendered
from turbogs_plugin.errors import InputError
from turbogs_plugin.types import PARAMETER_NAMES, Cameras, Gaussians, GaussianStats, PixelSamples


class PassObserver(Protocol):
    """Takes part in the backward pass beside the loss. It must keep no reference to the pass's results: the graph holds
    the observer, and would keep itself alive."""

    def pixel_errors(self) -> Tensor | None:
        """[P] errors to carry to the Gaussians, or None. Called when the backward pass begins."""
        ...

    def passed(self, stats: GaussianStats, view_losses: Tensor) -> None:
        """Receive the pass's statistics and [N] each Gaussian's share of the loss, both for the errors given before."""
        ...


@dataclass
class DifferentiableRender:
    """A forward pass connected to autograd.

    Args:
        colors: [P, 3]. alphas: [P]. depths: [P] expected depth along the camera's axis, or None if not asked for. All
            are zero in empty slots.
        means2d: [K, N, 2] pixels, zero where a Gaussian is not drawn. A leaf: after backward it has ``grad`` and, as
            in gsplat with ``absgrad=True``, ``absgrad``. No gradient flows from it to the model.
        projected: the projection that was drawn, without gradients.
    """

    colors: Tensor
    alphas: Tensor
    depths: Tensor | None
    means2d: Tensor
    projected: Projected


def rasterize_differentiable(
    gaussians: Gaussians, cameras: Cameras, samples: PixelSamples, observer: PassObserver | None = None, **options: Any
) -> DifferentiableRender:
    """`rasterize` under torch autograd, with gradients to the Gaussians and none to the cameras.

    Args:
        gaussians: the model; any of its tensors may require gradients.
        observer: of the backward pass.
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
    colors, alphas, depths = _Pass.apply(rendered, observer, means2d, *parameters)
    return DifferentiableRender(colors, alphas, depths, means2d, projected)


class _Pass(torch.autograd.Function):
    """Connects a finished `Rendered` pass to autograd: its outputs to the parameters they depend on."""

    @staticmethod
    def forward(ctx, rendered: Rendered, observer: PassObserver | None, means2d: Tensor, *parameters: Tensor) -> tuple:
        ctx.rendered, ctx.observer, ctx.means2d, ctx.spent = rendered, observer, means2d, False
        ctx.set_materialize_grads(False)
        outputs = (rendered.colors, rendered.alphas, rendered.depths)
        return tuple(None if value is None else value.clone() for value in outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx, *upstream: Tensor | None) -> tuple:
        if ctx.spent:
            raise InputError("backward of one rendering a second time: sum the losses first, or render again")
        ctx.spent = True
        errors = None if ctx.observer is None else ctx.observer.pixel_errors()
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
        if ctx.observer is not None:
            ctx.observer.passed(stats, gradients.view_losses[0])
        means2d = records[..., ScreenRecord.MEAN].clone()
        return None, None, means2d, *(gradients.summed(name) for name in PARAMETER_NAMES)
