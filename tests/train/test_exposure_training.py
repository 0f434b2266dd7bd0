"""Training with an exposure for each photo, and errors after a colour alignment."""

import math

import numpy as np
import pytest
import torch
from helpers.framework_runs import assert_identical, stop_after, tiny_capture, tiny_config
from PIL import Image

from turbogs_plugin.report.outputs import evaluate_run
from turbogs_plugin.report.pages import write_report
from turbogs_plugin.scene import load_scene
from turbogs_plugin.train.evaluate import align_colors, compare, evaluate
from turbogs_plugin.train.history import read_history
from turbogs_plugin.train.run import resume, train
from turbogs_plugin.train.trainer import Trainer

pytestmark = pytest.mark.usefixtures("plotted")

CPU = torch.device("cpu")
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


@pytest.fixture(scope="module")
def scene(capture):
    return load_scene(capture)


def trainer_of(scene, *overrides: str) -> Trainer:
    trainer = Trainer(tiny_config("capture", *overrides).without_plan(), scene, CPU)
    trainer.initialise_maps()
    return trainer


def test_the_dark_photo_gets_a_dark_exposure_and_the_mean_stays_the_identity(scene):
    trainer = trainer_of(scene, *ON, "train.iterations=60")
    for _ in range(40):
        trainer.step()
    gains = trainer.exposures.offsets[:, :, :3].diagonal(dim1=1, dim2=2).mean(dim=1)  # [V]
    assert gains[DARK] < -0.03 and (gains[torch.arange(7) != DARK] > gains[DARK] + 0.03).all()
    assert trainer.exposures.offsets.mean(dim=0).abs().max() < 1e-6
    assert trainer.exposures.steps.tolist() == [40] * 7


def test_without_exposures_there_is_no_state_of_them(scene):
    trainer = trainer_of(scene)
    trainer.step()
    assert trainer.exposures is None and "exposures" not in trainer.state_dict()


def test_the_first_iteration_is_that_without_exposures(scene):
    """Until the first step of Adam, every exposure is the identity to the bit."""
    states = [trainer_of(scene, *overrides) for overrides in ((), ("train.exposure=true",))]
    for trainer in states:
        trainer.step()
    off, on = (trainer.state_dict() for trainer in states)
    assert on.pop("exposures")["steps"].max() == 1
    assert_identical(off, on)


@pytest.mark.parametrize("loss", ["charbonnier_ncc", "sparse_ssim"])
def test_a_run_goes_on_bit_for_bit_and_from_host_memory(scene, loss):
    overrides = ("train.exposure=true", f"loss.type={loss}", "schedule.max_views=2")
    hosted = (*overrides, "train.maps_place=host", "train.photos_place=host")
    whole, first, second = trainer_of(scene, *overrides), trainer_of(scene, *hosted), trainer_of(scene, *overrides)
    for _ in range(6):
        whole.step()
    for _ in range(3):
        first.step()
    second.load_state_dict(first.state_dict())
    for _ in range(3):
        second.step()
    assert whole.exposures.offsets.any()
    assert_identical(whole.state_dict(), second.state_dict())


def test_a_stopped_run_resumes_to_the_same_model(capture, tmp_path, monkeypatch):
    overrides = ("train.exposure=true", "train.checkpoint_every=2")
    whole = train(tiny_config(capture, *overrides), tmp_path / "whole")
    with monkeypatch.context() as context:
        stop_after(context, 5)
        train(tiny_config(capture, *overrides), tmp_path / "stopped")
    resumed = resume(tmp_path / "stopped")
    assert resumed.resumed and whole.trainer.exposures.offsets.any()
    assert_identical(whole.trainer.state_dict(), resumed.trainer.state_dict())


def test_raw_and_aligned_errors_stand_side_by_side(capture, tmp_path):
    outcome = train(tiny_config(capture, "train.exposure=true"), tmp_path / "on")
    last = read_history(outcome.folder.history)[-1]
    assert last.aligned_psnr > last.psnr and last.aligned_l1 > 0 and 0 < last.aligned_ssim < 1
    page = write_report(outcome).read_text()
    assert "PSNR in dB after colour alignment" in page and "errors are raw" in page
    off = train(tiny_config(capture), tmp_path / "off")
    assert math.isnan(read_history(off.folder.history)[-1].aligned_psnr)
    assert "aligned" not in off.folder.history.read_text() and "alignment" not in write_report(off).read_text()
    for folder in ("on", "off"):  # so that both can be compared
        assert "SSIM after colour alignment" in evaluate_run(tmp_path / folder, "cpu")


def test_test_views_are_rendered_without_an_exposure(scene):
    """Raw errors are those of the model's own colours, whatever the training photos' exposures are."""
    trainer = trainer_of(scene, "train.exposure=true")
    settings = (trainer.gaussians, scene.test, trainer.sh_degree, trainer.config.raster)
    before = evaluate(*settings, aligned=True).mean
    trainer.exposures.offsets += 0.3
    after = evaluate(*settings, aligned=True).mean
    assert (before.psnr, before.aligned_psnr) == (after.psnr, after.aligned_psnr)


def test_alignment_finds_an_affine_map_of_colours():
    random = torch.Generator().manual_seed(1)
    photo = torch.rand(12, 14, 3, generator=random)
    matrix = torch.tensor([[0.5, 0.1, 0.0], [0.0, 0.6, 0.1], [0.05, 0.0, 0.7]])
    image = photo @ matrix.T + torch.tensor([0.1, 0.05, 0.0])
    assert compare("", image, photo).psnr < 25
    torch.testing.assert_close(align_colors(image, photo), photo, rtol=0, atol=1e-4)


def test_alignment_is_numpys_least_squares_over_unmasked_pixels():
    random = torch.Generator().manual_seed(2)
    image, photo = (torch.rand(12, 14, 3, generator=random) for _ in range(2))
    mask = torch.rand(12, 14, generator=random) < 0.5
    rows = np.concatenate([image[mask].numpy(), np.ones((int(mask.sum()), 1))], axis=1).astype(np.float64)
    affine = np.linalg.lstsq(rows, photo[mask].numpy().astype(np.float64), rcond=None)[0]
    wanted = np.clip(image.numpy() @ affine[:3] + affine[3], 0.0, 1.0)
    np.testing.assert_allclose(align_colors(image, photo, mask).numpy(), wanted, rtol=0, atol=1e-5)


@pytest.mark.parametrize("value", [0.0, 0.4, 1.0])
def test_an_image_of_one_colour_gets_the_photos_mean(value):
    photo = torch.rand(12, 14, 3, generator=torch.Generator().manual_seed(3))
    aligned = align_colors(torch.full_like(photo, value), photo)
    torch.testing.assert_close(aligned, photo.mean(dim=(0, 1)).expand_as(photo), rtol=0, atol=1e-5)
