"""One training of a grid: the trainer of any run, without what a run keeps (checkpoints, model, pictures)."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.config.scaling import with_iterations
from turbogs_plugin.plan import make_plan
from turbogs_plugin.report.provenance import Provenance
from turbogs_plugin.scene import PosedImages, Scene
from turbogs_plugin.scene.offload import place_views
from turbogs_plugin.study.results import CellResult
from turbogs_plugin.study.timing import PeakMemory
from turbogs_plugin.train.clock import TrainingClock
from turbogs_plugin.train.evaluate import Metrics, evaluate, free_device_memory, load_lpips, peak_memory_bytes
from turbogs_plugin.train.history import Evaluation
from turbogs_plugin.train.trainer import Trainer

WARMUP_ITERATIONS = {"cuda": 20, "cpu": 2}
"""Of the same configuration scaled to this length: every kind of step loads its code before the clock starts."""


def capture_digest(scene: Scene) -> str:
    """What tells a capture from another one of its name: names, sizes and cameras of its photos, and how many points.

    Not the photos' pixels, in which decoders differ from version to version. Of the cameras four digits of a sum, as
    the last bits of their coordinates differ from machine to machine.
    """
    digest = hashlib.sha256(str(len(scene.points)).encode())
    for part in (scene.train, scene.test):
        digest.update("\n".join(("", *part.names)).encode())
        digest.update(np.ascontiguousarray(part.cameras.sizes, dtype="<i8").tobytes())
        for array in (part.cameras.viewmats, part.cameras.Ks):
            values = array.cpu().double().abs().flatten()
            places = torch.linspace(1.0, 2.0, len(values), dtype=torch.float64)  # so that their order counts
            digest.update(f"{float(values @ places):.4g}".encode())
    return digest.hexdigest()[:16]


def scene_on(scene: Scene, device: torch.device) -> Scene:
    """The scene with its photos on the device, for what is timed without a plan."""
    return replace(scene, train=scene.train.to(device), test=scene.test.to(device))


def train_cell(
    variant: str,
    config: Config,
    scene: Scene,
    device: torch.device,
    made_by: Provenance,
    time_budget: float = 0.0,
    progress: Callable[[int, int], None] = lambda iteration, total: None,
) -> CellResult:
    """Train one variant.

    Args:
        variant: its name.
        config: as asked for. Its plan is made here, by the scene; the result keeps this one and the resolved one.
        scene: in host memory; the plan says what of it goes to the device.
        device: where to train.
        made_by: machine and sources, as they were when the process began.
        time_budget: seconds of training after which to stop; 0: none.
        progress: is told the number of finished iterations, and of all by the plan.

    Raises:
        TrainingStopped: the model is lost.
    """
    asked, config = config, make_plan(config, scene, device).apply(config)
    test = place_views(scene.test, device, config.train.photos_place)
    warmup = min(WARMUP_ITERATIONS[device.type], config.train.iterations)
    warm_up(config, scene, test, device, warmup)
    lpips, lpips_reason = load_lpips(config.report.lpips_weights, device)
    total, marks = config.train.iterations, config.train.evaluation_iterations()
    memory, clock = PeakMemory(device), TrainingClock(device)
    trainer = Trainer(config, scene, device)
    history: list[Evaluation] = []

    def measure(final: bool) -> Metrics:
        memory.pause()
        trainer.require_finite()
        metrics = evaluate(trainer.gaussians, test, trainer.sh_degree, config.raster, lpips if final else None)
        history.append(Evaluation.of(trainer, metrics, clock.seconds, memory.peak or peak_memory_bytes(device)))
        memory.resume()
        return metrics

    with clock:
        trainer.initialise_maps()
    metrics = measure(final=False)
    in_time = True
    while trainer.iteration < total and in_time:
        mark = min(iteration for iteration in marks if iteration > trainer.iteration)
        with clock:
            while trainer.iteration < mark and in_time:
                trainer.step_towards(mark)
                in_time = not time_budget or clock.now() < time_budget
                if not in_time:
                    trainer.repeat_lost(wait=True)
                progress(trainer.iteration, total)
        metrics = measure(final=trainer.iteration == total or not in_time)
    resolved = config.to_mapping()
    return CellResult(
        scene=scene.name,
        variant=variant,
        seed=config.train.seed,
        config=resolved,
        time_budget=time_budget,
        history=history,
        asked={name: section for name, section in asked.to_mapping().items() if section != resolved[name]},
        lpips=math.nan if lpips is None else metrics.lpips,
        lpips_reason=lpips_reason,
        fps=metrics.fps,
        peak_bytes=memory.peak,
        warmup_iterations=warmup,
        provenance=made_by,
        capture=capture_digest(scene),
    )


def warm_up(config: Config, scene: Scene, test: PosedImages, device: torch.device, iterations: int) -> None:
    """Train and evaluate a model that is thrown away, with every kind of event that the configuration has."""
    trainer = Trainer(with_iterations(config, iterations), scene, device)
    trainer.initialise_maps()
    while trainer.iteration < iterations:
        trainer.step_towards(iterations)
    evaluate(trainer.gaussians, test, trainer.sh_degree, config.raster)
    del trainer
    free_device_memory(device)
