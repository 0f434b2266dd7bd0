"""`turbogs bench raster`: the rasterizer stage by stage, beside gsplat's dense one and beside its floors."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from turbogs_plugin import kernels
from turbogs_plugin.bench.clocks import Mark, Summary, back_to_back, copy_bandwidth, measure, summary
from turbogs_plugin.bench.floors import raster_counts, raster_floors
from turbogs_plugin.bench.gsplat_dense import bench_gsplat
from turbogs_plugin.bench.models import ring_cameras, spread_views, surface_gaussians, tile_samples
from turbogs_plugin.bench.precision import precision
from turbogs_plugin.errors import InputError
from turbogs_plugin.gaussians import load_ply
from turbogs_plugin.rendering import Rendered, Workspace, rasterize
from turbogs_plugin.scene import Scene
from turbogs_plugin.types import Cameras, Gaussians, GaussianStats

STAGES = {
    "raster_project": "projection",
    "raster_count_pairs": "pair count",
    "raster_sort_pairs": "pair sort",
    "raster_forward": "forward",
    "raster_backward": "backward",
    "projection_backward": "projection backward",
}
"""Operators of the library and the names their times go by."""


@contextmanager
def timed_operators(times: dict[str, list[tuple[Mark, Mark]]], device: torch.device) -> Iterator[None]:
    """Records a pair of marks around every call of the operators in `STAGES`."""
    originals = {name: getattr(torch.ops.turbogs, name) for name in STAGES}

    def wrap(name: str, operator: Callable) -> Callable:
        def call(*arguments):
            first = Mark(device)
            result = operator(*arguments)
            times[STAGES[name]].append((first, Mark(device)))
            return result

        return call

    for name, operator in originals.items():
        setattr(torch.ops.turbogs, name, wrap(name, operator))
    try:
        yield
    finally:
        for name, operator in originals.items():
            setattr(torch.ops.turbogs, name, operator)


@dataclass
class RasterBench:
    """What `turbogs bench raster` measures.

    Args:
        gaussians: sizes of the synthetic models; not used with `ply`.
        views: K; each with the rate of the pixel budget.
        rates: further rates, with the fewest views: 1 and 0.1 are compared with gsplat's dense passes of those views.
        pixel_budget: K times the rate (lambda).
        size: (width, height) of the synthetic cameras; not used with a scene.
        repeats: of each pass.
        ply: a trained model in the capture's own coordinates.
        libraries: other builds of the kernels, measured each in a process of its own.
    """

    gaussians: Sequence[int]
    views: Sequence[int]
    rates: Sequence[float]
    pixel_budget: float
    size: tuple[int, int]
    repeats: int
    ply: Path | None = None
    libraries: Sequence[Path] = ()

    def arguments(self) -> list[str]:
        """Of the command line that measures the same, the libraries left out."""
        values = {
            "--gaussians": self.gaussians,
            "--views": self.views,
            "--rates": self.rates,
            "--pixel-budget": [self.pixel_budget],
            "--size": self.size,
            "--repeats": [self.repeats],
            "--ply": [] if self.ply is None else [self.ply],
        }
        return [text for flag, given in values.items() if given for text in (flag, *map(str, given))]

    def run(self, scene: Scene | None, device: torch.device) -> dict[str, Any]:
        """The measurements, ready for JSON. `scene`: whose cameras to use; None: synthetic ones."""
        if self.ply is not None and scene is None:
            raise InputError("--ply needs --scene: the model lies in a capture's own coordinates")
        if scene is None:
            cameras = ring_cameras(max(self.views), *self.size, device)
        else:
            cameras = scene.train.cameras.to(device, torch.float32)
        if self.ply is None:
            models = [surface_gaussians(count, device) for count in self.gaussians]
        else:
            models = [load_ply(self.ply, scene.frame).map(lambda value: value.float().to(device).contiguous())]
        bandwidth = copy_bandwidth(device)
        passes, dense = [], []
        for model in models:
            settings = [(views, self.pixel_budget / views, False) for views in self.views]
            settings += [(min(self.views), rate, False) for rate in self.rates]
            settings.append((*settings[0][:2], True))
            for views, rate, density in settings:
                chosen = cameras.select(spread_views(views, len(cameras)))
                passes.append(self._measure(model, chosen, min(1.0, rate), density, device, bandwidth))
            chosen = cameras.select(spread_views(min(self.views), len(cameras)))
            dense.append({"gaussians": len(model), "views": len(chosen), **bench_gsplat(model, chosen, self.repeats)})
        return {
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
        on_kernels = device.type == "cuda" and kernels.available()
        workspace = Workspace(device) if on_kernels else None
        gradients = torch.randn(len(samples), 3, device=device) / len(samples)
        errors = torch.rand(len(samples), device=device)
        stats = GaussianStats.zeros(len(model), device) if density else None

        def render() -> Rendered:
            return rasterize(model, cameras, samples, workspace=workspace)

        def whole() -> None:
            render().backward(gradients, errors, stats).parameter_gradients(rows=False)

        measured: dict[str, Any] = {
            "gaussians": len(model),
            "views": len(cameras),
            "rate": rate,
            "density_sums": density,
            "samples": len(samples),
        }
        if not on_kernels:
            return {**measured, "forward": measure(render, self.repeats, device), **self._totals(whole, device)}
        torch.cuda.reset_peak_memory_stats(device)
        whole()
        times: dict[str, list[tuple[Mark, Mark]]] = defaultdict(list)
        with timed_operators(times, device):
            measure(whole, self.repeats, device)
        stages = {
            name: summary([first.until(last) for first, last in spans[-self.repeats :]])
            for name, spans in times.items()
        }
        counts = raster_counts(render(), samples)
        return {
            **measured,
            "stages": stages,
            **self._totals(whole, device),
            "counts": counts,
            "floors_ms": raster_floors(counts, bandwidth),
            "lost_passes": workspace.take_lost(wait=True),
            "workspace_bytes": workspace.bytes_held(),
            "peak_bytes": torch.cuda.max_memory_allocated(device),
        }

    def _totals(self, whole: Callable[[], None], device: torch.device) -> dict[str, Summary]:
        return {
            "forward_backward": measure(whole, self.repeats, device),
            "wall": back_to_back(whole, self.repeats, device),
        }


def other_build(library: Path, command: Sequence[str]) -> dict[str, Any]:
    """The same measurements by another build of the library, in a process of its own."""
    if not library.is_file():
        raise InputError(f"no such library: '{library}'")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "bench.json"
        arguments = [sys.executable, "-m", "turbogs_plugin.cli", "bench", "raster", *command, "--out", str(out)]
        environment = {**os.environ, kernels.LIBRARY_VARIABLE: str(library.resolve())}
        ended = subprocess.run(arguments, env=environment, capture_output=True, text=True, check=False)
        if ended.returncode:
            raise InputError(f"library '{library}': {ended.stderr.strip().splitlines()[-1]}")
        return json.loads(out.read_text(encoding="utf-8"))
