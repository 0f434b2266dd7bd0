"""A finished run of a few iterations and its capture."""

from pathlib import Path

import pytest
import torch
from helpers.framework_runs import tiny_capture, tiny_config

from turbogs_plugin.captures import load_scene
from turbogs_plugin.train import run
from turbogs_plugin.train.saved_model import load_model


@pytest.fixture(scope="session")
def capture(tmp_path_factory) -> Path:
    """7 training views and a test view of 48x40 pixels."""
    return tiny_capture(tmp_path_factory.mktemp("export"))


@pytest.fixture(scope="session")
def scene(capture):
    return load_scene(capture)


@pytest.fixture(scope="session")
def finished(capture, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("export-runs") / "run"
    run.train(tiny_config(capture), folder)
    return folder


@pytest.fixture
def model(finished):
    return load_model(finished, torch.device("cpu"))
