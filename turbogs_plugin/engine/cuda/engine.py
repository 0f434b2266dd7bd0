"""The CUDA engine: the reference's twin on the kernels of csrc/."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.engine import shared
from turbogs_plugin.engine.cuda import training
from turbogs_plugin.engine.cuda.raster import CudaRendered, CudaScreenGradients, rasterize_cuda
from turbogs_plugin.engine.cuda.workspace import Workspace
from turbogs_plugin.engine.moments import GaussianMoments
from turbogs_plugin.engine.rendered import DEFAULT_SETTINGS, RasterSettings
from turbogs_plugin.engine.rules import DrawRule, LossTerms, UpdateRule
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.scene.photos import PhotoSamples
from turbogs_plugin.types import Cameras, Gaussians, GaussianStats, LossOutput, PixelSamples, Step


class CudaEngine:
    """`Engine` on one CUDA device, on torch's current stream, float32.

    Args:
        device: of the training whose passes share memory and never wait for the GPU (`Workspace`). None: each pass has
            memory of its own and waits once, to learn how many intersections it has.
    """

    def __init__(self, device: torch.device | None = None) -> None:
        self.workspace = None if device is None else Workspace(device)

    def draw(self, rule: DrawRule, maps: ErrorMaps, view_ids: tuple[int, ...], rate: float, step: Step) -> PixelSamples:
        return training.sample_pixels(**shared.draw_arguments(rule, maps, view_ids, rate, step))

    def render(
        self,
        gaussians: Gaussians,
        cameras: Cameras,
        samples: PixelSamples,
        *,
        sh_degree: int | None = None,
        settings: RasterSettings = DEFAULT_SETTINGS,
        with_depth: bool = False,
    ) -> CudaRendered:
        return rasterize_cuda(
            gaussians,
            cameras,
            samples,
            sh_degree=sh_degree,
            settings=settings,
            with_depth=with_depth,
            workspace=self.workspace,
        )

    def evaluate(self, terms: LossTerms, colors: Tensor, targets: Tensor, samples: PixelSamples) -> LossOutput:
        return training.sparse_loss(colors, targets, samples, terms)

    def supervise(
        self,
        terms: LossTerms,
        colors: Tensor,
        truth: PhotoSamples,
        maps: ErrorMaps,
        step: Step,
        nonfinite_losses: Tensor | None = None,
    ) -> LossOutput:
        # The kernel gathers the truth itself where photos and maps of each view begin at the same pixel. With only one
        # of the two in host memory they do not.
        photos = truth.photos.colors
        aligned = len(photos) == len(maps.errors) and np.array_equal(
            truth.starts, maps.offsets[list(truth.samples.view_ids)]
        )
        return training.sparse_loss(
            colors,
            photos if aligned else truth.colors(),
            truth.samples,
            terms,
            update=training.MapUpdate(maps, step, self._overflow),
            nonfinite_losses=nonfinite_losses,
        )

    def learn(
        self,
        maps: ErrorMaps,
        samples: PixelSamples,
        colors: Tensor,
        output: LossOutput,
        step: Step,
        nonfinite_losses: Tensor | None = None,
    ) -> None:
        shared.learn(maps, samples, colors, output, step, nonfinite_losses, self._overflow)

    def update(
        self,
        rule: UpdateRule,
        screen: CudaScreenGradients,
        gaussians: Gaussians,
        moments: GaussianMoments,
        stats: GaussianStats | None,
    ) -> None:
        training.fused_step(screen, gaussians, moments, rule, stats)

    def settle(self, wait: bool = False) -> int:
        return 0 if self.workspace is None else self.workspace.take_lost(wait)

    @property
    def bytes_held(self) -> int:
        return 0 if self.workspace is None else self.workspace.bytes_held()

    @property
    def _overflow(self) -> Tensor | None:
        """[1] int32 on the device, not 0 while iterations do nothing; None where that cannot be."""
        return None if self.workspace is None else self.workspace.overflow
