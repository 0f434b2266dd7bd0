"""FLIP: what the library is given, where it is computed, and that nothing needs it."""

import importlib.util
import math
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from helpers.framework_runs import TINY, tiny_capture, tiny_config

from turbogs_plugin import device
from turbogs_plugin.captures import load_scene
from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.doctor import diagnosis
from turbogs_plugin.report.outputs import evaluate_run
from turbogs_plugin.report.provenance import provenance
from turbogs_plugin.study.cell import train_cell
from turbogs_plugin.train import flip as flip_module
from turbogs_plugin.train import run
from turbogs_plugin.train.flip import load_flip
from turbogs_plugin.train.saved_model import load_model

pytestmark = pytest.mark.usefixtures("plotted")

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


@pytest.fixture
def absent(monkeypatch):
    monkeypatch.setattr(flip_module, "FLIP_PACKAGE", "no_such_package_as_this")


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("flip")
    run.train(tiny_config(tiny_capture(folder)), folder / "run")
    return folder / "run"


def test_the_library_gets_the_photo_as_its_reference(library):
    flip, reason = load_flip()
    image, photo = torch.rand(3, 12, 14).permute(1, 2, 0), torch.zeros(12, 14, 3)
    assert (flip(image, photo).result(), reason) == (0.25, "")
    ((reference, test),) = library.calls
    assert not reference.any() and (test == image.numpy()).all()


@pytest.mark.parametrize("broken", [math.nan, math.inf])
def test_what_is_not_finite_has_no_flip(library, broken):
    photo = torch.full((12, 12, 3), 0.5)
    image = photo.clone()
    image[3, 4, 1] = broken
    assert all(math.isnan(flip_module.flip(*pair).result()) for pair in ((image, photo), (photo, image)))
    assert not library.calls, "the library calls such pictures equal"


def test_eval_prints_it_and_says_why_not(finished, library, monkeypatch):
    text = evaluate_run(finished, "cpu")
    views = len(load_scene(load_model(finished, torch.device("cpu")).config.scene.path).test)
    assert "| FLIP |" in text and text.count("| 0.2500 |") == views + 1 and len(library.calls) == views
    monkeypatch.setattr(flip_module, "FLIP_PACKAGE", "no_such_package_as_this")
    text = evaluate_run(finished, "cpu")
    assert "| FLIP |" not in text and "FLIP was not computed: flip-evaluator is not installed; pip install" in text


def test_doctor_names_it_where_it_is_absent(absent):
    assert "FLIP is not computed: flip-evaluator" in diagnosis()


def test_a_run_does_not_wait_for_it(library, tmp_path):
    run.train(tiny_config(tiny_capture(tmp_path)), tmp_path / "run")
    assert not library.calls


def test_a_cell_has_it_once_off_its_clock(library, tmp_path, monkeypatch):
    scene = load_scene(tiny_capture(tmp_path))
    config = load_config("turbogs", TINY)
    result = train_cell("x", config, scene, torch.device("cpu"), provenance("cpu"), loading=1000.0)
    assert result.flip == 0.25 and len(library.calls) == len(scene.test)
    assert 1000.0 + result.final.train_seconds < result.cell_seconds < 2000.0
    monkeypatch.setattr(flip_module, "FLIP_PACKAGE", "no_such_package_as_this")
    result = train_cell("x", config, scene, torch.device("cpu"), provenance("cpu"))
    assert math.isnan(result.flip) and math.isnan(result.cell_seconds), "a load that was not timed is not 0"


@pytest.mark.skipif(importlib.util.find_spec("flip_evaluator") is None, reason="flip-evaluator is not installed")
def test_the_library_itself():
    torch.manual_seed(0)
    photo = torch.rand(40, 50, 3)
    noise = torch.randn(40, 50, 3)
    scales = (0.0, 0.01, 0.05, 0.2)
    values = [flip_module.flip((photo + scale * noise).clamp(0, 1), photo).result() for scale in scales]
    assert values[0] == 0.0 and values == sorted(values) and values[-1] < 1.0
    black, white = torch.zeros(30, 30, 3), torch.ones(30, 30, 3)
    assert flip_module.flip(white, black).result() == pytest.approx(
        0.967, abs=0.002
    )  # FLIP 1.7's at 67 pixels a degree


@pytest.mark.skipif(importlib.util.find_spec("flip_evaluator") is None, reason="flip-evaluator is not installed")
def test_large_pictures_are_compared_by_processes_with_the_same_result(monkeypatch):
    torch.manual_seed(1)
    photo, image = torch.rand(2, 40, 50, 3)
    here = flip_module.flip(image, photo).result()
    monkeypatch.setattr(flip_module, "SMALL_PIXELS", 1)
    monkeypatch.setattr(device, "processor_cores", lambda: 2 * flip_module.CORES_EACH)
    results = [flip_module.flip(image, photo) for _ in range(5)]  # more than there is room for at a time
    assert [result.result(timeout=60.0) for result in results] == [here] * 5


def test_a_process_that_compares_begins_without_torch():
    told = subprocess.run(
        [sys.executable, "-c", "import sys, turbogs_plugin.train.flip; print('torch' in sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert told.stdout == "False\n", "each process would take a second more to begin"
