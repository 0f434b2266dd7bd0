"""Times the CUDA rasterizer stage by stage, beside gsplat's dense one and beside what memory and arithmetic allow.

    python -m turbogs_plugin.bench --gaussians 150000 600000 --views 10 5 3 --out bench.json

Times are of the GPU alone: before each repetition the GPU is kept busy until the host has enqueued the whole of it. The
floors are computed from the counts of the very pass that is timed.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin import kernels
from turbogs_plugin.rendering import rasterize_reference
from turbogs_plugin.rendering.cuda import CudaRendered, rasterize_cuda
from turbogs_plugin.rendering.workspace import Workspace
from turbogs_plugin.tiles import TILE_PIXELS, pixel_table
from turbogs_plugin.types import Cameras, Gaussians, GaussianStats, PixelSamples, TileGrid

STAGES = {
    "raster_project": "projection",
    "raster_sort_instances": "depth sort",
    "raster_sort_pairs": "pairs and tile sort",
    "raster_forward": "forward",
    "raster_backward": "backward",
    "projection_backward": "projection backward",
}
"""Operators of the library and the names their times go by."""

FORWARD_INSTRUCTIONS, BACKWARD_INSTRUCTIONS = 20, 56
"""Per (splat, sample): what the inner loops issue, counted in their source."""


def ring_cameras(count: int, width: int, height: int, device: str) -> Cameras:
    """Cameras on a ring that look at the origin."""
    viewmats = []
    for angle in np.linspace(0, 2 * math.pi, count, endpoint=False):
        position = torch.tensor([3.0 * math.sin(angle), -0.6, -3.0 * math.cos(angle)], dtype=torch.float64)
        forward = torch.nn.functional.normalize(-position, dim=0)
        right = torch.nn.functional.normalize(
            torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), forward), dim=0
        )
        rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ position
        viewmats.append(viewmat)
    focal = 0.9 * max(width, height)
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    sizes = np.array([[width, height]] * count, dtype=np.int64)
    return Cameras(torch.stack(viewmats).float(), intrinsics.repeat(count, 1, 1), sizes).to(device)


def surface_gaussians(count: int, device: str, seed: int = 0) -> Gaussians:
    """Flat Gaussians on a sphere, on the ground below it and on a far shell, about as large as their spacing."""
    generator = torch.Generator().manual_seed(seed)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    means = directions.clone()
    third = count // 3
    ground = 6 * torch.rand(third, 2, generator=generator) - 3
    means[:third] = torch.stack([ground[:, 0], torch.full((third,), 1.0), ground[:, 1]], dim=1)
    means[third : 2 * third] = 8 * directions[third : 2 * third]
    spacing = torch.full((count,), math.sqrt(4 * math.pi / third))
    spacing[:third] = math.sqrt(36 / third)
    spacing[third : 2 * third] *= 8
    scales = spacing.log()[:, None] + 0.5 * torch.randn(count, 3, generator=generator) - 0.3
    gaussians = Gaussians(
        means=means,
        quats=torch.randn(count, 4, generator=generator),
        scales=scales,
        opacities=2 * torch.randn(count, generator=generator),
        sh0=torch.randn(count, 1, 3, generator=generator),
        shN=0.1 * torch.randn(count, 15, 3, generator=generator),
    )
    # Neighbours in space are neighbours in memory, as after a Morton sort.
    cells = ((means - means.amin(dim=0)) / (means.amax(dim=0) - means.amin(dim=0)) * 1023).long()
    bits = torch.arange(10)
    code = (((cells[:, None, :] >> bits[:, None]) & 1) << (3 * bits[:, None] + torch.arange(3))).sum(dim=(1, 2))
    order = code.argsort()
    return gaussians.map(lambda value: value[order].to(device))


def tile_samples(sizes: np.ndarray, rate: float, device: str, seed: int) -> PixelSamples:
    """floor(rate * 256) random pixels of every tile, in cell order."""
    count = max(1, int(rate * TILE_PIXELS))
    table = pixel_table(sizes, device)  # [T, 256]
    generator = torch.Generator(device).manual_seed(seed)
    keys = torch.rand(table.shape, device=device, generator=generator).masked_fill_(table < 0, -1.0)
    places = keys.topk(count, dim=1).indices
    places = torch.where(table.gather(1, places) >= 0, places, TILE_PIXELS).sort(dim=1).values
    padded = torch.cat([table, table.new_full((len(table), 1), -1)], dim=1)
    tiles = torch.arange(len(TileGrid(sizes)), dtype=torch.int32, device=device)
    return PixelSamples(
        view_ids=tuple(range(len(sizes))),
        sizes=sizes,
        pixel_ids=padded.gather(1, places).reshape(-1),
        tile_ids=tiles,
        tile_offsets=torch.arange(len(tiles) + 1, dtype=torch.int32, device=device) * count,
    )


@contextmanager
def timed_operators(times: dict[str, list]) -> Iterator[None]:
    """Records a pair of events around every call of the operators in `STAGES`."""
    originals = {name: getattr(torch.ops.turbogs, name) for name in STAGES}

    def wrap(name: str, operator: Callable) -> Callable:
        def call(*arguments):
            events = [torch.cuda.Event(enable_timing=True) for _ in range(2)]
            events[0].record()
            result = operator(*arguments)
            events[1].record()
            times[STAGES[name]].append(events)
            return result

        return call

    for name, operator in originals.items():
        setattr(torch.ops.turbogs, name, wrap(name, operator))
    try:
        yield
    finally:
        for name, operator in originals.items():
            setattr(torch.ops.turbogs, name, operator)


def summary(milliseconds: list[float]) -> dict[str, float]:
    """Median and the 10th and 90th percentile."""
    low, high = np.percentile(milliseconds, [10, 90])
    return {"median_ms": statistics.median(milliseconds), "p10_ms": float(low), "p90_ms": float(high)}


def measure(function: Callable[[], object], repeats: int, busy_cycles: int = 20_000_000) -> dict[str, float]:
    """GPU time of `function`, with the GPU kept busy while the host enqueues it."""
    for _ in range(3):
        function()
    spans = []
    for _ in range(repeats):
        torch.cuda.synchronize()
        torch.cuda._sleep(busy_cycles)
        events = [torch.cuda.Event(enable_timing=True) for _ in range(2)]
        events[0].record()
        function()
        events[1].record()
        spans.append(events)
    torch.cuda.synchronize()
    return summary([first.elapsed_time(last) for first, last in spans])


def host_time(function: Callable[[], object], repeats: int) -> dict[str, float]:
    """Wall time of back-to-back calls, each call's share: what a training loop would see."""
    torch.cuda.synchronize()
    spans = []
    for _ in range(5):
        start = time.perf_counter()
        for _ in range(repeats):
            function()
        torch.cuda.synchronize()
        spans.append(1e3 * (time.perf_counter() - start) / repeats)
    return summary(spans)


