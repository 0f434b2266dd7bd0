"""`turbogs bench raster`: the rasterizer stage by stage, beside gsplat's dense one and beside its floors."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.bench.clocks import back_to_back, copy_bandwidth, device_times, measure
from turbogs_plugin.bench.floors import raster_counts, raster_floors
from turbogs_plugin.bench.gsplat_dense import bench_gsplat
from turbogs_plugin.bench.models import (
    TRAINING_ITERATIONS,
    ring_cameras,
    surface_gaussians,
    tile_samples,
    trained_model,
)
from turbogs_plugin.bench.precision import precision
from turbogs_plugin.bench.recorder import Recorder
from turbogs_plugin.device import free_device_memory
from turbogs_plugin.engine import engine_of
from turbogs_plugin.engine.cuda import library
from turbogs_plugin.engine.cuda.raster import CudaRendered
from turbogs_plugin.engine.rendered import Rendered
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene import Scene
from turbogs_plugin.scene.geometry import evenly
from turbogs_plugin.study.cell import scene_on
from turbogs_plugin.types import Cameras, Gaussians, GaussianStats

STAGES = {
    "raster_project": "projection",
    "raster_count_intersections": "intersection count",
    "raster_sort_intersections": "intersection sort",
    "raster_forward": "forward",
    "raster_backward": "backward",
    "projection_backward": "projection backward",
}
"""Operators of the library, and the stage that each of them is."""


def stages_recorded(recorder: Recorder) -> AbstractContextManager[None]:
    """While entered, each launch of a stage is recorded under the stage's name."""
    return recorder.calls(*((library.operators, operator, stage) for operator, stage in STAGES.items()))


@dataclass
class RasterBench:
    """What `turbogs bench raster` measures.

    Args:
        gaussians: sizes of the models.
        views: K; each with the rate of the pixel budget.
        rates: further rates, with the fewest views: 1 and 0.1 are compared with gsplat's dense passes of those views.
        pixel_budget: K times the rate (lambda).
        size: (width, height) of the synthetic cameras; not used with a scene.
        repeats: of each pass.
        training: iterations of the models' training on a scene; without one they are synthetic.
        libraries: other builds of the kernels, measured each in a process of its own.

    Raises:
        InputError: a library that is not there.
    """

    gaussians: Sequence[int]
    views: Sequence[int]
    rates: Sequence[float]
    pixel_budget: float
    size: tuple[int, int]
    repeats: int
    training: int = TRAINING_ITERATIONS
    libraries: Sequence[Path] = ()

    def __post_init__(self) -> None:
        for path in self.libraries:
            if not path.is_file():
                raise InputError(f"no such library: '{path}'")

    def models(self, scene: Scene | None, device: torch.device) -> list[Gaussians]:
        """The models in host memory, so that the device holds the one that is timed.

        Args:
            scene: to train on, its photos in host memory; None: the models are synthetic.
            device: where to train; nothing is left there.
        """
        if scene is None:
            return [surface_gaussians(count, torch.device("cpu")) for count in self.gaussians]
        placed = scene_on(scene, device)
        trained = [trained_model(placed, count, self.training, device, ()).map(Tensor.cpu) for count in self.gaussians]
        del placed
        free_device_memory(device)
        return trained

    def cameras(self, scene: Scene | None) -> Cameras:
        """Those of a scene; where there is none, synthetic ones."""
        if scene is None:
            return ring_cameras(max(self.views), *self.size, torch.device("cpu"))
        return scene.train.cameras.to("cpu", torch.float32)

    def run(self, models: Sequence[Gaussians], cameras: Cameras, device: torch.device) -> dict[str, Any]:
        """The measurements, ready for JSON, of models and cameras in host memory."""
        cameras = cameras.to(device)
        bandwidth = copy_bandwidth(device)
        passes, dense = [], []
        for held in models:
            model = held.map(lambda value: value.to(device).contiguous())
            settings = [(views, self.pixel_budget / views, False) for views in self.views]
            settings += [(min(self.views), rate, False) for rate in self.rates]
            settings.append((*settings[0][:2], True))
            for views, rate, density in settings:
                chosen = cameras.select(evenly(len(cameras), views))
                passes.append(self._measure(model, chosen, min(1.0, rate), density, device, bandwidth))
            chosen = cameras.select(evenly(len(cameras), min(self.views)))
            dense.append({"gaussians": len(model), "views": len(chosen), **bench_gsplat(model, chosen, self.repeats)})
        about = {"image_size": cameras.sizes.max(axis=0).tolist(), "copy_bandwidth_bytes_per_s": bandwidth}
        return about | {"precision": precision(device), "passes": passes, "gsplat": dense}

    def _measure(
        self, model: Gaussians, cameras: Cameras, rate: float, density: bool, device: torch.device, bandwidth: float
    ) -> dict[str, Any]:
        """One (model, views, rate): stages, totals, counts, floors and memory."""
        samples = tile_samples(cameras.sizes, rate, device, seed=1)
        engine = engine_of(device, for_training=True)
        gradients = torch.randn(len(samples), 3, device=device) / len(samples)
        errors = torch.rand(len(samples), device=device)
        stats = GaussianStats.zeros(len(model), device) if density else None

        def render() -> Rendered:
            return engine.render(model, cameras, samples)

        def whole() -> None:
            screen = render().backward(gradients, errors, with_statistics=density)
            screen.parameter_gradients(rows=False, stats=stats)

        measured: dict[str, Any] = {"gaussians": len(model), "views": len(cameras), "rate": rate}
        measured |= {"density_sums": density, "samples": len(samples)}
        on_kernels = isinstance(render(), CudaRendered)
        if on_kernels:
            torch.cuda.reset_peak_memory_stats(device)
            whole()
            recorder = Recorder(device)
            with stages_recorded(recorder):
                measure(whole, self.repeats, device)
            spans = recorder.spans.items()
            measured["stages"] = {stage: device_times(calls[-self.repeats :]) for stage, calls in spans}
        else:
            measured["forward"] = measure(render, self.repeats, device)
        measured["forward_backward"] = measure(whole, self.repeats, device)
        measured["wall"] = back_to_back(whole, self.repeats, device)
        if not on_kernels:
            visible = (render().projected().radii > 0).any(dim=-1).any(dim=0)  # [N]
            return {**measured, "counts": {"visible_gaussians": int(visible.sum())}}
        counts = raster_counts(render(), samples)
        return {
            **measured,
            "counts": counts,
            "floors_ms": raster_floors(counts, bandwidth),
            "lost_passes": engine.settle(wait=True),
            "workspace_bytes": engine.bytes_held,
            "peak_bytes": torch.cuda.max_memory_allocated(device),
        }
