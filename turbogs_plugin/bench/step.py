"""`turbogs bench step`: a whole iteration of training and each of its steps, beside their floors."""

from __future__ import annotations

import copy
import gc
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.bench.floors import raster_counts, step_floors
from turbogs_plugin.bench.timing import (
    BLOCKS,
    Mark,
    Recorder,
    back_to_back,
    copy_bandwidth,
    device_times,
    keep_busy,
    recorded,
    summary,
)
from turbogs_plugin.bench.workloads import PIXEL_BUDGET, train, trainer_of
from turbogs_plugin.config.configuration import Config, load_config
from turbogs_plugin.device import synchronize
from turbogs_plugin.engine.cuda.raster import CudaRendered
from turbogs_plugin.model.row_order import in_order_of_space
from turbogs_plugin.model.torch_file import leaves
from turbogs_plugin.scene import Scene
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import Gaussians

NO_EVENTS = 1 << 20
"""Iteration of the first density event, which is never reached. Statistics are kept as in any training."""
FIRST_EVENT = {"refine_from", "refine_start_iter"}
"""Setting of the first density event, by its name in each kind of density control."""
RATE_FACTOR = 1e-3
"""Factor of the learning rates. Small steps take as long as large ones, and the timed model hardly changes."""
WARMUP_ITERATIONS = {"cuda": 40, "cpu": 2}
"""On a GPU more than the workspace's early passes, so that its buffers have their steady size."""


def bench_step(
    scene: Scene, models: Iterable[Gaussians], views: Sequence[int], repeats: int, overrides: Sequence[str] = ()
) -> dict[str, Any]:
    """Time iterations of training, for each model with each number of views K. Returns numbers ready for JSON.

    Args:
        scene: capture with its photos on the models' device, or every trainer copies them.
        overrides: changes of the configuration that is timed.
    """
    passes = []
    for model in models:
        device = model.device
        bandwidth = copy_bandwidth(device)
        for count in views:
            config = timed_config(overrides, count)
            config = config.changed(train={"sh_degree": min(config.train.sh_degree, model.sh_degree)})
            gc.collect()  # of the trainer before, whose memory would count as held
            held = torch.cuda.memory_allocated(device) if device.type == "cuda" else 0
            trainer = trainer_of(config, scene, model, device)
            trainer.iteration = config.train.sh_degree  # every band is in use
            train(trainer, WARMUP_ITERATIONS[device.type])
            measured = time_iterations(trainer, repeats, bandwidth)
            measured["memory_bytes"] = memory(trainer, scene, measured.pop("peak"), held)
            measured["density_event"] = density_event(trainer, overrides)
            passes.append(measured)
            del trainer
    return {
        "scene": scene.name,
        "image_size": scene.train.cameras.sizes.max(axis=0).tolist(),
        "training_views": len(scene.train),
        "overrides": list(overrides),
        "copy_bandwidth_bytes_per_s": bandwidth,
        "passes": passes,
    }


def timed_config(overrides: Sequence[str], views: int) -> Config:
    """The configuration that is timed with K views."""
    config = load_config("turbogs", overrides).without_plan()
    rates = config.optimizer["learning_rates"]
    return config.changed(
        train={"iterations": 2 * NO_EVENTS, "refine_until": 2 * NO_EVENTS - 1, "sh_interval": 1},
        schedule={"type": "fixed", "views": views, "pixel_budget": PIXEL_BUDGET},
        density=dict.fromkeys(FIRST_EVENT & config.density.keys(), NO_EVENTS),
        optimizer={"learning_rates": {**rates, "batch_scale": RATE_FACTOR * rates["batch_scale"]}},
    )


