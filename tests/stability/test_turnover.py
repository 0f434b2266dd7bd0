"""Trainings with growth drawn by squares and turnover: many events, and moved worlds."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from helpers.framework_runs import TINY
from helpers.squares import SQUARES
from helpers.synthetic_capture import synthetic_scene
from torch import Tensor

from turbogs_plugin.captures import load_scene
from turbogs_plugin.config.configuration import Config, load_config
from turbogs_plugin.scene import Scene
from turbogs_plugin.scene.photos import Photos
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import SH_C0, RowUpdate

CPU = torch.device("cpu")
WIDTH, HEIGHT, VIEWS = 12, 10, 3
EVENTS = 60
"""Decay takes black photos' Gaussians from the 46th event on."""
FULL_BY = 15
"""Events after which a model that is needed is at its cap."""
FREE_EVENTS = 25
CAP = 120
THRESHOLD = SQUARES["absgrad_threshold"]
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


@pytest.mark.parametrize("photo", PHOTOS)
def test_without_a_cap_growth_is_bounded_by_the_gradient(photo, monkeypatch, record_property):
    """All Gaussians share one gradient (docs/numerics.md), so only so many of them can be above the threshold.

    In a view, a pixel's slopes with respect to the exponents of all its splats sum up to at most its colour gradient
    times the largest colour; the colour gradients of an iteration to at most 1 + ncc_weight; and the distance of a
    pixel from a splat's mean, in the metric that the gradient takes, is at most sqrt(2 log 255 / eps2d).
    """
    trainer, counts = trainer_of(scene_of(photo)), []
    reach = np.sqrt(2 * np.log(255) / trainer.config.raster.eps2d)
    refine, shares = type(trainer.density)._refine, []

    def watched(density, gaussians, step) -> RowUpdate | None:
        largest = float((0.5 + SH_C0 * gaussians.sh0).max())
        bound = 0.5 * VIEWS * max(WIDTH, HEIGHT) * reach * 2.0 * largest
        stats = density.stats
        shares.append(float(stats.absgrad_sums.sum()) / bound)
        passing = int((stats.absgrad_sums / stats.view_counts.clamp(min=1) > THRESHOLD).sum())
        assert passing <= bound / THRESHOLD
        update = refine(density, gaussians, step)
        added = 0 if update is None else len(update.source) + update.num_pruned - len(gaussians)
        assert added <= passing
        return update

    monkeypatch.setattr(type(trainer.density), "_refine", watched)
    for _ in range(FREE_EVENTS):
        trainer.step()
        counts.append(len(trainer.gaussians))
    record_property("counts", counts[::10] + counts[-1:])
    record_property("largest share of the bound", float(max(shares)))
    trainer.require_finite()
    assert 0 < max(shares) <= 1 and min(counts) >= 1


# ---- Moved worlds --------------------------------------------------------------------------------------------------


def small_config(capture: Path, *overrides: str) -> Config:
    """Events in iterations 3, 6 and 9 of 14; all that has a gradient passes."""
    config = load_config("turbogs", [*TINY, *BY_SQUARES, "density.absgrad_threshold=1e-5", *overrides])
    config.scene.path = str(capture)
    return config


def first_change(capture: Path, monkeypatch) -> tuple[Tensor, int]:
    """Rows that the first event keeps and copies, and how many it removes."""
    config = small_config(capture, *STEADY, "train.device=cpu", "density.max_gaussians=110")
    trainer = Trainer(config.without_plan(), load_scene(capture), CPU)
    trainer.initialise_maps()
    found = []
    monkeypatch.setattr(trainer, "follow", lambda update: found.append(update))
    for _ in range(4):
        trainer.step()
    changes = [update for update in found if update is not None]
    return changes[0].source, changes[0].num_pruned


STEADY = ("view_sampler.type=random", "pixel_sampler.type=random", "train.backdrop=false", "train.seed=1")
"""With seed 0 the first event grows a Gaussian into a camera's clearance."""


@pytest.mark.parametrize(
    ("scale", "shift"), [(1e-4, 0), (1e4, 0), (1.0, 1e5), (1e-4, 1e5)], ids=lambda value: f"{value:g}"
)
def test_in_a_moved_world_the_same_rows_are_drawn(capture, tmp_path, monkeypatch, scale, shift):
    """Scaled, or shifted by 1e5 as coordinates of a country are."""
    moved = shutil.copytree(capture, tmp_path / "moved")
    reconstruction = pycolmap.Reconstruction(moved / "sparse/0")
    reconstruction.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(), np.array([shift, -shift, 0.1 * shift])))
    reconstruction.write_binary(moved / "sparse/0")
    expected, pruned = first_change(capture, monkeypatch)
    source, same_pruned = first_change(moved, monkeypatch)
    assert pruned == same_pruned > 0 and len(expected) == 110
    assert torch.equal(source, expected)
