"""What an iteration does with its views: each is drawn by its own camera and compared with its own photo."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from helpers.framework_runs import tiny_trainer
from torch import Tensor

from turbogs_plugin.engine.reference.raster import kept
from turbogs_plugin.engine.render import render_image
from turbogs_plugin.engine.rules import Dropout
from turbogs_plugin.train.look import Look
from turbogs_plugin.train.metrics import evaluate, render_view
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import RowUpdate

CPU = torch.device("cpu")
HALF = 2e-3
"""Errors are kept in half precision, and are up to 3."""


def dense_errors(trainer: Trainer, degree: int) -> list[Tensor]:
    """[H * W] of each training view: the L1 norms of a dense render against its photo."""
    views, settings = trainer.views, trainer.config.raster
    errors = []
    for view in range(len(views)):
        image = render_image(trainer.gaussians, views.cameras, view, sh_degree=degree, settings=settings)
        errors.append((image.colors - views.photos.image(view)).abs().sum(dim=-1).reshape(-1))
    return errors


def mapped_errors(trainer: Trainer) -> list[Tensor]:
    return list(trainer.maps.errors.float().split(trainer.maps.sizes.prod(axis=1).tolist()))


def test_the_maps_begin_with_the_errors_of_the_initial_model(scene):
    trainer = tiny_trainer(scene)
    expected = dense_errors(trainer, degree=0)
    for found, errors in zip(mapped_errors(trainer), expected, strict=True):
        torch.testing.assert_close(found, errors, rtol=0, atol=HALF)
    assert trainer.initial_error == pytest.approx(float(torch.stack(expected).mean()), rel=1e-3)


def test_an_iteration_learns_the_errors_of_the_views_that_it_drew(scene):
    """With beta = 1 the maps then hold, at the pixels drawn, what a dense render of the model before the step gives,
    with the bands in use at that iteration; and elsewhere what they held."""
    trainer = tiny_trainer(scene, "maps.beta=1")
    generator = torch.Generator().manual_seed(0)
    trainer.gaussians.shN += 0.2 * torch.randn(trainer.gaussians.shN.shape, generator=generator)
    trainer.gaussians.sh0 += 0.3
    trainer.iteration = 8  # the second degree came with this iteration, and there is no event of density control
    step, before, expected = trainer.now, mapped_errors(trainer), dense_errors(trainer, degree=2)
    before = [errors.clone() for errors in before]
    trainer.step()
    drawn_views = 0
    for view, found in enumerate(mapped_errors(trainer)):
        drawn = trainer.maps.ages(view, step) == 0
        drawn_views += bool(drawn.any())
        torch.testing.assert_close(found[drawn], expected[view][drawn], rtol=0, atol=HALF)
        assert torch.equal(found[~drawn], before[view][~drawn])
    assert drawn_views >= 2


def test_iterations_before_a_change_of_the_set_are_not_made_again(scene):
    """The change would be made twice."""
    trainer = tiny_trainer(scene)
    trainer.iteration = 7
    rows = torch.arange(len(trainer.gaussians))
    trainer.follow(RowUpdate(rows, torch.zeros(len(rows), dtype=torch.bool), {}))
    trainer.iteration = 10
    for lost, iteration in ((0, 10), (1, 9), (5, 8)):
        trainer.engine = SimpleNamespace(settle=lambda wait, lost=lost: lost)
        trainer.repeat_lost()
        assert trainer.iteration == iteration


def test_lost_iterations_are_made_again(scene):
    trainer, seen = tiny_trainer(scene), []
    trainer.on_samples = lambda _: seen.append(trainer.iteration)
    trainer.refine = lambda step: None  # no change of the set, before which none is made again
    settle, lost = trainer.engine.settle, {5: 3, 6: 1}
    trainer.engine.settle = lambda wait: lost.pop(trainer.iteration, 0) or settle(wait)
    for _ in range(10):
        trainer.step()
    assert seen == [0, 1, 2, 3, 4, 2, 3, 4, 5, 5]


def test_an_evaluation_measures_what_a_screen_shows(scene):
    """Colours beyond white are white."""
    trainer = tiny_trainer(scene)
    trainer.gaussians.sh0 += 100.0
    trainer.gaussians.opacities += 10.0
    settings = trainer.config.raster
    image = render_image(trainer.gaussians, scene.test.cameras, 0, sh_degree=0, settings=settings)
    assert float(image.colors.max()) > 9
    assert float(render_view(trainer.gaussians, scene.test, 0, Look(0, settings)).max()) == 1.0
    metrics = evaluate(trainer.gaussians, scene.test, Look(0, settings))
    assert metrics.mean.l1 <= 1.0 and metrics.mean.psnr >= 0.0


def test_what_an_iteration_leaves_out_does_not_learn_and_the_end_has_all(scene, monkeypatch):
    still = ("density.refine_from=1000", "density.final_keep=1", "train.distant_size=0")
    trainer = tiny_trainer(scene, "train.dropout=0.4", "train.iterations=20", *still)
    render, shares = trainer.engine.render, []
    monkeypatch.setattr(trainer.engine, "render", lambda *all: shares.append(all[3].dropout.share) or render(*all))
    ever_left = torch.zeros(len(trainer.gaussians), dtype=torch.bool)
    for iteration in range(19):  # 0.95 of 20
        stay = kept(Dropout(0.4, trainer.config.train.seed, iteration), len(trainer.gaussians), CPU)
        before = trainer.gaussians.map(torch.clone)
        trainer.step()
        ever_left |= ~stay
        for name, value in trainer.gaussians.items():
            assert torch.equal(value[~stay], getattr(before, name)[~stay])
        assert not torch.equal(trainer.gaussians.means[stay], before.means[stay])
    trainer.step()
    assert ever_left.double().mean() > 0.99 and shares == [0.4] * 19 + [0.0]


def test_the_mean_begins_anew_where_rows_change_places(scene):
    trainer = tiny_trainer(scene, "train.average_last=1.0")
    trainer.parameter_mean.add(trainer.learnt())
    rows = torch.arange(len(trainer.gaussians)).flip(0)  # as many as before
    trainer.follow(RowUpdate(rows, torch.zeros(len(rows), dtype=torch.bool), {}))
    assert trainer.parameter_mean.count == 0
