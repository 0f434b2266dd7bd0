"""Training of one cell: as a run is trained, but no checkpoint, model or picture is kept."""

from __future__ import annotations

import hashlib
import math

import numpy as np
import torch

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.config.scaling import with_iterations
from turbogs_plugin.device import free_device_memory
from turbogs_plugin.plan import make_plan
from turbogs_plugin.report.evaluation import load_lpips
from turbogs_plugin.report.provenance import Provenance
from turbogs_plugin.scene import PosedImages, Scene
from turbogs_plugin.scene.offload import place_views
from turbogs_plugin.study.results import CellResult, changes, curve_and_final, flat_settings, measured
from turbogs_plugin.train.loop import TrainingLoop
from turbogs_plugin.train.metrics import Evaluations, evaluate
from turbogs_plugin.train.run import new_loop
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.train.wall import WallClock

WARMUP_ITERATIONS = {"cuda": 20, "cpu": 2}
"""Length to which the configuration is scaled for the warm-up before the clock starts, which loads the code of every
kind of step. One for a variant and capture in each process: what is loaded stays."""


def capture_digest(scene: Scene) -> str:
    """Digest that tells captures of one name apart: names and sizes of the photos, and the number of points."""
    digest = hashlib.sha256(str(len(scene.points)).encode())
    for part in (scene.train, scene.test):
        digest.update("\n".join(("", *part.names)).encode())
        digest.update(np.ascontiguousarray(part.cameras.sizes, dtype="<i8").tobytes())
    return digest.hexdigest()[:16]


def train_cell(
    variant: str,
    config: Config,
    scene: Scene,
    device: torch.device,
    made_by: Provenance,
    loading: float = math.nan,
    warm: bool = False,
) -> CellResult:
    """Train one variant, as `turbogs train` would: by a plan for the scene, within the configuration's budgets.

    Args:
        config: as asked for.
        scene: in host memory; the plan says what of it goes to the device.
        made_by: machine and sources, as they were when the process began.
        loading: seconds in which the scene was loaded; NaN: not known, and then the cell's own seconds are not.
        warm: this process has trained a cell of this variant on this capture.

    Raises:
        InputError: a budget is too small.
        TrainingStopped: the model is lost.
    """
    lpips, lpips_reason = load_lpips(device)
    clock = WallClock()
    plan = make_plan(config, scene, device)
    planned = plan.apply(config)
    test = place_views(scene.test, device, planned.train.pixels_place)
    clock.mark("cell")
    if not warm:
        warm_up(planned, scene, test, device)
    clock.mark("warm-up")
    loop, evaluations = new_loop(planned, scene, device, gains=plan.facts.gains), Evaluations(test)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    loop.listeners = [evaluations]
    loop.run()
    clock.mark("cell")
    trainer, (curve, final) = loop.trainer, curve_and_final(evaluations.history)
    assert evaluations.metrics is not None, "a run ends with an evaluation"
    final |= {"fps": evaluations.metrics.fps, "cell_seconds": loading + clock.parts["cell"]}
    if device.type == "cuda":  # a CPU's peak is the process's, of the largest cell so far
        final["peak_mib"] = evaluations.history[-1].memory_bytes / 2**20
    if lpips is not None:  # off the clock
        final["lpips"] = evaluate(trainer.gaussians, test, trainer.look(test.names), lpips).mean.lpips
    settings = flat_settings(config.to_mapping())
    return CellResult(
        scene=scene.name,
        variant=variant,
        seed=config.train.seed,
        capture=capture_digest(scene),
        provenance=made_by,
        settings=settings,
        planned=changes(settings, flat_settings(trainer.config.to_mapping())),
        curve=curve,
        final=measured(final),
        lpips_reason=lpips_reason,
    )


def warm_up(config: Config, scene: Scene, test: PosedImages, device: torch.device) -> None:
    """Train and evaluate a model that is thrown away, with every kind of event that the configuration has."""
    iterations = min(WARMUP_ITERATIONS[device.type], int(config.train.iterations))
    trainer = Trainer(with_iterations(config, iterations), scene, device)
    TrainingLoop(trainer).run()
    evaluate(trainer.gaussians, test, trainer.look(test.names))
    del trainer
    free_device_memory(device)
