"""Trainings with growth drawn by squares and turnover, through many events."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.squares import SQUARES
from helpers.synthetic_capture import synthetic_scene

from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.scene import Scene
from turbogs_plugin.scene.photos import Photos
from turbogs_plugin.train.trainer import Trainer

CPU = torch.device("cpu")
WIDTH, HEIGHT, VIEWS = 12, 10, 3
EVENTS = 60
"""Decay takes black photos' Gaussians from the 46th event on."""
FULL_BY = 15
"""Events after which a model that is needed is at its cap."""
CAP = 120
BY_SQUARES = (*(f"density.{name}={value}" for name, value in SQUARES.items()), "loss.ncc_weight=1.0")
EVERY_ITERATION = (
    "train.iterations=1000",
    "train.refine_until=1000",
    "train.sh_degree=0",
    "train.backdrop=false",
    "train.background=black",
    "train.camera_clearance=false",
    "train.device=cpu",
    "schedule.type=fixed",
    f"schedule.views={VIEWS}",
    "schedule.pixel_budget=0.5",
    "density.refine_from=0",
    "density.refine_every=1",
    "density.opacity_decay=0.005",  # as much an iteration as 0.4 in a hundred
)
"""An event of density control in each iteration, so that a thousand windows are a short run."""

PHOTOS: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "constant": lambda x, y: np.broadcast_to([120, 30, 200], (*x.shape, 3)),
    "black": lambda x, y: np.zeros((*x.shape, 3)),
    "noise": lambda x, y: np.random.default_rng(0).integers(0, 256, (*x.shape, 3)),
    "checkerboard": lambda x, y: np.repeat(255 * ((x + y) % 2)[..., None], 3, axis=-1),
}


def scene_of(photo: str) -> Scene:
    """Three training views of 12x10 pixels, and 25 points."""
    scene = synthetic_scene(VIEWS + 1, WIDTH, HEIGHT, CPU)
    _, y, x = np.mgrid[0:VIEWS, 0:HEIGHT, 0:WIDTH]
    pixels = torch.from_numpy(np.array(PHOTOS[photo](x, y)).astype(np.uint8).reshape(-1, 3))
    return replace(scene, train=replace(scene.train, photos=Photos(pixels, scene.train.photos.sizes)))


def trainer_of(scene: Scene, *overrides: str) -> Trainer:
    trainer = Trainer(load_config("turbogs", [*EVERY_ITERATION, *BY_SQUARES, *overrides]).without_plan(), scene, CPU)
    trainer.initialise_maps()
    return trainer


@pytest.mark.parametrize("photo", PHOTOS)
def test_many_windows_under_a_cap(photo, record_property):
    """What turnover frees is filled again wherever there is an error; where there is none, the model shrinks."""
    trainer, counts = trainer_of(scene_of(photo), f"density.max_gaussians={CAP}"), []
    for _ in range(EVENTS):
        trainer.step()
        counts.append(len(trainer.gaussians))
    record_property("counts", counts[::10])
    trainer.require_finite()
    assert int(trainer.nonfinite_losses) == int(trainer.optimizer.skipped) == 0
    assert max(counts) <= CAP and min(counts) >= 1
    if photo != "black":
        assert max(counts) == CAP and min(counts[FULL_BY:]) >= 0.95 * CAP
    else:
        assert counts[-1] < CAP
