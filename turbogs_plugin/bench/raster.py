"""`turbogs bench raster`: the rasterizer stage by stage, beside gsplat's dense one and beside its floors."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any

import gsplat
import torch

from turbogs_plugin.bench.floors import raster_counts, raster_floors
from turbogs_plugin.bench.timing import Recorder, back_to_back, copy_bandwidth, device_times, measure
from turbogs_plugin.bench.workloads import PIXEL_BUDGET, tile_samples
from turbogs_plugin.engine import engine_of
from turbogs_plugin.engine.cuda import library
from turbogs_plugin.engine.cuda.raster import CudaRendered
from turbogs_plugin.engine.render_pass import Rendered
from turbogs_plugin.scene import Scene
from turbogs_plugin.scene.geometry import evenly
from turbogs_plugin.types import Cameras, Gaussians, GaussianStats

STAGES = {
    "raster_project": "projection",
    "raster_count_intersections": "intersection count",
    "raster_sort_intersections": "intersection sort",
    "raster_forward": "forward",
    "raster_backward": "backward",
    "projection_backward": "projection backward",
}
"""Operator of the library -> the stage that it is."""

RATES = (1.0, 0.1)
"""Sampling rates that are timed with the fewest views, beside the rate of the pixel budget: 1 is a dense pass."""


def bench_raster(scene: Scene, models: Iterable[Gaussians], views: Sequence[int], repeats: int) -> dict[str, Any]:
    """Time the rasterizer's passes, for each model and K with the rate of the pixel budget, and gsplat's dense ones of
    the fewest views: numbers ready for JSON."""
    fewest, passes, dense = min(views), [], []
    settings = [(count, PIXEL_BUDGET / count, False) for count in views] + [(fewest, rate, False) for rate in RATES]
    settings.append((views[0], PIXEL_BUDGET / views[0], True))
    for model in models:
        cameras = scene.train.cameras.to(model.device, torch.float32)
        bandwidth = copy_bandwidth(model.device)
        for count, rate, density in settings:
            chosen = cameras.select(evenly(len(cameras), count))
            passes.append(time_passes(model, chosen, min(1.0, rate), density, repeats, bandwidth))
        chosen = cameras.select(evenly(len(cameras), fewest))
        dense.append({"gaussians": len(model), "views": len(chosen), **time_gsplat(model, chosen, repeats)})
    return {
        "scene": scene.name,
        "image_size": scene.train.cameras.sizes.max(axis=0).tolist(),
        "copy_bandwidth_bytes_per_s": bandwidth,
        "passes": passes,
        "gsplat": dense,
    }


def time_passes(
    model: Gaussians, cameras: Cameras, rate: float, density: bool, repeats: int, bandwidth: float
) -> dict[str, Any]:
    """Times of the stages and of forward and backward pass, counts and floors. `density`: with the sums that density
    control needs."""
    device = model.device
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
    if isinstance(render(), CudaRendered):
        whole()
        recorder = Recorder(device)
        with recorder.calls(*((library.operators, operator, stage) for operator, stage in STAGES.items())):
            measure(whole, repeats, device)
        measured["stages"] = {stage: device_times(calls[-repeats:]) for stage, calls in recorder.spans.items()}
    measured["forward_backward"] = measure(whole, repeats, device)
    measured["wall"] = back_to_back(whole, repeats, device)
    rendered = render()
    if isinstance(rendered, CudaRendered):
        counts = raster_counts(rendered, samples)
        measured |= {"counts": counts, "floors_ms": raster_floors(counts, bandwidth)}
        measured["lost_passes"] = engine.settle(wait=True)
    return measured


def time_gsplat(model: Gaussians, cameras: Cameras, repeats: int) -> dict[str, Any]:
    """Times of gsplat's forward and backward pass over every pixel, or why there are none."""
    if not model.means.is_cuda:
        return {"version": gsplat.__version__, "reason": "gsplat's rasterization needs a GPU"}
    leaves = model.map(lambda value: value.clone().requires_grad_())
    width, height = (int(side) for side in cameras.sizes[0])
    weights = torch.randn(len(cameras), height, width, 3, device=model.device)

    def whole(packed: bool) -> None:
        shapes = leaves.means, leaves.quats, leaves.scales.exp(), leaves.opacities.sigmoid()
        colors, views = torch.cat([leaves.sh0, leaves.shN], dim=1), (cameras.viewmats, cameras.Ks, width, height)
        images, _, _ = gsplat.rasterization(
            *shapes, colors, *views, sh_degree=leaves.sh_degree, packed=packed, absgrad=True
        )
        torch.autograd.grad((images * weights).sum(), [value for _, value in leaves.items()])

    ways = {"unpacked": partial(whole, False), "packed": partial(whole, True)}
    return {"version": gsplat.__version__} | {name: measure(way, repeats, model.device) for name, way in ways.items()}


def raster_lines(measured: dict[str, Any]) -> list[str]:
    """One line for each pass, and one for gsplat's dense pass."""
    lines = []
    for entry in measured["passes"]:
        parts = [f"{name} {value['median_ms']:.3f}" for name, value in entry.get("stages", {}).items()]
        lines.append(
            f"M={entry['gaussians']} K={entry['views']} r={entry['rate']:.2f}"
            f"{' with density sums' if entry['density_sums'] else ''}: {entry['forward_backward']['median_ms']:.3f} ms"
            + (f" | {'  '.join(parts)}" if parts else "")
        )
    for entry in measured["gsplat"]:
        times = [f"{kind} {entry[kind]['median_ms']:.3f} ms" for kind in ("unpacked", "packed") if kind in entry]
        text = ", ".join(times) or entry["reason"]
        lines.append(f"gsplat {entry['version']} dense, M={entry['gaussians']} K={entry['views']}: {text}")
    return lines
