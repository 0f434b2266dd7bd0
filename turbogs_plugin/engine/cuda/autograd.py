"""The CUDA rasterizer under torch autograd: two nodes, so that the projected means have a gradient of their own."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from turbogs_plugin.engine.cuda.raster import CudaRendered, CudaScreenGradients, rasterize_cuda
from turbogs_plugin.engine.layout import ScreenRecord
from turbogs_plugin.engine.reference.raster import DifferentiableRender
from turbogs_plugin.engine.rendered import DEFAULT_SETTINGS, RasterSettings
from turbogs_plugin.types import Cameras, Gaussians, PixelSamples


@dataclass
class _Pass:
    """What the two autograd nodes of a pass share."""

    rendered: CudaRendered
    screen: CudaScreenGradients | None = None


class _Project(torch.autograd.Function):
    """Parameters -> projected means. Its backward takes the whole screen record to the parameters."""

    @staticmethod
    def forward(ctx, shared: _Pass, means2d: Tensor, *parameters: Tensor) -> Tensor:
        ctx.shared = shared
        return means2d.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx, mean_gradients: Tensor) -> tuple:
        shared = ctx.shared
        screen = shared.screen
        if screen is None:  # only the means were used
            screen = shared.rendered.backward(torch.zeros_like(shared.rendered.colors))
        screen.records[..., ScreenRecord.MEAN] = mean_gradients
        gradients = screen.parameter_gradients(rows=False)
        shared.screen = None
        names = (name for name, _ in screen.gaussians.items())
        return None, None, *(gradients.summed(name) for name in names)


class _Composite(torch.autograd.Function):
    """Projected means -> samples. Its backward leaves the screen record for `_Project`, and `absgrad` on the means."""

    @staticmethod
    def forward(ctx, shared: _Pass, means2d: Tensor) -> tuple:
        ctx.shared = shared
        ctx.save_for_backward(means2d)
        rendered = shared.rendered
        ctx.set_materialize_grads(False)
        # Aliases: the tensors of `rendered` must not point back at this node.
        outputs = (rendered.colors, rendered.alphas, rendered.depths)
        return tuple(value if value is None else value.detach() for value in outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx, color_gradients, alpha_gradients, depth_gradients) -> tuple:
        (means2d,) = ctx.saved_tensors
        rendered = ctx.shared.rendered
        if color_gradients is None:
            color_gradients = torch.zeros_like(rendered.colors)
        screen = rendered.backward(
            color_gradients,
            with_statistics=True,  # for the absolute sums
            alpha_gradients=alpha_gradients,
            depth_gradients=depth_gradients,
        )
        ctx.shared.screen = screen
        records = screen.full_records()
        means2d.absgrad = records[..., ScreenRecord.ABSOLUTE].clone()
        return None, records[..., ScreenRecord.MEAN].clone()


def rasterize_differentiable_cuda(
    gaussians: Gaussians,
    cameras: Cameras,
    samples: PixelSamples,
    *,
    sh_degree: int | None = None,
    settings: RasterSettings = DEFAULT_SETTINGS,
    with_depth: bool = False,
) -> DifferentiableRender:
    """`engine.rendering.rasterize_differentiable` in CUDA. Gradients reach the parameters through `colors`,
    `alphas`, `depths` and, for Gaussians that some sample sees, `means2d`; the other arrays are constants."""
    rendered = rasterize_cuda(
        gaussians, cameras, samples, sh_degree=sh_degree, settings=settings, with_depth=with_depth
    )
    projected = rendered.projected()
    shared = _Pass(rendered)
    means2d = _Project.apply(shared, projected.means2d.contiguous(), *(value for _, value in gaussians.items()))
    if means2d.requires_grad:
        means2d.retain_grad()
    colors, alphas, depths = _Composite.apply(shared, means2d)
    return DifferentiableRender(
        colors=colors,
        alphas=alphas,
        depths=depths,
        means2d=means2d,
        conics=projected.conics,
        depths_per_gaussian=projected.depths,
        opacities=projected.opacities,
        radii=projected.radii,
        sizes=samples.sizes,
    )
