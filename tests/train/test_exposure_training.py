"""Training with an exposure for each photo."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.framework_runs import assert_identical, tiny_capture, tiny_config, tiny_trainer
from PIL import Image

from turbogs_plugin.engine.render import render_image
from turbogs_plugin.engine.render_pass import RasterSettings
from turbogs_plugin.export.renders import render_run
from turbogs_plugin.plan import facts
from turbogs_plugin.plan.photo_gains import PhotoGains
from turbogs_plugin.report.evaluation import evaluate_run
from turbogs_plugin.report.run_report import write_report
from turbogs_plugin.train import training_state
from turbogs_plugin.train.checkpoint import latest_checkpoint, load_checkpoint, save_checkpoint
from turbogs_plugin.train.history import read_history
from turbogs_plugin.train.look import Look, interpolated_exposures
from turbogs_plugin.train.metrics import evaluate, render_view
from turbogs_plugin.train.run import fit, train

pytestmark = pytest.mark.usefixtures("plotted")

DARK = 2
"""The training photo that has half the exposure."""
ON = ("train.exposure=true", "schedule.min_views=7", "schedule.max_views=7")


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Photo 1 + DARK of the capture is darker, as the first one is for testing."""
    folder = tiny_capture(tmp_path_factory.mktemp("exposures"))
    path = sorted((folder / "images").iterdir())[1 + DARK]
    Image.fromarray(np.round(0.5 * np.asarray(Image.open(path).convert("RGB"))).astype(np.uint8)).save(path)
    return folder


def test_the_dark_photo_gets_a_dark_exposure_and_the_mean_stays_the_identity(scene):
    trainer = tiny_trainer(scene, *ON, "train.iterations=60")
    for _ in range(25):
        trainer.step()
    gains = trainer.exposures.offsets[:, :, :3].diagonal(dim1=1, dim2=2).mean(dim=1)  # [V]
    assert gains[DARK] < -0.03 and (gains[torch.arange(7) != DARK] > gains[DARK] + 0.03).all()
    assert trainer.exposures.offsets.mean(dim=0).abs().max() < 1e-6
    assert trainer.exposures.steps.tolist() == [25] * 7


@pytest.mark.parametrize("budget", ["", "0.01s"])
def test_training_begins_with_the_gains_that_its_plan_has_compared(scene, monkeypatch, budget):
    gains, seen = PhotoGains(np.zeros((7, 3)), np.ones(7, dtype=bool), 0.3, 0.01), []
    monkeypatch.setattr(facts, "compare_exposures", lambda *_: gains)
    monkeypatch.setattr(training_state, "compare_exposures", lambda *_: pytest.fail("they are compared again"))
    monkeypatch.setattr(training_state, "set_gains", lambda exposures, given: seen.append(given))
    fit(scene, "train.exposure=auto", "train.iterations=2", "train.device=cpu", f"budget.time='{budget}'")
    assert seen == [gains] * (2 if budget else 1)  # in the trial of a time budget, too


def test_the_first_iteration_is_that_without_exposures(scene):
    """Until the first step of Adam, every exposure is the identity to the bit."""
    alone = "train.average_last=0"  # the mean has exposures too
    states = [tiny_trainer(scene, alone, *overrides) for overrides in ((), ("train.exposure=true",))]
    for trainer in states:
        trainer.step()
    off, on = (trainer.state_dict() for trainer in states)
    assert on.pop("exposures")["steps"].max() == 1
    assert_identical(off, on)


@pytest.mark.parametrize("loss", ["charbonnier_ncc", "sparse_ssim"])
def test_a_run_goes_on_bit_for_bit_and_from_host_memory(scene, loss):
    overrides = ("train.exposure=true", f"loss.type={loss}", "schedule.max_views=2")
    first, whole, second = (
        tiny_trainer(scene, *overrides, f"train.pixels_place={place}") for place in ("host", "device", "device")
    )
    for trainer in 3 * (first, whole, whole):
        trainer.step()
    second.load_state_dict(first.state_dict())
    for _ in range(3):
        second.step()
    assert whole.exposures.offsets.any()
    assert_identical(whole.state_dict(), second.state_dict())


def test_a_saved_run_is_shown_as_its_trainer_is(capture, scene, tmp_path):
    """Test views with the exposures of their neighbours, training views with their own; a file has none."""
    run = tmp_path / "run"
    outcome = train(tiny_config(capture, "train.exposure=true"), run)
    assert 0 < read_history(outcome.folder.history)[-1].own_ssim < 1
    assert "| mean of the model's own colours |" in write_report(outcome).read_text()
    trainer = outcome.trainer
    state = load_checkpoint(latest_checkpoint(outcome.folder.checkpoints))
    state["trainer"]["exposures"]["offsets"] = torch.linspace(-0.3, 0.2, 7)[:, None, None].expand(7, 3, 4).clone()
    save_checkpoint(outcome.folder.checkpoints, trainer.iteration, state)
    trainer.load_state_dict(state["trainer"])
    look = trainer.look(scene.test.names)
    metrics = evaluate(trainer.gaussians, scene.test, look, further=True).mean
    table = evaluate_run(run, "cpu")
    for row, value in (("mean of 1", metrics.psnr), ("mean of the model's own colours", metrics.own_psnr)):
        assert metrics.psnr != metrics.own_psnr and re.search(rf"^{row} +{value:.2f} ", table, re.MULTILINE), table
    of_training = replace(look, exposures=trainer.exposures.offsets)
    for split, views, shown in (("test", scene.test, look), ("train", scene.train, of_training)):
        (folder,) = render_run(run, split, "cpu", False)
        picture = np.asarray(Image.open(sorted(folder.iterdir())[0]), dtype=np.float32) / 255
        wanted = render_view(trainer.gaussians, views, 0, shown)
        assert np.abs(picture - wanted.numpy()).max() <= 1 / 255
    assert "own colours" not in evaluate_run(run / "model.ply", "cpu", trainer.config)


