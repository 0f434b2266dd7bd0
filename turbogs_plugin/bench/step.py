"""`turbogs bench step`: a whole iteration of training, and each of its steps."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.bench.clocks import BLOCKS, Mark, back_to_back, copy_bandwidth, device_times, keep_busy, summary
from turbogs_plugin.bench.floors import raster_counts, step_floors
from turbogs_plugin.bench.models import resized, train, trained_model, trainer_of
from turbogs_plugin.bench.recorder import Recorder, recorded
from turbogs_plugin.config.configuration import Config, load_config
from turbogs_plugin.device import synchronize
from turbogs_plugin.distributed.ranks import ONE, Ranks
from turbogs_plugin.engine.cuda.raster import CudaRendered
from turbogs_plugin.model.ply import load_ply
from turbogs_plugin.model.row_order import in_order_of_space
from turbogs_plugin.model.torch_file import leaves
from turbogs_plugin.scene import Scene
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import Gaussians

NO_EVENTS = 1 << 20
"""Iteration of the first density event, which is never reached. Statistics are kept as in any training."""

FIRST_EVENT = {"refine_from", "refine_start_iter"}
"""The setting of the first density event, by its name in each kind of density control."""

OFFLOADED = {"photos": ("photos",), "maps": ("maps",), "both": ("maps", "photos")}
"""What is in host memory, by the name in the results."""
BYTES_IN, BYTES_OUT = {"maps": 4, "photos": 3}, {"maps": 4, "photos": 0}
"""Copied to and from the device for a pixel, at most: a view of the iteration before is there already."""

RATE_FACTOR = 1e-3
"""Factor of the learning rates. Small steps take as long as large ones, and the timed model hardly changes."""

WARMUP_ITERATIONS = {"cuda": 40, "cpu": 2}
"""On a GPU more than the workspace's early passes, so that its buffers have their steady size."""


@dataclass
class StepBench:
    """What `turbogs bench step` measures.

    Args:
        gaussians: sizes of the model.
        views: K, one after the other.
        pixel_budget: lambda.
        training: iterations of the model's training.
        repeats: iterations timed.
        overrides: of the configuration, whose strategies are timed.
        offload: time the iteration with photos and error maps in host memory, too.
        photos, size: how many synthetic photos of which (width, height) take the place of a scene; 0: none.
        ply: a model in place of a trained one.
    """

    gaussians: Sequence[int]
    views: Sequence[int]
    pixel_budget: float
    training: int
    repeats: int
    overrides: Sequence[str]
    offload: bool = False
    photos: int = 0
    size: tuple[int, int] = (0, 0)
    ply: Path | None = None

    def run(self, scene: Scene, device: torch.device) -> dict[str, Any]:
        """The measurements, ready for JSON. `scene`: on the device, or every trainer copies the photos."""
        bandwidth = copy_bandwidth(device)
        loaded = None if self.ply is None else load_ply(self.ply, scene.frame)
        passes = []
        for count in self.gaussians:
            if loaded is None:
                model = trained_model(scene, count, self.training, device, self.overrides)
            else:
                model = resized(loaded.map(lambda value: value.to(device)), count)
            for views in self.views:
                passes.append(self._measure(scene, model, views, device, bandwidth))
        return {
            "scene": scene.name,
            "image_size": scene.train.cameras.sizes.max(axis=0).tolist(),
            "training_views": len(scene.train),
            "model": f"trained for {self.training} iterations" if self.ply is None else self.ply.name,
            "overrides": list(self.overrides),
            "copy_bandwidth_bytes_per_s": bandwidth,
            "passes": passes,
        }

    def _measure(
        self, scene: Scene, model: Gaussians, views: int, device: torch.device, bandwidth: float
    ) -> dict[str, Any]:
        config, on_gpu = self.config_of(views), device.type == "cuda"
        held = torch.cuda.memory_allocated(device) if on_gpu else 0
        trainer = warm_trainer(config, scene, model, device)
        if on_gpu:
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats(device)
        start = trainer.iteration

        recorder = Recorder(device)
        with recorded(trainer, recorder) as iteration:
            for _ in range(self.repeats):
                keep_busy(device)
                iteration()
            synchronize(device)
            steps = recorder.summaries()
            stored = memory(trainer, scene, held, device)
            updates = trainer.optimizer.state_dict()["steps"].clone()
            iteration()
            samples = recorder.samples
            touched = int((trainer.optimizer.state_dict()["steps"] != updates).sum())
            counts = {"gaussians": len(model), "samples": len(samples)}
            counts |= {"pixels": int(samples.sizes.prod(axis=1).sum()), "touched": touched}
            floors = None
            if isinstance(recorder.rendered, CudaRendered):
                counts = {**counts, **raster_counts(recorder.rendered, samples)}
                floors = step_floors(counts, bandwidth)
        marks = [Mark(device)]  # of the ends of iterations on the device, which may have to wait for the host
        for _ in range(self.repeats):
            trainer.step()
            marks.append(Mark(device))
        synchronize(device)
        wall = back_to_back(trainer.step, self.repeats, device)
        trainer.repeat_lost(wait=True)
        event = density_event(trainer, self.overrides, device)
        lost = start + 1 + self.repeats * (2 + BLOCKS) - trainer.iteration
        del trainer
        return {
            "gaussians": len(model),
            "views": len(samples.view_ids),
            "pixel_budget": self.pixel_budget,
            "steps": steps,
            "free_running": device_times(itertools.pairwise(marks)),
            "wall": wall,
            "density_event": event,
            "offload": self._offloaded(scene, model, config, device) if self.offload else None,
            "counts": counts,
            "floors_ms": floors,
            "memory_bytes": stored,
            "lost_iterations": lost,
        }

    def _offloaded(
        self, scene: Scene, model: Gaussians, config: Config, device: torch.device
    ) -> dict[str, dict[str, Any]]:
        """What is in host memory -> time of an iteration back to back, bytes of the windows, bytes that travel."""
        results = {}
        view_pixels = int(scene.train.cameras.sizes.prod(axis=1).mean())
        pixels = min(config.schedule["views"], len(scene.train)) * view_pixels
        for name, hosted in OFFLOADED.items():
            places = {f"{what}_place": "host" if what in hosted else "device" for what in ("maps", "photos")}
            trainer = warm_trainer(config.changed(train=places), scene, model, device)
            wall = back_to_back(trainer.step, self.repeats, device)
            trainer.repeat_lost(wait=True)
            owners = (trainer.maps, trainer.views.photos)
            results[name] = {
                "wall": wall,
                "window_bytes": sum(getattr(owner, "window_bytes", 0) for owner in owners),
                "bytes_in": pixels * sum(BYTES_IN[what] for what in hosted),
                "bytes_out": pixels * sum(BYTES_OUT[what] for what in hosted),
            }
        return results

    def config_of(self, views: int) -> Config:
        """The configuration that is timed with K views."""
        config = load_config("turbogs", self.overrides).without_plan()
        rates = config.optimizer["learning_rates"]
        return config.changed(
            train={"iterations": 2 * NO_EVENTS, "refine_until": 2 * NO_EVENTS - 1, "sh_interval": 1},
            schedule={"type": "fixed", "views": views, "pixel_budget": self.pixel_budget},
            density=dict.fromkeys(FIRST_EVENT & config.density.keys(), NO_EVENTS),
            optimizer={"learning_rates": {**rates, "batch_scale": RATE_FACTOR * rates["batch_scale"]}},
        )


