"""`turbogs bench raster`: the rasterizer stage by stage, beside gsplat's dense one and beside its floors."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
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
    spread_views,
    surface_gaussians,
    tile_samples,
    trained_model,
)
from turbogs_plugin.bench.precision import precision
from turbogs_plugin.bench.recorder import Recorder
from turbogs_plugin.device import free_device_memory
from turbogs_plugin.engine import engine_of
from turbogs_plugin.engine.cuda.library import LIBRARY_VARIABLE
from turbogs_plugin.engine.cuda.raster import CudaRendered
from turbogs_plugin.engine.rendered import Rendered
from turbogs_plugin.errors import InputError
from turbogs_plugin.model.ply import load_ply, save_ply
from turbogs_plugin.scene import Scene
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


@dataclass
class RasterBench:
    """What `turbogs bench raster` measures.

    Args:
        gaussians: sizes of the models; not used with `ply`.
        views: K; each with the rate of the pixel budget.
        rates: further rates, with the fewest views: 1 and 0.1 are compared with gsplat's dense passes of those views.
        pixel_budget: K times the rate (lambda).
        size: (width, height) of the synthetic cameras; not used with a scene.
        repeats: of each pass.
        training: iterations of the models' training on a scene; without one they are synthetic.
        ply: models in the capture's own coordinates, in place of those trained here.
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
    ply: Sequence[Path] = ()
    libraries: Sequence[Path] = ()

    def __post_init__(self) -> None:
        for library in self.libraries:
            if not library.is_file():
                raise InputError(f"no such library: '{library}'")

    def arguments(self) -> list[str]:
        """Options of a command line that measures the same models, synthetic ones or files, without the libraries."""
        values = {
            "--gaussians": self.gaussians,
            "--views": self.views,
            "--rates": self.rates,
            "--pixel-budget": [self.pixel_budget],
            "--size": self.size,
            "--repeats": [self.repeats],
            "--ply": self.ply,
        }
        return [text for flag, given in values.items() if given for text in (flag, *map(str, given))]

    def described(self, scene: Scene | None) -> str:
        """Which models these are."""
        if self.ply:
            return ", ".join(path.name for path in self.ply)
        return "synthetic" if scene is None else f"trained for {self.training} iterations"

    def models(self, scene: Scene | None, device: torch.device) -> list[Gaussians]:
        """The models in host memory, so that the device holds the one that is timed.

        Args:
            scene: to train on, its photos in host memory, or whose frame the files' models come into.
            device: where to train; nothing is left there.
        """
        if self.ply:
            return [load_ply(path, scene.frame) for path in self.ply]
        if scene is None:
            return [surface_gaussians(count, torch.device("cpu")) for count in self.gaussians]
        placed = scene_on(scene, device)
        trained = [trained_model(placed, count, self.training, device, ()).map(Tensor.cpu) for count in self.gaussians]
        del placed
        free_device_memory(device)
        return trained

    def with_saved_models(self, scene: Scene | None, device: torch.device, folder: Path) -> RasterBench:
        """The same bench with its trained models as files in a folder.

        For several builds: what each of them trains would differ in the last bits.
        """
        if scene is None or self.ply:
            return self
        files = [folder / f"trained-{self.training}-{count}.ply" for count in self.gaussians]
        for model, file in zip(self.models(scene, device), files, strict=True):
            save_ply(model, file, scene.frame)
        return replace(self, ply=files)

    def run(self, scene: Scene | None, device: torch.device) -> dict[str, Any]:
        """The measurements, ready for JSON. `scene`: whose cameras to use; None: synthetic ones."""
        if self.ply and scene is None:
            raise InputError("--ply needs --scene: the model lies in a capture's own coordinates")
        if scene is None:
            cameras = ring_cameras(max(self.views), *self.size, device)
        else:
            cameras = scene.train.cameras.to(device, torch.float32)
        models = self.models(scene, device)
        bandwidth = copy_bandwidth(device)
        passes, dense = [], []
        for held in models:
            model = held.map(lambda value: value.to(device).contiguous())
            settings = [(views, self.pixel_budget / views, False) for views in self.views]
            settings += [(min(self.views), rate, False) for rate in self.rates]
            settings.append((*settings[0][:2], True))
            for views, rate, density in settings:
                chosen = cameras.select(spread_views(views, len(cameras)))
                passes.append(self._measure(model, chosen, min(1.0, rate), density, device, bandwidth))
            chosen = cameras.select(spread_views(min(self.views), len(cameras)))
            dense.append({"gaussians": len(model), "views": len(chosen), **bench_gsplat(model, chosen, self.repeats)})
        return {
            "scene": None if scene is None else scene.name,
            "image_size": cameras.sizes.max(axis=0).tolist(),
            "model": self.described(scene),
            "copy_bandwidth_bytes_per_s": bandwidth,
            "precision": precision(device),
            "passes": passes,
            "gsplat": dense,
        }

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

        measured: dict[str, Any] = {
            "gaussians": len(model),
            "views": len(cameras),
            "rate": rate,
            "density_sums": density,
            "samples": len(samples),
        }
        on_kernels = isinstance(render(), CudaRendered)
        if on_kernels:
            torch.cuda.reset_peak_memory_stats(device)
            whole()
            recorder = Recorder(device)
            with recorder.calls(*((torch.ops.turbogs, operator, stage) for operator, stage in STAGES.items())):
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


def other_build(library: Path, command: Sequence[str]) -> dict[str, Any]:
    """The same measurements by another build of the library, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "bench.json"
        arguments = [sys.executable, "-m", "turbogs_plugin.cli", "bench", "raster", *command, "--out", str(out)]
        environment = {**os.environ, LIBRARY_VARIABLE: str(library.resolve())}
        ended = subprocess.run(arguments, env=environment, capture_output=True, text=True, check=False)
        if ended.returncode:
            raise InputError(f"library '{library}': {ended.stderr.strip().splitlines()[-1]}")
        return json.loads(out.read_text(encoding="utf-8"))