def time_iterations(trainer: Trainer, repeats: int, bandwidth: float) -> dict[str, Any]:
    """Times of a warm trainer's iterations and their steps, counts of an iteration, and floors, ready for JSON.
    ``peak``: bytes allocated at most, which the trainer's owner has to part; 0 on a CPU."""
    device, on_gpu = trainer.device, trainer.device.type == "cuda"
    if on_gpu:
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)
    start = trainer.iteration
    recorder = Recorder(device)
    with recorded(trainer, recorder) as iteration:
        for _ in range(repeats):
            keep_busy(device)
            iteration()
        synchronize(device)
        steps = recorder.summaries()
        peak = torch.cuda.max_memory_allocated(device) if on_gpu else 0
        updates = trainer.optimizer.state_dict()["steps"].clone()
        iteration()
    samples = recorder.samples
    counts = {"gaussians": len(trainer.gaussians), "samples": len(samples)}
    counts["pixels"] = int(samples.sizes.prod(axis=1).sum())
    counts["touched"] = int((trainer.optimizer.state_dict()["steps"] != updates).sum())
    floors = None
    if isinstance(recorder.rendered, CudaRendered):
        counts |= raster_counts(recorder.rendered, samples)
        floors = step_floors(counts, bandwidth)
    marks = [Mark(device)]  # ends of iterations on the device, which may have to wait for the host
    for _ in range(repeats):
        trainer.step()
        marks.append(Mark(device))
    synchronize(device)
    wall = back_to_back(trainer.step, repeats, device)
    trainer.repeat_lost(wait=True)
    return {
        "gaussians": len(trainer.gaussians),
        "views": len(samples.view_ids),
        "pixel_budget": PIXEL_BUDGET,
        "steps": steps,
        "free_running": device_times(itertools.pairwise(marks)),
        "wall": wall,
        "counts": counts,
        "floors_ms": floors,
        "lost_iterations": start + 1 + repeats * (2 + BLOCKS) - trainer.iteration,
        "peak": peak,
    }


def density_event(trainer: Trainer, overrides: Sequence[str]) -> dict[str, Any] | None:
    """One event of density control with its change of model and optimizer state, by the statistics of this trainer;
    None where the density control has no such events."""
    usual = load_config("turbogs", overrides).without_plan()
    if "refine_from" not in usual.density:
        return None
    interval = usual.density["refine_every"]
    iteration = -(-usual.density["refine_from"] // interval) * interval
    total = int(usual.train.iterations)
    due = replace(trainer.now, iteration=iteration, total=total, refine_until=usual.train.refine_until)
    spans, after = [], len(trainer.gaussians)
    for _ in range(5):
        density, optimizer = usual.build("density"), copy.deepcopy(trainer.optimizer)
        density.setup(trainer.gaussians)
        density.load_state_dict(trainer.density.state_dict())
        synchronize(trainer.device)
        first = Mark(trainer.device)
        update = density.update(trainer.gaussians, due)
        if update is not None:
            update = in_order_of_space(update, trainer.gaussians, due)
            after = len(update.apply(trainer.gaussians))
            optimizer.apply(update)
            density.apply(update)
        synchronize(trainer.device)
        spans.append(first.host_until(Mark(trainer.device)))
    return {"wall": summary(spans), "every": interval, "gaussians_after": after}


def memory(trainer: Trainer, scene: Scene, peak: int, held: int) -> dict[str, int | None]:
    """Bytes of what is stored, and the peak of the timed iterations. `held`: bytes allocated before the trainer was
    made: the scene's photos, which it shares where they were on the device already, and the bench's copy of the model.
    """
    stored = {
        "parameters": tensor_bytes(dict(trainer.gaussians.items())),
        "optimizer": tensor_bytes(trainer.optimizer.state_dict()),
        "density_statistics": tensor_bytes(trainer.density.state_dict()),
        "error_maps": tensor_bytes([trainer.maps.errors, trainer.maps.stamps]),
        "training_photos": tensor_bytes(trainer.views.photos.colors),
    }
    if trainer.device.type != "cuda":
        return stored | {"temporary": None, "peak": None}
    # What a training run would not have: test photos and the bench's copy.
    shared = trainer.views.photos.colors.data_ptr() == scene.train.photos.stored.data_ptr()
    peak -= held - (stored["training_photos"] if shared else 0)
    return {**stored, "temporary": peak - sum(stored.values()), "peak": peak}


def tensor_bytes(value: Any) -> int:
    """Bytes of the tensors in nested dicts and lists."""
    return sum(leaf.nbytes for _, leaf in leaves(value, "") if isinstance(leaf, Tensor))


def step_lines(measured: dict[str, Any]) -> list[str]:
    """One line for each pass: the whole iteration, then its steps with their floors in brackets."""
    lines = []
    for entry in measured["passes"]:
        steps, floors = entry["steps"], entry["floors_ms"] or {}
        parts = [
            f"{name} {value['device']['median_ms']:.3f}" + (f" [{floors[name]:.3f}]" if name in floors else "")
            for name, value in steps.items()
            if name != "iteration"
        ]
        lines.append(
            f"M={entry['gaussians']} K={entry['views']}: {steps['iteration']['device']['median_ms']:.3f} ms "
            f"(wall {entry['wall']['median_ms']:.3f}) | {'  '.join(parts)}"
        )
    return lines
