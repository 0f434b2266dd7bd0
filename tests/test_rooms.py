"""What lies where, how large it may be, and what importing a room loads.

`python tests/test_rooms.py` prints all sizes beside their budgets.
"""

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
    known = ("tiles", "masks", "errors", "error_maps", "files", "device", "yaml_json", "cli", "doctor", "__main__")
    assert modules <= set(known)


ROOT = Path(__file__).resolve().parents[1]

BUDGETS = {
    "turbogs_plugin": 22_500,
    "turbogs_plugin/{types,tiles,masks,error_maps}": 1_100,
    "turbogs_plugin/{errors,files,device,yaml_json}": 480,
    "turbogs_plugin/engine": 4_200,
    "turbogs_plugin/distributed": 1_150,
    "turbogs_plugin/model": 900,
    "turbogs_plugin/captures": 2_300,
    "turbogs_plugin/scene": 1_150,
    "turbogs_plugin/{config,plan}": 1_500,
    "turbogs_plugin/train": 2_300,
    "turbogs_plugin/reconstruct": 850,
    "turbogs_plugin/report": 655,
    "turbogs_plugin/study": 1_200,
    "turbogs_plugin/viewer": 800,
    "turbogs_plugin/export": 700,
    "turbogs_plugin/bench": 900,
    "turbogs_plugin/gsplat_bridge": 1_600,
    "turbogs_plugin/{commands,cli,doctor,__main__}": 850,
    "strategies": 2_000,
    "csrc": 6_000,
    "tests": 24_000,
    "docs": 960,
}
"""Folder or modules -> the most lines of Python, and of CUDA in csrc.

Whoever needs more takes something out, or says in the change which measured gain or named fault pays for it.
"""

STILL_LARGER = {
    "turbogs_plugin/captures": (
        2_554,
        "bundle adjustment (.18 to .5 dB); files as other programs and scripts leave them; depth maps, .exr too; scans",
    ),
    "turbogs_plugin/export": (770, "glTF, OpenUSD and .spz 2; a local origin for UTM captures; size and rate of films"),
}
"""Folder or modules above their budget -> lines that they have, and what pays for those beyond it. They only shrink;
within the budget, an entry goes."""

MOST_PAGES, MOST_DOCUMENTS, MOST_DOCUMENT_BYTES = 20, 70, 2 << 20
"""Pages for users in docs/, files in docs/ altogether, and their bytes."""

SOURCES = {".py", ".cu", ".cuh", ".h", ".cpp"}


def lines_of(place: str) -> int:
    """Lines of the sources of a folder, or of ``folder/{modules}``."""
    folder, _, names = place.partition("/{")
    rooms = {name: ROOT / folder / name for name in names.rstrip("}").split(",")} if names else {"": ROOT / folder}
    files = {file for room in rooms.values() for file in (*room.rglob("*"), room.with_suffix(".py"))}
    found = (file for file in files if file.suffix in SOURCES and file.is_file())
    return sum(len(file.read_text(encoding="utf-8").splitlines()) for file in found)


def documents() -> list[Path]:
    return [file for file in (ROOT / "docs").rglob("*") if file.is_file() and "__pycache__" not in file.parts]


def sizes() -> dict[str, tuple[int, int]]:
    """What -> (its size, the most that it may be)."""
    found, pages = documents(), [*(ROOT / "docs").glob("*.md")]
    return {
        **{f"{place}, lines": (lines_of(place), most) for place, most in BUDGETS.items()},
        "docs/*.md, pages": (len(pages), MOST_PAGES),
        "docs, files": (len(found), MOST_DOCUMENTS),
        "docs, bytes": (sum(file.stat().st_size for file in found), MOST_DOCUMENT_BYTES),
    }


def test_no_room_is_larger_than_its_budget():
    bounds = {f"{place}, lines": lines for place, (lines, _) in STILL_LARGER.items()}
    assert {what: size for what, (size, most) in sizes().items() if size > bounds.get(what, most)} == {}


def test_every_room_has_a_budget():
    named = {part for place in BUDGETS for part in re.split(r"[/{},]", place)}
    rooms = {path.stem for path in (ROOT / "turbogs_plugin").iterdir() if path.suffix in ("", ".py")}
    assert rooms - {"__init__", "__pycache__", "strategies", "configs"} <= named


ROOMS = ("train.trainer", "train.loop", "train.run", "report.run_report", "report.evaluation", "export.model_export")

RUN = """
from pathlib import Path
from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.train.run import train
train(load_config("config.yaml"), Path("run"))
"""


@pytest.fixture(scope="module")
def loaded(tmp_path_factory) -> list[set[str]]:
    """The modules that a new process has after the package, its clock and the command line, after the rooms of training
    and report, and after a run without a report."""
    folder = tmp_path_factory.mktemp("rooms")
    config = tiny_config(tiny_capture(folder), "train.iterations=2", "train.evaluate_at=[]").to_yaml()
    (folder / "config.yaml").write_text(config)
    parts = ("turbogs_plugin.train.wall, turbogs_plugin.cli", ", ".join(f"turbogs_plugin.{room}" for room in ROOMS))
    steps = ["import turbogs_plugin", *(f"import {part}" for part in parts), RUN]
    told = "\nimport json, sys\nprint(json.dumps(sorted(sys.modules)))\n"
    code = told.join(["\n".join(steps[:2]), *steps[2:], ""])
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=folder, timeout=300)
    assert ended.returncode == 0 and (folder / "run/model.ply").is_file(), ended.stderr
    return [set(json.loads(line)) for line in ended.stdout.splitlines() if line.startswith("[")]


def test_the_package_the_clock_of_the_wall_and_the_command_line_load_no_torch(loaded):
    assert {"turbogs_plugin.train.wall", "turbogs_plugin.cli"} <= loaded[0]
    assert not loaded[0] & (SLOW | {"torch", "numpy"})


def test_training_and_its_report_load_nothing_slow_before_they_use_it(loaded):
    assert {"torch", *(f"turbogs_plugin.{room}" for room in ROOMS)} <= loaded[1] and not loaded[1] & SLOW


def test_a_run_without_a_report_loads_nothing_slow_but_the_reader_of_its_capture(loaded):
    assert loaded[2] & SLOW == {"pycolmap", "scipy"}


if __name__ == "__main__":
    for name, (found, limit) in sizes().items():
        print(f"{name:<56} {found:>9,} of {limit:>9,}{'' if found <= limit else '  too large'}")