def warm_trainer(config: Config, scene: Scene, model: Gaussians, device: torch.device, ranks: Ranks = ONE) -> Trainer:
    """A trainer of this model with every band in use, after the iterations that are unlike all later ones."""
    trainer = trainer_of(config, scene, model, device, ranks)
    trainer.iteration = config.train.sh_degree
    train(trainer, WARMUP_ITERATIONS[device.type])
    return trainer


def density_event(
    trainer: Trainer, overrides: Sequence[str], device: torch.device, repeats: int = 5
) -> dict[str, Any] | None:
    """One event of density control with its change of model and optimizer state, by the statistics of this trainer.

    None where the density control has no such events.
    """
    usual = load_config("turbogs", overrides).without_plan()
    if "refine_from" not in usual.density:
        return None
    interval = usual.density["refine_every"]
    iteration = -(-usual.density["refine_from"] // interval) * interval
    due = replace(trainer.now, iteration=iteration, total=usual.train.iterations, refine_until=usual.train.refine_until)
    spans, after = [], len(trainer.gaussians)
    for _ in range(repeats):
        density, optimizer = usual.build("density"), copy.deepcopy(trainer.optimizer)
        density.setup(trainer.gaussians)
        density.load_state_dict(trainer.density.state_dict())
        synchronize(device)
        first = Mark(device)
        update = density.update(trainer.gaussians, due)
        if update is not None:
            update = in_order_of_space(update, trainer.gaussians, due)
            after = len(update.apply(trainer.gaussians))
            optimizer.apply(update)
            density.apply(update)
        synchronize(device)
        spans.append(first.host_until(Mark(device)))
    return {"wall": summary(spans), "every": interval, "gaussians_after": after}


def memory(trainer: Trainer, scene: Scene, held: int, device: torch.device) -> dict[str, int | None]:
    """Bytes of what is stored, and the peak of the iterations timed.

    Args:
        scene: whose photos the trainer shares where they were on the device already.
        held: bytes allocated before the trainer was made: the scene's photos there, the bench's own copy of the model.
    """
    stored = {
        "parameters": tensor_bytes(dict(trainer.gaussians.items())),
        "optimizer": tensor_bytes(trainer.optimizer.state_dict()),
        "density_statistics": tensor_bytes(trainer.density.state_dict()),
        "error_maps": tensor_bytes([trainer.maps.errors, trainer.maps.stamps]),
        "training_photos": tensor_bytes(trainer.views.photos.colors),
        "raster_workspace": trainer.engine.bytes_held,
    }
    if device.type != "cuda":
        return {**stored, "temporary": None, "peak": None}
    # What a training run would not have: test photos and the bench's copy.
    shared = trainer.views.photos.colors.data_ptr() == scene.train.photos.stored.data_ptr()
    foreign = held - (stored["training_photos"] if shared else 0)
    peak = torch.cuda.max_memory_allocated(device) - foreign
    return {**stored, "temporary": peak - sum(stored.values()), "peak": peak}


def tensor_bytes(value: Any) -> int:
    """Bytes of the tensors in nested dicts and lists."""
    return sum(leaf.nbytes for _, leaf in leaves(value, "") if isinstance(leaf, Tensor))
