"""Counts of a pass, and the milliseconds that memory and arithmetic allow for them.

Bytes go by the bandwidth measured for a copy on the same machine; instructions by what the multiprocessors can issue.
A floor counts each array once, as if it were read and written without waste.
"""

from __future__ import annotations

import math

import torch

from turbogs_plugin.engine.cuda.raster import CudaRendered
from turbogs_plugin.engine.layout import BUCKET, WARP_SIZE
from turbogs_plugin.types import PixelSamples

FORWARD_INSTRUCTIONS, BACKWARD_INSTRUCTIONS = 23, 75
"""Instructions of the inner loops for one splat and 32 samples, as profiled."""

PARAMETER_FLOATS = 59
"""Parameters of a Gaussian with three bands."""

Counts = dict[str, int]


def raster_counts(rendered: CudaRendered, samples: PixelSamples) -> Counts:
    """What a pass of the kernels had to do."""
    views, gaussians = rendered._radii.shape[:2]
    on_screen = (rendered._radii > 0).any(dim=-1)  # [K, N]
    return {
        "gaussians": gaussians,
        "instances": views * gaussians,
        "visible": int(on_screen.sum()),
        "visible_gaussians": int(on_screen.any(dim=0).sum()),
        "intersections": int(rendered.num_intersections),
        "tiles": len(samples.tile_ids),
        "samples": len(samples),
        "items": len(rendered._forward.pixels.bucket_counts),
        **count_contributions(rendered),
    }


def count_contributions(rendered: CudaRendered) -> Counts:
    """How many splats the work items of a pass walked, and how many of these contributed."""
    forward = rendered._forward
    tile_starts, pixels = forward.tile_starts, forward.pixels
    buckets, chunks = pixels.bucket_counts.long(), pixels.chunks
    items = torch.arange(len(buckets), device=buckets.device)
    tiles = torch.arange(len(tile_starts) - 1, device=buckets.device)
    bases = (tile_starts[:-1].long() // BUCKET + tiles)[items // chunks]
    owners = torch.repeat_interleave(items, buckets)
    number = torch.arange(len(owners), device=buckets.device) - (buckets.cumsum(0) - buckets)[owners]
    words = pixels.masks[(bases[owners] + number) * chunks + owners % chunks]
    contributing = sum(int(((words >> bit) & 1).sum()) for bit in range(BUCKET))
    return {"walked": int(buckets.sum()) * BUCKET, "contributing": contributing}


def raster_floors(counts: Counts, bandwidth: float) -> dict[str, float]:
    """Milliseconds that each stage of the rasterizer cannot beat."""
    n, kn, visible, intersections, samples = (
        counts[name] for name in ("gaussians", "instances", "visible", "intersections", "samples")
    )
    properties = torch.cuda.get_device_properties(0)
    issue = 4 * properties.multi_processor_count * 1e3 * getattr(properties, "clock_rate", 1_980_000)  # warps a second
    slots = samples / max(1, counts["items"])
    instructions = {
        "forward": counts["walked"] * math.ceil(slots / WARP_SIZE) * FORWARD_INSTRUCTIONS,
        "backward": counts["contributing"] * math.ceil(slots / WARP_SIZE) * BACKWARD_INSTRUCTIONS,
    }
    traffic = {
        # parameters in; splats, cleared records and radii out
        "projection": 236 * n + (48 + 64) * visible + 8 * kn,
        "intersection count": 16 * counts["tiles"],
        # radii and splats in; keys out and in; ids out
        "intersection sort": 8 * kn + 32 * visible + 20 * intersections,
        "forward": 52 * intersections + 32 * samples,
        "backward": (52 + 64) * counts["contributing"] + 32 * samples,
    }
    return {stage: 1e3 * max(size / bandwidth, instructions.get(stage, 0) / issue) for stage, size in traffic.items()}


def step_floors(counts: Counts, bandwidth: float) -> dict[str, float]:
    """Milliseconds that each step of an iteration cannot beat. `counts`: of `raster_counts`, with `pixels` (of the K
    views) and `touched` (Gaussians updated)."""
    raster = raster_floors(counts, bandwidth)
    samples, touched = counts["samples"], counts["touched"]
    traffic = {
        # half errors and 16-bit stamps of every pixel of the views in, ids out
        "EPS": 4 * counts["pixels"] + 4 * samples,
        # id, photo, colour in; error and stamp in and out; gradient and error of the pixel out
        "gather+L+E": (4 + 3 + 12 + 2 * 4 + 12 + 4) * samples,
        # records and radii in; parameters and two moments of the touched in and out
        "solve+update": 64 * counts["visible"] + 8 * counts["instances"] + 3 * 2 * 4 * PARAMETER_FLOATS * touched,
    }
    forward = sum(raster[stage] for stage in ("projection", "intersection count", "intersection sort", "forward"))
    floors = {name: 1e3 * size / bandwidth for name, size in traffic.items()}
    return {**floors, "FWD": forward, "BWD": raster["backward"]}
