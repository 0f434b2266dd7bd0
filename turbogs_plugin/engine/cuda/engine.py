"""The CUDA engine, the twin of the reference on the kernels of csrc/."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from turbogs_plugin.engine.cuda import launches, library, training
from turbogs_plugin.engine.cuda.raster import (
    Buffers,
    CudaRendered,
    CudaScreenGradients,
    rasterize_cuda,
    ready,
    scene_of,
)
from turbogs_plugin.engine.cuda.workspace import Workspace
from turbogs_plugin.engine.exposures import Exposures
from turbogs_plugin.engine.protocol import MapUpdate
from turbogs_plugin.engine.render_pass import DEFAULT_OPTIONS, RenderOptions, ScreenRecords
from turbogs_plugin.engine.rules import LossTerms
from turbogs_plugin.engine.shared import PassMemory, SharedEngine
from turbogs_plugin.scene.photos import PhotoSamples
from turbogs_plugin.types import BLACK, Cameras, Gaussians, LossOutput, PixelSamples


class CudaEngine(SharedEngine):
    """`Engine` on one CUDA device, on torch's current stream, float32.

    Args:
        device: CUDA device of a training, whose passes share memory and never wait for the GPU (`Workspace`). None:
            each pass has memory of its own and waits once, to learn how many intersections it has.
    """

    def __init__(self, device: torch.device | None = None) -> None:
        self.workspace = None if device is None else Workspace(device)

    @property
    def overflow(self) -> Tensor | None:
        return None if self.workspace is None else self.workspace.overflow

    draw = staticmethod(training.sample_pixels)
    evaluate = staticmethod(training.sparse_loss)
    update = staticmethod(training.fused_step)
    expose = staticmethod(training.expose_colors)

    def render(
        self, gaussians: Gaussians, cameras: Cameras, samples: PixelSamples, options: RenderOptions = DEFAULT_OPTIONS
    ) -> CudaRendered:
        return rasterize_cuda(gaussians, cameras, samples, options, self.workspace)

    def screen_gradients(
        self,
        gaussians: Gaussians,
        cameras: Cameras,
        samples: PixelSamples,
        options: RenderOptions,
        plain: ScreenRecords,
    ) -> CudaScreenGradients:
        scene = scene_of(ready(gaussians), cameras, options)
        return CudaScreenGradients(scene, plain.records, plain.radii, self.overflow)

    def collect(self, sources: Sequence[ScreenRecords], views: Sequence[int], target: ScreenRecords, row: int) -> None:
        arrays = [array for source in sources for array in (source.records, source.radii)]
        library.launch(launches.CollectRecords(target.records, target.radii, list(views), row, arrays))

    def lend(self, memory: PassMemory | None) -> bool:
        if self.workspace is not None:
            self.workspace.lend(memory)
        return self.workspace is not None

    def gather(self, parts: Sequence[Tensor], first: int, counts: Sequence[int], seen: Tensor) -> Tensor:
        colors = Buffers(self.workspace, seen.device).floats("gathered_colors", sum(counts), 3)
        library.launch(launches.GatherColors(colors, list(counts), first, seen, self.overflow, list(parts)))
        return colors

    def supervise(self, terms: LossTerms, colors: Tensor, truth: PhotoSamples, update: MapUpdate) -> LossOutput:
        # The kernel gathers the photos' colours itself if the photos and the maps of each view begin at the same pixel,
        # as a trainer places them; a caller may place them otherwise.
        photos, starts = truth.photos.colors, update.maps.offsets[list(truth.samples.view_ids)]
        aligned = len(photos) == len(update.maps.errors) and truth.starts.tolist() == starts.tolist()
        targets = photos if aligned else truth.colors()
        shared = self.overflow, truth.background, self.workspace
        return training.sparse_loss(terms, colors, targets, truth.samples, truth.depths, update, *shared)

    def evaluate_and_learn(
        self, terms: LossTerms, colors: Tensor, targets: Tensor, samples: PixelSamples, update: MapUpdate
    ) -> LossOutput:
        shared = update, self.overflow, BLACK, self.workspace
        return training.sparse_loss(terms, colors, targets, samples, None, *shared)

    def learn_exposures(
        self, exposures: Exposures, colors: Tensor, gradients: Tensor, samples: PixelSamples, rate: float
    ) -> Tensor:
        return training.learn_exposures(exposures, colors, gradients, samples, rate, self.overflow)

    def settle(self, wait: bool = False) -> int:
        return 0 if self.workspace is None else self.workspace.take_lost(wait)

    def recover(self) -> None:
        if self.workspace is not None:
            self.workspace.take_lost(wait=True)
            self.workspace.status.zero_()
