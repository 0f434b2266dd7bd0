"""examples/simple_trainer: its edits are what README shows, they are found or refused, and gsplat's trainers run them.

The trainers themselves are not on PyPI. Where .hosts/1.5.3 and .hosts/main (or TURBOGS_HOSTS) hold gsplat's repository
at v1.5.3 and main, each of them trains a few steps with each swap, on the CPU; else these tests skip.
"""

import importlib
import importlib.metadata
import json
import os
import re
import sys
from pathlib import Path

import pytest
import torch
from helpers.refusals import assert_refused

from turbogs_plugin.captures import write_demo_capture

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "examples" / "simple_trainer"
HOSTS = Path(os.environ.get("TURBOGS_HOSTS", ROOT / ".hosts"))
SCRIPTS = ("whole_step", "density", "errors", "moment_lm", "sparse_pixels")


@pytest.fixture
def script(monkeypatch):
    """Imports a script by name as running it would, and forgets it afterwards."""
    monkeypatch.syspath_prepend(str(FOLDER))
    known = set(sys.modules)
    yield importlib.import_module
    for name in set(sys.modules) - known:
        if str(FOLDER) in (getattr(sys.modules[name], "__file__", None) or ""):
            del sys.modules[name]


def changes(script, name: str) -> list[str]:
    """The lines that a script's edits take and bring in gsplat 1.5.3, without indentation."""
    places = script("editing").hunks_of(script(name).EDITS)
    return [line for alternatives in places for line in alternatives[0].changes]


def test_the_diff_of_the_readme_is_all_lines_that_change(script):
    page = (ROOT / "README.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^```diff\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    shown = [line[0] + line[1:].strip() for line in block.splitlines() if line[0] in "+-"]
    assert shown == changes(script, "whole_step") and len(shown) <= 10


def test_the_numbers_of_lines_in_the_documentation(script):
    page = (ROOT / "docs" / "drop-in.md").read_text(encoding="utf-8")
    told = dict(re.findall(r"^\| `(\w+)\.py` \|.*\| (\+\d+ -\d+) \|$", page, re.MULTILINE))
    signs = {name: "".join(line[0] for line in changes(script, name)) for name in SCRIPTS}
    assert told == {name: f"+{found.count('+')} -{found.count('-')}" for name, found in signs.items()}


EDITS = """
 keep
+new
@@
-old one
+one
@@ or
-old two
+two
"""


def test_edits_find_their_places_or_are_refused(script):
    editing = script("editing")
    assert editing.edited("keep\nold one\n", EDITS) == "keep\nnew\none\n"
    assert editing.edited("a\nkeep\nb\nold two\n", EDITS) == "a\nkeep\nnew\nb\ntwo\n"
    refused = {
        "'keep' and the lines beside it is not there": "keeper\nold one\n",
        "is there 2 times": "keep\nkeep\nold one\n",
        "'old one' and the lines beside it is there 2 times": "keep\nold one\nold two\n",
        "already edited: it has 'new'": "keep\nnew\nold one\n",
    }
    for words, source in refused.items():
        assert_refused(words, editing.edited, source, EDITS)


def test_the_command_writes_all_or_nothing(script, tmp_path, monkeypatch, capsys):
    trainer, copy = tmp_path / "trainer.py", tmp_path / "copy.py"
    for source, lines in (("            loss.backward()\n", 0), ("loss.backward()\n", 1)):
        trainer.write_text(source)
        monkeypatch.setattr(sys, "argv", ["errors.py", str(trainer), "--out", str(copy)])
        if lines:
            with pytest.raises(SystemExit) as end:
                script("editing").command_line(script("errors").EDITS)
            assert end.value.code == 2
        else:
            script("editing").command_line(script("errors").EDITS)
            assert copy.read_text() == "".join((f"            {changes(script, 'errors')[0][1:]}\n", source))
            copy.unlink()
        assert trainer.read_text() == source and not copy.exists()
        assert len(capsys.readouterr().err.splitlines()) == lines


def test_how_much_sooner_the_whole_step_passes_stock(script):
    def run(variant, *marks):
        keys = ("step", "seconds", "psnr", "ssim")
        marks = [dict(zip(keys, mark, strict=True)) for mark in marks]
        return {"scene": "fox", "seed": 42, "variant": variant, "marks": marks}

    ours = run("step", (100, 1.0, 31.5, 0.80), (200, 2.0, 31.0, 0.90), (300, 3.0, 32.0, 0.91))
    stock = run("stock", (7000, 50.0, 31.0, 0.89), (9000, 60.0, 33.0, 0.9))
    lines = script("compare").sooner([stock, ours, {"error": 1}])
    assert "7000 steps (50.0 s, 31.00 dB, 0.8900), 42: passed after 2.00 s" in lines[0] and "25.0 times" in lines[0]
    assert "9000 steps" in lines[1] and lines[1].endswith("not passed")


@pytest.mark.parametrize("name", ["1.5.3", "main"])
def test_gsplats_trainer_runs_with_each_swap(script, name, tmp_path):
    if not (HOSTS / name / "examples" / "simple_trainer.py").exists():
        pytest.skip(f"no gsplat repository at {HOSTS / name}")
    if torch.cuda.is_available():
        pytest.skip("a few steps on the CPU; compare.py is for GPUs")
    compare = script("compare")
    capture = write_demo_capture(tmp_path / "demo", views=9, width=48, height=32)
    options = compare.Options(HOSTS / name, (capture,), tmp_path, tuple(compare.VARIANTS), steps=8, marks=(4,))
    options.extra = "--strategy.refine-start-iter 2 --strategy.refine-every 3"
    runs = {run["variant"]: run for run in compare.compare(options)}
    assert {variant: run.get("error") for variant, run in runs.items()} == dict.fromkeys(compare.VARIANTS)
    for variant, run in runs.items():
        first, last = (mark for mark in run["marks"] if mark["step"] in (4, 8))
        assert (first["step"], last["step"]) == (4, 8) and first["seconds"] < last["seconds"]
        assert last["gaussians"] > 0 and (variant == "stock" or last["psnr"] > first["psnr"] - 1.5)
    assert runs["sparse"]["marks"] != runs["stock"]["marks"] != runs["density"]["marks"]
    assert json.loads((tmp_path / "dropin.json").read_text())["runs"] == list(runs.values())
    assert compare.compare(options) == list(runs.values())  # nothing is done twice