def test_test_views_are_shown_with_what_their_neighbours_have(scene):
    """Nothing but exposures changes: the model's own colours have the errors that they had."""
    trainer = tiny_trainer(scene, "train.exposure=true")
    views = (trainer.gaussians, scene.test)
    before = evaluate(*views, trainer.look(scene.test.names), further=True).mean
    assert before.psnr == before.own_psnr  # every exposure is the identity
    trainer.exposures.offsets += 0.3
    after = evaluate(*views, trainer.look(scene.test.names), further=True).mean
    assert (after.own_psnr, after.own_ssim, after.own_l1) == (before.psnr, before.ssim, before.l1)
    own = render_image(trainer.gaussians, scene.test.cameras, 0, sh_degree=0, settings=trainer.config.raster).colors
    shown = (own + 0.3 * own.sum(dim=2, keepdim=True) + 0.3).clamp(0.0, 1.0)
    assert after.l1 == pytest.approx(float((shown - scene.test.photos.image(0)).abs().mean()), abs=1e-6)


ROWS = {True: [row for row in range(40) if row % 8], False: [*range(0, 40, 8)]}
TRAINED, TEST = ([f"{row}.jpg" for row in ROWS[trained]] for trained in (True, False))


def of(gains: torch.Tensor) -> torch.Tensor:
    """[V, 3, 4]: gains [V] of all channels, with the mean taken off."""
    offsets = torch.zeros(len(gains), 3, 4)
    offsets[:, range(3), range(3)] = (gains - gains.mean())[:, None]
    return offsets


def test_exposures_that_follow_the_sequence_are_told():
    wave = of(0.4 * torch.sin(torch.arange(40) / 6))
    told, wanted = interpolated_exposures(wave[ROWS[True]], TRAINED, TEST), wave[ROWS[False]]
    assert (told[1:] - wanted[1:]).abs().max() < 0.02 < 0.1 < wanted.abs().max()  # the first photo has one neighbour
    assert (told[0] - wave[1]).abs().max() < 0.02


def test_exposures_at_random_tell_nothing():
    """The identity is nearer to the truth than neighbours are, and what is told is nearer to the identity still."""
    noise = of(0.3 * torch.randn(40, generator=torch.Generator().manual_seed(3)))
    assert interpolated_exposures(noise[ROWS[True]], TRAINED, TEST).norm() < 0.3 * noise[ROWS[False]].norm()


@pytest.mark.parametrize("trained", [["a/1.jpg"], ["a/1.jpg", "a/2.jpg"], ["1.jpg", "2.jpg", "3.jpg"]])
def test_without_neighbours_or_differences_it_is_the_identity(trained):
    offsets = torch.zeros(len(trained), 3, 4) if len(trained) == 3 else torch.ones(len(trained), 3, 4)
    assert not interpolated_exposures(offsets, trained, ["1.png", "b/1.jpg"]).any()


def test_exposed_is_the_affine_map_of_each_colour():
    random = torch.Generator().manual_seed(2)
    colors, exposure = torch.rand(4, 5, 3, generator=random), 0.3 * torch.randn(3, 4, generator=random)
    wanted = [color + exposure[:, :3] @ color + exposure[:, 3] for color in colors.reshape(-1, 3)]
    look = Look(0, RasterSettings(), exposures=torch.stack([torch.zeros(3, 4), exposure]))
    torch.testing.assert_close(look.colors(colors, 1).reshape(-1, 3), torch.stack(wanted).clamp(0, 1))
    assert (look.colors(colors, 0) == colors).all()


def test_an_iteration_exposes_its_colours_once(scene):
    trainer = tiny_trainer(scene, *ON, "maps.beta=1")
    trainer.exposures.offsets[:] = torch.linspace(-0.3, 0.2, 84).view(7, 3, 4)
    expected, step = [trainer.dense_errors(view) for view in range(7)], trainer.now
    trainer.step()
    for view, wanted in enumerate(expected):
        drawn = trainer.maps.ages(view, step) == 0
        assert drawn.any()
        torch.testing.assert_close(trainer.maps.view_errors(view)[drawn], wanted[drawn], rtol=0, atol=2e-3)


def test_the_maps_begin_with_each_exposure_applied_once(scene):
    trainer, view = tiny_trainer(scene, "train.exposure=true"), DARK
    trainer.exposures.offsets[view] = torch.linspace(-0.3, 0.2, 12).view(3, 4)
    trainer.initialise_maps()
    photo, exposure = trainer.views.photos.image(view), trainer.exposures.offsets[view]
    image = render_image(trainer.gaussians, trainer.views.cameras, view, sh_degree=0, settings=trainer.config.raster)
    shown = image.colors + image.colors @ exposure[:, :3].T + exposure[:, 3]
    wanted = (shown - photo).abs().sum(dim=2).view(-1)
    torch.testing.assert_close(trainer.maps.view_errors(view), wanted, rtol=0, atol=2e-3)
