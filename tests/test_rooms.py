"""What lies where, and what importing a room loads."""

import json
import re
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
        "cli",
        "doctor",
        "__main__",
    }


def test_documents_name_tests_that_are_there():
    root = Path(__file__).parents[1]
    pages = [root / "README.md", *sorted((root / "docs").rglob("*.md"))]
    named = {(page.name, path) for page in pages for path in re.findall(r"\btests/[\w/]+\.py\b", page.read_text())}
    assert len(named) > 5
    assert [(page, path) for page, path in sorted(named) if not (root / path).is_file()] == []


def loaded_by(code: str) -> set[str]:
    """The modules that a new process has after this code."""
    code += "\nimport json, sys\nprint(json.dumps(sorted(sys.modules)))"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    return set(json.loads(ended.stdout.splitlines()[-1]))


def test_the_package_and_the_clock_of_the_wall_load_no_torch():
    loaded = loaded_by("import turbogs_plugin, turbogs_plugin.train.wall")
    assert "turbogs_plugin.train.wall" in loaded and not loaded & (SLOW | {"torch", "numpy"})


@pytest.mark.parametrize(
    "room", ["train.trainer", "train.loop", "train.run", "report.pages", "report.outputs", "export.commands"]
)
def test_training_and_its_report_load_nothing_slow_before_they_use_it(room):
    loaded = loaded_by(f"import turbogs_plugin.{room}")
    assert "torch" in loaded and not loaded & SLOW


def test_a_run_without_a_report_loads_nothing_slow_but_the_reader_of_its_capture(tmp_path):
    config = tiny_config(tiny_capture(tmp_path), "train.iterations=2", "train.evaluate_at=[]").to_yaml()
    (tmp_path / "config.yaml").write_text(config)
    loaded = loaded_by(
        "from pathlib import Path\n"
        "from turbogs_plugin.config.configuration import load_config\n"
        "from turbogs_plugin.train.run import train\n"
        f"train(load_config({str(tmp_path / 'config.yaml')!r}), Path({str(tmp_path / 'run')!r}))"
    )
    assert (tmp_path / "run/model.ply").is_file()
    assert loaded & SLOW == {"pycolmap"}