def count_contributions(rendered: CudaRendered) -> dict[str, int]:
    """Walked and contributing (splat, work item) pairs of a pass."""
    forward = rendered._forward
    tile_starts, buckets, chunks = forward.tile_starts, forward.bucket_counts.long(), forward.chunks
    items = torch.arange(len(buckets), device=buckets.device)
    bases = (tile_starts[:-1].long() // 32 + torch.arange(len(tile_starts) - 1, device=buckets.device))[items // chunks]
    owners = torch.repeat_interleave(items, buckets)
    number = torch.arange(len(owners), device=buckets.device) - (buckets.cumsum(0) - buckets)[owners]
    words = forward.masks[(bases[owners] + number) * chunks + owners % chunks]
    contributing = sum(int(((words >> bit) & 1).sum()) for bit in range(32))
    return {"walked": int(buckets.sum()) * 32, "contributing": contributing}


def copy_bandwidth(device: str) -> float:
    """Bytes read and written in a second by a large copy."""
    source = torch.empty(1 << 30, dtype=torch.uint8, device=device)
    target = torch.empty_like(source)
    took = measure(lambda: target.copy_(source), 10)
    return 2 * source.numel() / (1e-3 * took["median_ms"])


def floors(counts: dict[str, int], bandwidth: float) -> dict[str, float]:
    """Milliseconds that each stage cannot beat, by bytes at the measured copy bandwidth or by instructions issued."""
    n, kn, visible, pairs, samples = (
        counts[name] for name in ("gaussians", "instances", "visible", "pairs", "samples")
    )
    properties = torch.cuda.get_device_properties(0)
    issue = 4 * properties.multi_processor_count * 1e3 * getattr(properties, "clock_rate", 1_980_000)  # warps a second
    slots = samples / max(1, counts["items"])
    instructions = {
        "forward": counts["walked"] * math.ceil(slots / 32) * FORWARD_INSTRUCTIONS,
        "backward": counts["contributing"] * math.ceil(slots / 32) * BACKWARD_INSTRUCTIONS,
    }
    traffic = {
        "projection": 236 * n + 52 * visible + 16 * kn,
        "depth sort": 68 * kn + 16 * kn,
        "pairs and tile sort": 40 * visible + 6 * pairs + 2 * 12 * pairs,
        "forward": 52 * pairs + 32 * samples,
        "backward": 64 * kn + (52 + 64) * counts["contributing"] + 32 * samples,
    }
    return {stage: 1e3 * max(size / bandwidth, instructions.get(stage, 0) / issue) for stage, size in traffic.items()}


def bench_pass(
    gaussians: Gaussians, cameras: Cameras, rate: float, repeats: int, bandwidth: float, density: bool
) -> dict[str, object]:
    """One (model, views, rate): stages, totals, counts, floors and memory."""
    device = str(gaussians.device)
    samples = tile_samples(cameras.sizes, rate, device, seed=1)
    workspace = Workspace(device)
    gradients = torch.randn(len(samples), 3, device=device) / len(samples)
    errors = torch.rand(len(samples), device=device)
    stats = GaussianStats.zeros(len(gaussians), device) if density else None

    def render() -> CudaRendered:
        return rasterize_cuda(gaussians, cameras, samples, workspace=workspace)

    def whole() -> None:
        render().backward(gradients, errors, stats).parameter_gradients(rows=False)

    torch.cuda.reset_peak_memory_stats()
    whole()
    times: dict[str, list] = defaultdict(list)
    with timed_operators(times):
        measure(whole, repeats)
    stages = {name: summary([a.elapsed_time(b) for a, b in events[3:]]) for name, events in times.items()}
    rendered = render()
    counts = {
        "gaussians": len(gaussians),
        "instances": len(gaussians) * len(cameras),
        "visible": int((rendered._radii > 0).any(dim=-1).sum()),
        "pairs": int(rendered.num_pairs),
        "tiles": len(samples.tile_ids),
        "samples": len(samples),
        "items": len(rendered._forward.bucket_counts),
        **count_contributions(rendered),
    }
    return {
        "views": len(cameras),
        "rate": rate,
        "density_sums": density,
        "stages": stages,
        "forward_backward": measure(whole, repeats),
        "host": host_time(whole, repeats),
        "counts": counts,
        "floors_ms": floors(counts, bandwidth),
        "lost_passes": workspace.take_lost(wait=True),
        "workspace_bytes": workspace.bytes_held(),
        "peak_bytes": torch.cuda.max_memory_allocated(),
    }


def bench_gsplat(gaussians: Gaussians, cameras: Cameras, repeats: int) -> dict[str, object]:
    """gsplat's dense forward and backward pass of the same views."""
    import gsplat

    leaves = gaussians.map(lambda value: value.clone().requires_grad_())
    width, height = (int(side) for side in cameras.sizes[0])
    weights = torch.randn(len(cameras), height, width, 3, device=gaussians.device)

    def whole(packed: bool) -> None:
        images, _, _ = gsplat.rasterization(
            leaves.means,
            leaves.quats,
            leaves.scales.exp(),
            leaves.opacities.sigmoid(),
            torch.cat([leaves.sh0, leaves.shN], dim=1),
            cameras.viewmats,
            cameras.Ks,
            width,
            height,
            sh_degree=3,
            packed=packed,
            absgrad=True,
        )
        torch.autograd.grad((images * weights).sum(), [value for _, value in leaves.items()])

    return {
        "version": gsplat.__version__,
        "unpacked": measure(lambda: whole(False), repeats),
        "packed": measure(lambda: whole(True), repeats),
    }


def precision(device: str) -> dict[str, float]:
    """Errors of this build against the reference in float64: forward, and relative L2 of the screen records."""
    gaussians, cameras = surface_gaussians(20_000, device, seed=3), ring_cameras(3, 320, 240, device)
    samples = tile_samples(cameras.sizes, 0.3, device, seed=4)
    upstream = torch.randn(len(samples), 3, device=device)
    ours = rasterize_cuda(gaussians, cameras, samples)
    exact = rasterize_reference(gaussians.map(Tensor.double), cameras.to(dtype=torch.float64), samples)
    difference = (ours.colors - exact.colors).abs()
    errors = {"forward_max": float(difference.max()), "forward_mean": float(difference.mean())}
    errors["forward_beyond_1e-4"] = float((difference.amax(dim=1) > 1e-4).double().mean())
    records, wanted = ours.backward(upstream).full_records(), exact.backward(upstream.double()).full_records()
    for name, column in {
        "mean": slice(0, 2),
        "conic": slice(2, 5),
        "color": slice(5, 8),
        "opacity": slice(8, 9),
    }.items():
        relative = (records[..., column] - wanted[..., column]).norm() / wanted[..., column].norm()
        errors[f"{name}_gradient"] = float(relative)
    return errors


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m turbogs_plugin.bench", description=__doc__.splitlines()[0])
    parser.add_argument("--gaussians", type=int, nargs="+", default=[150_000, 600_000])
    parser.add_argument("--views", type=int, nargs="+", default=[10, 5, 3])
    parser.add_argument("--pixel-budget", type=float, default=1.0, help="views times rate (lambda)")
    parser.add_argument(
        "--rates", type=float, nargs="*", default=[1.0, 0.1], help="further rates, with the fewest views"
    )
    parser.add_argument("--size", type=int, nargs=2, default=[841, 1500], metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--scene", type=Path, help="a capture, for its cameras; then --ply too")
    parser.add_argument("--ply", type=Path, help="a trained model in place of the synthetic ones")
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--no-gsplat", action="store_true")
    parser.add_argument("--out", type=Path, help="where the JSON goes; standard output where absent")
    options = parser.parse_args()
    if (options.scene is None) != (options.ply is None):
        parser.error("--scene and --ply go together: the model must lie in the capture's own coordinates")
    kernels.require()
    device = "cuda:0"
    if options.ply is not None:
        from turbogs_plugin.gaussians import load_ply
        from turbogs_plugin.scene import load_scene

        scene = load_scene(options.scene)
        cameras = scene.train.cameras.to(device, torch.float32)
        models = [load_ply(options.ply, scene.frame).map(lambda value: value.float().to(device).contiguous())]
    else:
        cameras = ring_cameras(max(options.views), *options.size, device)
        models = [surface_gaussians(count, device) for count in options.gaussians]
    bandwidth = copy_bandwidth(device)
    report: dict[str, object] = {
        "device": torch.cuda.get_device_name(0),
        "torch": torch.__version__,
        "library": {"path": kernels.library_path().name, "architectures": kernels.architectures()},
        "copy_bandwidth_bytes_per_s": bandwidth,
        "precision": precision(device),
        "passes": [],
        "gsplat": [],
    }
    for gaussians in models:
        settings = [(views, options.pixel_budget / views, False) for views in options.views]
        settings += [(min(options.views), rate, False) for rate in options.rates]
        settings.append((*settings[0][:2], True))
        for views, rate, density in settings:
            chosen = cameras.select(np.linspace(0, len(cameras) - 1, views).round().astype(int).tolist())
            report["passes"].append(bench_pass(gaussians, chosen, min(1.0, rate), options.repeats, bandwidth, density))
        if not options.no_gsplat:
            chosen = cameras.select(np.linspace(0, len(cameras) - 1, min(options.views)).round().astype(int).tolist())
            dense = bench_gsplat(gaussians, chosen, options.repeats)
            report["gsplat"].append({"gaussians": len(gaussians), "views": len(chosen), **dense})
    text = json.dumps(report, indent=2)
    if options.out is None:
        print(text)
    else:
        options.out.write_text(text + "\n")
        for entry in report["passes"]:
            stages = "  ".join(f"{name} {value['median_ms']:.3f}" for name, value in entry["stages"].items())
            total = entry["forward_backward"]["median_ms"]
            print(
                f"M={entry['counts']['gaussians']} K={entry['views']} r={entry['rate']:.2f}: {total:.3f} ms | {stages}"
            )
        for entry in report["gsplat"]:
            times = ", ".join(f"{kind} {entry[kind]['median_ms']:.3f} ms" for kind in ("unpacked", "packed"))
            print(f"gsplat dense, M={entry['gaussians']} K={entry['views']}: {times}")


if __name__ == "__main__":
    main()
