"""A finished run of a few iterations."""

from pathlib import Path

import pytest
import torch
from helpers.framework_runs import tiny_config

from turbogs_plugin.train import run
from turbogs_plugin.train.saved_model import load_model


@pytest.fixture(scope="module")
def finished(capture, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("export-runs") / "run"
    run.train(tiny_config(capture), folder)
    return folder


@pytest.fixture
def model(finished):
    return load_model(finished, torch.device("cpu"))
