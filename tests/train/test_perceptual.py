"""FLIP and LPIPS: what the libraries are given, where they are computed, and why they are not."""

import importlib.util
import math
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from helpers.framework_runs import TINY, tiny_capture, tiny_config

from turbogs_plugin.captures import load_scene
from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.report.evaluation import evaluate_run
from turbogs_plugin.report.provenance import provenance
from turbogs_plugin.study.cell import train_cell
from turbogs_plugin.train import perceptual, run
from turbogs_plugin.train.perceptual import load_flip, load_lpips
from turbogs_plugin.train.saved_model import load_model

pytestmark = pytest.mark.usefixtures("plotted")

CPU = torch.device("cpu")
STAND_IN = """
import numpy

calls = []

def evaluate(reference, test, dynamicRangeString, **settings):
    assert dynamicRangeString == "LDR" and settings.pop("parameters") == {"ppd": 67.0}
    assert settings == {"inputsRGB": True, "applyMagma": False, "computeMeanError": True}
    for picture in (reference, test):
        assert picture.dtype == numpy.float32 and picture.flags.c_contiguous and picture.ndim == 3
        assert 0 <= picture.min() and picture.max() <= 1
    calls.append((reference.copy(), test.copy()))
    return None, 0.25, {}
"""


@pytest.fixture
def library(tmp_path, monkeypatch):
    """A package of the library's name that gives 0.25 for all and keeps what it was given."""
    folder = tmp_path / "packages"
    folder.mkdir()
    (folder / "flip_evaluator.py").write_text(STAND_IN)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(sys.modules, "flip_evaluator", raising=False)
    import flip_evaluator

    yield flip_evaluator
    sys.modules.pop("flip_evaluator", None)


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("flip")
    run.train(tiny_config(tiny_capture(folder)), folder / "run")
    return folder / "run"


def test_the_library_gets_the_photo_as_its_reference(library):
    flip, reason = load_flip()
    image, photo = torch.rand(3, 12, 14).permute(1, 2, 0), torch.zeros(12, 14, 3)
    assert (flip(image, photo), reason) == (0.25, "")
    ((reference, test),) = library.calls
    assert not reference.any() and (test == image.numpy()).all()


@pytest.mark.parametrize("broken", [math.nan, math.inf])
def test_what_is_not_finite_has_no_flip(library, broken):
    photo = torch.full((12, 12, 3), 0.5)
    image = photo.clone()
    image[3, 4, 1] = broken
    assert all(math.isnan(perceptual.flip(*pair)) for pair in ((image, photo), (photo, image)))
    assert not library.calls, "the library calls such pictures equal"


def test_eval_prints_it_and_says_why_not(finished, library, monkeypatch):
    text = evaluate_run(finished, "cpu")
    views = len(load_scene(load_model(finished, CPU).config.scene.path).test)
    assert "| FLIP |" in text and text.count("| 0.2500 |") == views + 1 and len(library.calls) == views
    monkeypatch.setattr(perceptual, "FLIP_PACKAGE", "no_such_package_as_this")
    text = evaluate_run(finished, "cpu")
    assert "| FLIP |" not in text and "FLIP was not computed: flip-evaluator is not installed; pip install" in text


def test_a_cell_has_it_once_off_its_clock(library, tmp_path, monkeypatch):
    scene = load_scene(tiny_capture(tmp_path))
    config = load_config("turbogs", TINY)
    result = train_cell("x", config, scene, CPU, provenance("cpu"), loading=1000.0)
    assert result.final["flip"] == 0.25 and len(library.calls) == len(scene.test)
    assert 1000.0 + result.final["seconds"] < result.final["cell_seconds"] < 2000.0
    monkeypatch.setattr(perceptual, "FLIP_PACKAGE", "no_such_package_as_this")
    result = train_cell("x", config, scene, CPU, provenance("cpu"))
    assert not {"flip", "cell_seconds"} & set(result.final), "a load that was not timed is not 0"


@pytest.mark.skipif(importlib.util.find_spec("flip_evaluator") is None, reason="flip-evaluator is not installed")
def test_the_library_itself():
    torch.manual_seed(0)
    photo = torch.rand(40, 50, 3)
    noise = torch.randn(40, 50, 3)
    scales = (0.0, 0.01, 0.05, 0.2)
    values = [perceptual.flip((photo + scale * noise).clamp(0, 1), photo) for scale in scales]
    assert values[0] == 0.0 and values == sorted(values) and values[-1] < 1.0
    black, white = torch.zeros(30, 30, 3), torch.ones(30, 30, 3)
    assert perceptual.flip(white, black) == pytest.approx(0.967, abs=0.002)  # FLIP 1.7's at 67 pixels a degree


def test_lpips_takes_the_weights_of_torchs_cache_and_says_what_is_missing(tmp_path, monkeypatch):
    class Network(torch.nn.Module):
        def __init__(self, **_) -> None:
            super().__init__()

        def forward(self, image: torch.Tensor, photo: torch.Tensor) -> torch.Tensor:
            assert image.shape == photo.shape == (1, 3, 4, 5)
            return (image - photo).abs().mean()

    module = SimpleNamespace(LearnedPerceptualImagePatchSimilarity=Network)
    monkeypatch.setitem(sys.modules, "torchmetrics.image.lpip", module)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr(perceptual, "LPIPS_PACKAGES", ("torch", "no_such_package"))
    assert load_lpips(CPU)[1].startswith("it needs no_such_package: pip install no_such_package torch==")
    monkeypatch.setattr(perceptual, "LPIPS_PACKAGES", ())
    function, reason = load_lpips(CPU)
    assert function is None and f"put torchvision's file at {tmp_path}" in reason
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints/vgg16-397923af.pth").touch()
    function, reason = load_lpips(CPU)
    assert function(torch.ones(4, 5, 3), torch.zeros(4, 5, 3)) == 1.0 and reason == ""
