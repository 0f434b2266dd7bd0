"""What lies where, and what importing a room loads."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.framework_runs import tiny_capture, tiny_config

import turbogs_plugin

SLOW = {"gsplat", "matplotlib", "pycolmap", "rich", "scipy", "torch._dynamo", "torchmetrics", "torchvision", "tyro"}
"""Modules that take long to import, or bring others that do, and that training alone does not use."""


def test_few_modules_stand_beside_the_packages():
    root = Path(turbogs_plugin.__file__).parent
    modules = {path.stem for path in root.glob("*.py")} - {"__init__"}
    assert modules <= {
        "tiles",
        "masks",
        "errors",
        "error_maps",
        "files",
        "device",
        "yaml_json",
        "cli",
        "doctor",
        "__main__",
    }


ROOMS = (
    "train.trainer",
    "train.loop",
    "train.run",
    "report.run_report",
    "report.tensorboard",
    "report.evaluation",
    "export.model_export",
)

RUN = """
from pathlib import Path
from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.train.run import train
train(load_config("config.yaml"), Path("run"))
"""


@pytest.fixture(scope="module")
def loaded(tmp_path_factory) -> list[set[str]]:
    """The modules that a new process has after the package and its clock, after the rooms of training and report, and
    after a run without a report."""
    folder = tmp_path_factory.mktemp("rooms")
    config = tiny_config(tiny_capture(folder), "train.iterations=2", "train.evaluate_at=[]").to_yaml()
    (folder / "config.yaml").write_text(config)
    parts = ("turbogs_plugin.train.clock", ", ".join(f"turbogs_plugin.{room}" for room in ROOMS))
    steps = ["import turbogs_plugin", *(f"import {part}" for part in parts), RUN]
    told = "\nimport json, sys\nprint(json.dumps(sorted(sys.modules)))\n"
    code = told.join(["\n".join(steps[:2]), *steps[2:], ""])
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=folder)
    assert ended.returncode == 0 and (folder / "run/model.ply").is_file(), ended.stderr
    return [set(json.loads(line)) for line in ended.stdout.splitlines() if line.startswith("[")]


def test_the_package_and_the_clock_of_the_wall_load_no_torch(loaded):
    assert "turbogs_plugin.train.clock" in loaded[0] and not loaded[0] & (SLOW | {"torch", "numpy"})


def test_training_and_its_report_load_nothing_slow_before_they_use_it(loaded):
    assert {"torch", *(f"turbogs_plugin.{room}" for room in ROOMS)} <= loaded[1] and not loaded[1] & SLOW


def test_a_run_without_a_report_loads_nothing_slow_but_the_reader_of_its_capture(loaded):
    assert loaded[2] & SLOW == {"pycolmap", "scipy"}
