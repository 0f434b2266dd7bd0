"""`turbogs ablate` and `turbogs compare`: sweeps that go on where they stopped, and their reports."""

import csv
import itertools
import json
import re
import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.framework_runs import TINY, stop_after, tiny_capture
from helpers.refusals import assert_refused
from helpers.simulated_time import SimulatedTime

from turbogs_plugin import cli
from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.config.scaling import with_iterations
from turbogs_plugin.errors import InputError
from turbogs_plugin.plan.decisions import RULES, Verdict
from turbogs_plugin.report import provenance as provenance_module
from turbogs_plugin.report.provenance import provenance
from turbogs_plugin.scene import load_scene, write_demo_capture
from turbogs_plugin.study import cell as cell_module
from turbogs_plugin.study import sweep
from turbogs_plugin.study.cell import capture_digest, train_cell
from turbogs_plugin.study.commands import ablate
from turbogs_plugin.study.compare import study_of_runs
from turbogs_plugin.study.folder import StudyFolder
from turbogs_plugin.study.grid import load_ablation, variant_config
from turbogs_plugin.study.pages import changed_since
from turbogs_plugin.study.results import CellResult, Study
from turbogs_plugin.study.results_file import DECIMALS
from turbogs_plugin.study.sweep import SweepOptions
from turbogs_plugin.train.folder import RunFolder
from turbogs_plugin.train.history import Evaluation, append_evaluation, read_history
from turbogs_plugin.train.loop import Listener, TrainingLoop
from turbogs_plugin.train.run import resume, train
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.train.wall import WallRecord

SMALL = """
title: Tiny
base: turbogs
baseline: full
variants:
  full: []
  random: [pixel_sampler.type=random]
notes: {random: "a | bar"}
"""


pytestmark = pytest.mark.usefixtures("plotted", "cold")


@pytest.fixture
def warm() -> None:
    """For tests of whole cells."""


@pytest.fixture
def cold(request, monkeypatch) -> None:
    """Cells are trained without their warm-up, which takes as long and whose model is thrown away; not with `warm`."""
    if "warm" not in request.fixturenames:
        monkeypatch.setattr(cell_module, "warm_up", lambda *arguments: None)


@pytest.fixture
def small(tmp_path) -> Path:
    path = tmp_path / "small.yaml"
    path.write_text(SMALL)
    return path


SETTINGS = ("train.sh_degree=1", "schedule.min_views=1", "schedule.max_views=2", "train.evaluate_at=[0.5]")
SETTINGS += ("schedule.pixel_budget=0.3",)


def call(small: Path, capture: Path, out: Path, *more) -> list:
    return ["ablate", small, *SETTINGS, "--scene", capture, "--out", out, "--device", "cpu", "--steps", "4", *more]


@pytest.fixture(scope="module")
def trained(capture, tmp_path_factory) -> Path:
    """The folder of a study with the cell of `full` and seed 0, by the sources of commit "one". Not to be changed."""
    folder = tmp_path_factory.mktemp("trained")
    (folder / "small.yaml").write_text(SMALL)
    arguments = call(folder / "small.yaml", capture, folder / "study", "--only", "full")
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as end:
        patch.setenv("TURBOGS_COMMIT", "one")
        patch.setattr(sys, "argv", ["turbogs", *map(str, arguments)])
        cli.main()
    assert not end.value.code
    return folder / "study"


@pytest.fixture
def study(trained, tmp_path, monkeypatch) -> Path:
    """A copy of `trained`, to go on with at the same commit."""
    monkeypatch.setenv("TURBOGS_COMMIT", "one")
    return Path(shutil.copytree(trained, tmp_path / "study"))


def test_what_a_call_asked_for_makes_no_study_stale_but_a_change_of_its_ablation_does(study):
    assert "Stale" not in (study / "report.md").read_text()
    made = StudyFolder(study).read_study()
    assert (made.results[0].overrides, made.results[0].steps) == ([*SETTINGS], 4)
    made.ablation.variants["full"] = ["loss.ncc_weight=0.5"]
    (line,) = changed_since(made)
    assert line.markdown().endswith("Then: loss.ncc_weight 1.0 (now 0.5).")


def test_a_process_warms_up_once_for_a_variant_and_capture(turbogs, small, capture, tmp_path, monkeypatch):
    other, warmed = shutil.copytree(capture, tmp_path / "other"), []
    monkeypatch.setattr(cell_module, "warm_up", lambda config, scene, *rest: warmed.append(scene.name))
    code, _, err = turbogs(*call(small, capture, tmp_path / "study", "--scene", other, "--seeds", "0", "1"))
    assert code == 0 and "[8/8]" in err
    assert warmed == ["capture", "capture", "other", "other"]


def test_a_sweep_is_complete_and_goes_on_where_it_stopped(turbogs, small, capture, tmp_path, monkeypatch, warm):
    out = tmp_path / "study"
    code, printed, err = turbogs(*call(small, capture, out, "--seeds", "0", "1"))
    assert code == 0 and str(out / "report.html") in printed
    assert "[4/4]" in err and "left" in err
    cells = sorted(out.glob("cells/capture/*.json"))
    assert [path.name for path in cells] == [f"{name}--seed{n}.json" for name in ("full", "random") for n in (0, 1)]
    results = StudyFolder(out).read_study().results
    first = results[0]
    assert first.final.iteration == 4 and first.warmup_iterations == 2
    assert all(result.cell_seconds > result.final.train_seconds for result in results), "and the capture's loading"
    assert first.provenance.machine and first.config["train"]["iterations"] == 4
    assert first.config["scene"]["path"] == "capture", "where a capture lies is no part of a result"

    rows = list(csv.DictReader((out / "table.csv").open()))
    assert [row["variant"] for row in rows] == ["full", "random"]
    mean = np.mean([result.final.psnr for result in results[2:]])
    assert float(rows[1]["psnr_mean"]) == pytest.approx(mean) and rows[1]["lpips_mean"] == ""
    worst = [result.final.worst_psnr for result in results[2:]]
    assert float(rows[1]["worst_psnr_low"]) == pytest.approx(min(worst)) and min(worst) < mean

    page, markdown = (out / "report.html").read_text(), (out / "report.md").read_text()
    assert page.count("data:image/png;base64,") == 3 and not re.search(r"(src|href)=\"(?!data:)", page)
    for word in ("thrown away", "not computed", "not measured", "★", "torch", f"{mean:.2f}", f"{min(worst):.2f}"):
        assert word in page and word in markdown
    assert "a \\| bar" in markdown
    assert not list(out.rglob("*.ply")) and not list(out.rglob("*.pt"))
    assert sum(path.stat().st_size for path in out.rglob("*") if path.is_file()) < 1_000_000

    monkeypatch.setattr(Trainer, "step", lambda trainer: pytest.fail("a finished cell was trained again"))
    stamps = [path.stat().st_mtime_ns for path in cells]
    code, _, err = turbogs(*call(small, capture, out, "--seeds", "0", "1"))
    assert code == 0 and "4 finished cells are kept" in err
    assert [path.stat().st_mtime_ns for path in cells] == stamps


def test_a_broken_cell_is_reported_and_tried_again(turbogs, small, capture, tmp_path, monkeypatch):
    out, step = tmp_path / "study", Trainer.step

    def broken(trainer):
        if trainer.config.pixel_sampler["type"] == "error_guided":
            raise RuntimeError("no such kernel")
        step(trainer)

    monkeypatch.setattr(Trainer, "step", broken)
    code, printed, err = turbogs(*call(small, capture, out))
    assert code == 1 and "no such kernel" in printed and "FAILED" in err
    assert "left" not in err, "a cell that failed at once says nothing about how long the others take"
    assert "no such kernel" in (out / "report.md").read_text()
    assert (out / "cells/capture/random--seed0.json").is_file()
    monkeypatch.setattr(Trainer, "step", step)
    code, _, err = turbogs(*call(small, capture, out))
    assert code == 0 and "1 finished cells are kept" in err and "[1/1]" in err
    assert "no such kernel" not in (out / "report.md").read_text()


def test_a_cell_of_other_settings_is_not_mixed_in(turbogs, small, capture, study):
    before = {path: path.read_bytes() for path in study.rglob("*") if path.is_file()}
    changed = [*call(small, capture, study, "--only", "full")]
    changed.insert(2, "loss.ncc_weight=0.1")
    code, _, err = turbogs(*changed)
    assert code == 2 and "other settings (loss)" in err
    del changed[2]
    for budget in (["budget.time=1s"], ["--time-budget", "1s"]):
        code, _, err = turbogs(*changed, *budget)
        assert code == 2 and "--steps 4 and the time budget 1s exclude each other: leave one out" in err
    assert {path: path.read_bytes() for path in study.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"asked": None}, "full--seed0.json.*asked: expected a mapping"),
        ({"variant": 1}, "full--seed0.json.*variant: expected text"),
        ({"seed": "0"}, "full--seed0.json.*seed: expected a whole number"),
        ({"variant": "other"}, "full--seed0.json.*no variant"),
        ({"history": {}}, "full--seed0.json.*history: key 'iteration' is missing"),
        ({"provenance": 7}, "full--seed0.json.*no provenance 7"),
    ],
)
def test_a_cell_that_cannot_be_used_is_named_by_its_file(small, tmp_path, changes, words):
    folder = StudyFolder(tmp_path / "study")
    folder.write_study(Study(load_ablation(str(small)), []))
    history = [Evaluation(4, 1.0, 30.0, 0.8, 0.1, 100, 2**20)]
    folder.write(CellResult(scene="fox", variant="full", seed=0, config={}, asked={}, history=history))
    path = folder.cells / "fox" / "full--seed0.json"
    document = json.loads(path.read_text())
    document["cells"][0] |= changes
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=words):
        folder.read_study()


@pytest.fixture
def machine(monkeypatch) -> None:
    """On which an iteration takes 1/8 s, and all but training nothing."""
    SimulatedTime(monkeypatch, tick=1e-9).in_iterations(monkeypatch, lambda trainer: 0.125)


@pytest.mark.parametrize(
    "length", [("train.iterations=30",), ("train.iterations=8", "train.epochs=2")], ids=["short", "long"]
)
def test_a_cell_with_a_time_budget_is_trained_as_a_run_with_one(
    machine, small, capture, tmp_path, length, warm, capsys
):
    """Fewer iterations than configured, or more pixels: the same numbers, and the same resolved configuration."""
    settings = (*TINY, *length, "budget.time=3s")  # on the command line the two would be refused
    train(load_config("turbogs", [*settings, f"scene.path={capture}"]), tmp_path / "run")
    out, options = tmp_path / "study", SweepOptions([capture], overrides=settings, device="cpu")
    assert ablate([str(small)], options, out, ["full"], ()) == 0
    (cell,) = StudyFolder(out).read_study().results
    assert cell.time_budget == "3s" and 2.5 < cell.final.train_seconds < 3.5
    errors = ("iteration", "train_seconds", "psnr", "ssim", "l1", "num_gaussians")
    decimals = [DECIMALS.get(name, 0) for name in errors]  # to which a study keeps them
    run_history = read_history(tmp_path / "run" / "history.jsonl")
    assert [[getattr(entry, name) for name in errors] for entry in cell.history] == [
        [round(getattr(entry, name), places) for name, places in zip(errors, decimals, strict=True)]
        for entry in run_history
    ]
    config = RunFolder(tmp_path / "run").read_config()
    config.scene.path = capture.name  # a study keeps no places
    assert cell.config == config.to_mapping()
    assert cell.config["train"]["iterations"] != cell.asked["train"]["iterations"] == int(length[0].partition("=")[2])
    assert "s many iterations as fit into 3s of training" in (out / "report.md").read_text()
    capsys.readouterr()
    assert ablate([str(small)], options, out, ["full"], ()) == 0
    assert "1 finished cells are kept" in capsys.readouterr().err


def test_an_interrupted_sweep_reports_what_is_there(turbogs, small, capture, tmp_path, monkeypatch):
    out, step = tmp_path / "study", Trainer.step

    def interrupted(trainer):
        if trainer.config.pixel_sampler["type"] == "random":
            raise KeyboardInterrupt
        step(trainer)

    monkeypatch.setattr(Trainer, "step", interrupted)
    code, printed, _ = turbogs(*call(small, capture, out))
    assert code == 130 and "report" in printed
    assert [result.variant for result in StudyFolder(out).read_study().results] == ["full"]


def test_variants_of_one_study_may_be_trained_by_several_calls(turbogs, capture, tmp_path):
    three, out = tmp_path / "three.yaml", tmp_path / "study"
    three.write_text(SMALL.replace("notes:", "  l1: [loss.type=charbonnier]\nnotes:"))
    for variant, there in (("random", ["full", "random"]), ("l1", ["full", "random", "l1"])):
        code, printed, err = turbogs(*call(three, capture, out, "--only", variant))
        assert code == 0 and "report.html" in printed, err
        assert [row["variant"] for row in csv.DictReader((out / "table.csv").open())] == there
        assert ("loss.type=charbonnier" in (out / "report.md").read_text()) is (variant == "l1")
    assert list(StudyFolder(out).read_study().ablation.variants) == ["full", "random", "l1"]
    assert turbogs("ablate", "--merge", out, "--out", tmp_path / "merged")[0] == 0


def test_a_sweep_within_a_time_begins_no_further_cell_and_goes_on(turbogs, small, capture, tmp_path, monkeypatch):
    """The clock stands still but for one hour that the first cell of a call takes."""
    clock, out = [0.0], tmp_path / "study"
    train = sweep.train_cell

    def slow(*arguments):
        clock[0] += 3600
        return train(*arguments)

    monkeypatch.setattr(sweep, "train_cell", slow)
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    for cells, code in ((1, 3), (2, 0)):
        assert turbogs(*call(small, capture, out, "--within", "50m"))[0] == code
        assert len(StudyFolder(out).read_study().results) == cells
    code, printed, _ = turbogs(*call(small, capture, tmp_path / "other", "--within", "50m"))
    assert code == 3 and "with 1 cells left" in printed and (tmp_path / "other/report.md").is_file()
    assert turbogs(*call(small, capture, tmp_path / "third", "--within", "soon"))[0] == 2


def test_a_variant_that_steps_make_a_copy_is_left_out_and_said(turbogs, capture, tmp_path):
    epochs, out = tmp_path / "epochs.yaml", tmp_path / "study"
    epochs.write_text("title: Epochs\nvariants: {nothing: [train.iterations=5000], few: [train.epochs=5]}")
    code, _, err = turbogs(*call(epochs, capture, out))
    assert code == 0 and "left out" in err and "few (as nothing)" in err and "[1/1]" in err
    assert [result.variant for result in StudyFolder(out).read_study().results] == ["nothing"]


def test_a_study_of_another_ablation_is_refused_before_training(turbogs, capture, study, tmp_path, monkeypatch):
    other = tmp_path / "other.yaml"
    before = {path: path.read_bytes() for path in study.rglob("*") if path.is_file()}
    other.write_text("title: Other\nvariants: {same: []}\n")
    monkeypatch.setattr(Trainer, "step", lambda trainer: pytest.fail("trained"))
    code, _, err = turbogs(*call(other, capture, study))
    assert code == 2 and "another ablation" in err and "full" in err
    assert {path: path.read_bytes() for path in study.rglob("*") if path.is_file()} == before


def test_a_study_of_an_earlier_version_is_refused_by_a_line_that_says_so(turbogs, small, capture, study, monkeypatch):
    cell = study / "cells/capture/full--seed0.json"
    cell.write_text(cell.read_text().replace('"budget.time":', '"budget.max_gaussians": 0, "budget.time":'))
    monkeypatch.setattr(Trainer, "step", lambda trainer: pytest.fail("trained"))
    code, _, err = turbogs(*call(small, capture, study))
    assert code == 2 and err.count("\n") == 1 and "of an earlier version (budget.max_gaussians is now density." in err


def test_studies_are_merged_and_reported_again_without_training(turbogs, small, capture, study, tmp_path, monkeypatch):
    parts = [study, tmp_path / "b"]
    assert turbogs(*call(small, capture, parts[1], "--only", "full", "--seeds", 1))[0] == 0
    monkeypatch.setattr(Trainer, "step", lambda trainer: pytest.fail("a merge trains nothing"))
    out = tmp_path / "both"
    code, printed, _ = turbogs("ablate", "--merge", *parts, "--out", out, "--psnr", "5")
    assert code == 0 and "report.html" in printed
    assert [result.seed for result in StudyFolder(out).read_study().results] == [0, 1]
    assert "s to 5.0 dB" in (out / "report.md").read_text()
    before = (out / "table.csv").read_bytes()
    assert turbogs("ablate", "--merge", out, "--out", out, "--psnr", "5")[0] == 0
    assert (out / "table.csv").read_bytes() == before
    other = tmp_path / "b" / "cells/capture/full--seed1.json"
    other.write_text(other.read_text().replace('"fps":', '"fps":1'))
    code, _, err = turbogs("ablate", "--merge", *parts, out, "--out", tmp_path / "c")
    assert code == 2 and "two different results" in err


def of_two_studies(small: Path, capture: Path, study: Path, tmp_path: Path) -> list:
    """A call for the cell that a study has, and for the same by another name."""
    other, out = tmp_path / "other.yaml", tmp_path / "studies"
    other.write_text("title: Other\nvariants: {same: []}\n")
    small.write_text("title: Tiny\nvariants: {full: []}\n")
    shutil.copytree(study, out / "small")
    arguments = call(small, capture, out)
    arguments.insert(2, other)
    return arguments


def test_cells_of_other_sources_are_not_shared(turbogs, small, capture, study, tmp_path, monkeypatch):
    arguments = of_two_studies(small, capture, study, tmp_path)
    monkeypatch.setenv("TURBOGS_COMMIT", "another")
    code, _, err = turbogs(*arguments)
    assert code == 0 and err.count("1 finished cells are kept") == 1 and "[1/1]" in err


def test_another_capture_of_the_same_name_is_not_taken_for_the_first(turbogs, small, capture, study, tmp_path):
    first, second = study, tmp_path / "second"
    (tmp_path / "moved").mkdir()
    moved = shutil.copytree(capture, tmp_path / "moved" / capture.name)
    code, _, err = turbogs(*call(small, moved, first, "--only", "full"))
    assert code == 0 and "1 finished cells are kept" in err
    other = write_demo_capture(tmp_path / capture.name, views=9, width=48, height=40)
    for seed in (0, 1):
        code, _, err = turbogs(*call(small, other, first, "--only", "full", "--seeds", seed))
        assert code == 2 and "other photos or cameras" in err
    code, _, err = turbogs(*call(small, other, second, "--only", "full"))
    assert code == 0 and "kept" not in err and "[1/1]" in err
    code, _, err = turbogs("ablate", "--merge", first, second, "--out", tmp_path / "both")
    assert code == 2 and "two different captures" in err


def test_a_cell_of_an_unknown_capture_is_kept_and_merged_but_not_shared(turbogs, small, capture, study, tmp_path):
    old = study
    for path in (*old.glob("cells/*/*.json"), old / "results.json"):
        document = json.loads(path.read_text())
        assert document["captures"] == {"capture": capture_digest(load_scene(capture))}
        path.write_text(json.dumps(document | {"captures": {}}))
    code, _, err = turbogs(*call(small, capture, old, "--only", "full"))
    assert code == 0 and "1 finished cells are kept" in err
    assert turbogs("ablate", "--merge", old, "--out", tmp_path / "merged")[0] == 0
    code, _, err = turbogs(*of_two_studies(small, capture, old, tmp_path))
    assert code == 0 and err.count("1 finished cells are kept") == 1 and "[1/1]" in err


def test_the_digest_of_a_capture_is_of_names_sizes_and_cameras(capture):
    scene = load_scene(capture)
    before = capture_digest(scene)
    assert capture_digest(load_scene(capture)) == before != capture_digest(load_scene(capture, 2))
    for part in (scene.train, scene.test):
        unchanged = part.cameras.viewmats
        part.cameras.viewmats = unchanged + 1e-3
        assert capture_digest(scene) != before
        part.cameras.viewmats = unchanged
        assert capture_digest(scene) == before
    scene.train.names = ("other", *scene.train.names[1:])
    assert capture_digest(scene) != before


def test_a_commit_made_meanwhile_changes_no_cell_and_no_sharing(turbogs, small, capture, tmp_path, monkeypatch):
    commits = (f"commit-{number}" for number in itertools.count())
    monkeypatch.setattr(provenance_module, "source_commit", lambda: next(commits))
    other, out = tmp_path / "other.yaml", tmp_path / "studies"
    other.write_text("title: Other\nvariants: {same: []}\n")
    arguments = call(small, capture, out)
    arguments.insert(2, other)
    code, _, err = turbogs(*arguments)
    assert code == 0 and "1 finished cells are kept" in err
    results = [result for name in (small.stem, "other") for result in StudyFolder(out / name).read_study().results]
    assert [result.provenance.commit for result in results] == 3 * ["commit-0"]


def test_several_ablations_in_one_call_share_their_cells(turbogs, small, capture, tmp_path):
    other, out = tmp_path / "other.yaml", tmp_path / "studies"
    other.write_text("title: Other\nvariants: {same: [], l1: [loss.type=charbonnier]}\n")
    arguments = call(small, capture, out)
    arguments.insert(2, other)
    code, printed, err = turbogs(*arguments)
    assert code == 0 and printed.count("report.html") == 2
    assert "[2/2]" in err and "1 finished cells are kept" in err and "[1/1]" in err
    first, second = (StudyFolder(out / name).read_study().results for name in (small.stem, "other"))
    assert [result.variant for result in first] == ["full", "random"]
    assert [result.variant for result in second] == ["same", "l1"] and second[0].history == first[0].history
    code, _, err = turbogs(*arguments, "--only", "full")
    assert code == 2 and "--only" in err
    arguments[2] = small
    code, _, err = turbogs(*arguments)
    assert code == 2 and "share a folder" in err


def test_runs_are_compared(turbogs, capture, tmp_path):
    runs = {"a": ["train.seed=0"], "b": ["train.seed=1"], "c": ["pixel_sampler.type=random"]}
    quick = [setting for setting in TINY if "iterations" not in setting] + ["train.iterations=3"]
    for name, overrides in runs.items():
        arguments = ["train", capture, "--out", tmp_path / name, "--device", "cpu", *quick, *overrides]
        assert turbogs(*arguments)[0] == 0
    paths = [tmp_path / name for name in runs]
    code, printed, _ = turbogs("compare", *paths, "--out", tmp_path / "report")
    assert code == 0 and "report.html" in printed
    rows = list(csv.DictReader((tmp_path / "report" / "table.csv").open()))
    assert [(row["variant"], row["seeds"]) for row in rows] == [("a", "2"), ("c", "1")]
    markdown = (tmp_path / "report" / "report.md").read_text()
    assert "pixel_sampler.type=random" in markdown and "not recorded" in markdown
    assert turbogs("compare", *paths, "--out", tmp_path / "report")[0] == 2


def test_a_run_twice_and_another_run_of_the_same_settings_are_told_apart(tmp_path):
    first, second = (a_run(tmp_path / name, 30) for name in ("x", "y"))
    with pytest.raises(InputError, match=r"/x' is given twice, .* leave one out"):
        study_of_runs([first, tmp_path / "y" / ".." / "x"])
    with pytest.raises(InputError, match=r"/y' has the settings and the seed of '.*/x': .* another train.seed"):
        study_of_runs([first, second])


def a_run(folder: Path, iterations: int, *overrides: str, fitted: Sequence[str] = ()) -> Path:
    """What `compare` reads of a run. `fitted`: settings that a budget changed, besides the number of iterations."""
    folder.mkdir()
    (folder / "asked.yaml").write_text(load_config("turbogs", overrides).to_yaml())
    resolved = with_iterations(load_config("turbogs", [*overrides, *fitted]).without_plan(), iterations)
    (folder / "config.yaml").write_text(resolved.to_yaml())
    seconds = resolved.budget.seconds() or 20.0
    append_evaluation(folder / "history.jsonl", Evaluation(iterations, seconds, 30.0, 0.8, 0.1, 100, 2**20))
    return folder


@pytest.mark.parametrize(
    ("settings", "at"),
    [
        ((), "iteration 7 of 14: "),
        (("budget.time=3s",), r"1\.\d of 3 s: "),
        (("train.evaluate_at=[0.5, 0.99]", "budget.time=3.12s"), r"1\.\d of 3\.12 s: "),  # a checkpoint tells its end
    ],
    ids=["iterations", "budget", "evaluated-shortly-before"],
)
def test_a_stopped_run_is_compared_once_it_has_gone_on_to_its_end(
    machine, capture, tmp_path, monkeypatch, settings, at
):
    run = tmp_path / "run"
    with monkeypatch.context() as patch:
        stop_after(patch, 8)
        train(load_config("turbogs", [*TINY, *settings, f"scene.path={capture}", "train.device=cpu"]), run)
    (run / "model.ply").touch()  # as an export from its checkpoint leaves one
    assert_refused(
        f"/run' is not finished, its last evaluation is at {at}.*turbogs train --resume ", study_of_runs, [run]
    )
    resume(run)
    (result,) = study_of_runs([run]).results
    assert result.final.iteration > 8


@pytest.mark.parametrize(
    ("second", "names"),
    [
        (["scene.path=/a/fox"], ["fox"]),
        (["scene.path=/b/fox"], ["a-fox", "b-fox"]),
        (["scene.path=/fox"], ["a-fox", "fox"]),
        (["scene.path=/a/bear", "scene.factor=2"], ["fox", "bear"]),
        (["scene.path=/a/fox", "scene.factor=2"], ["fox-factor-1", "fox-factor-2"]),
        (["scene.path=/a/fox", "scene.test_every=4"], ["fox-test_every-8", "fox-test_every-4"]),
    ],
)
def test_captures_that_share_a_name_are_kept_apart(tmp_path, second, names):
    runs = [a_run(tmp_path / "x", 30, "scene.path=/a/fox"), a_run(tmp_path / "y", 30, "train.seed=1", *second)]
    study = study_of_runs(runs)
    assert study.scenes == names and list(study.ablation.variants) == ["x"]


def test_runs_that_were_asked_the_same_are_seeds_whatever_plan_and_budgets_made_of_it(tmp_path):
    """Lengths, pixels and caps that a time budget fits to each seed are no variants of their own."""

    def run(name: str, seed: int, iterations: int, *overrides: str, fitted: Sequence[str] = ()) -> Path:
        return a_run(tmp_path / name, iterations, f"train.seed={seed}", *overrides, fitted=fitted)

    capped = ("density.max_gaussians=9000",)
    runs = [
        run("a", 0, 2600, "budget.time=20s"),
        run("b", 1, 2471, "budget.time=20s", fitted=["schedule.pixel_budget=1.5"]),
        run("c", 2, 1500, "budget.time=20s", fitted=capped),
        run("capped", 0, 1500, "budget.time=20s", *capped),
        run("longer", 0, 2600, "budget.time=30s"),
        run("other", 0, 2600, "budget.time=20s", "density.percent_dense=0.02"),
        run("free", 0, 2600),
        run("free-2", 1, 2471),
    ]
    study = study_of_runs(runs)
    assert {name: len(study.of("", name)) for name in study.ablation.variants} == {
        "a": 3, "capped": 1, "longer": 1, "other": 1, "free": 2,
    }  # fmt: skip
    assert study.ablation.variants["longer"] == ["budget.time=30s"]
    (tmp_path / "a" / "asked.yaml").unlink()
    with pytest.raises(InputError, match=r"asked\.yaml"):
        study_of_runs(runs)


def test_a_run_in_a_folder_called_as_a_configuration_is_not_stale(tmp_path):
    assert changed_since(study_of_runs([a_run(tmp_path / "turbogs", 30, "density.percent_dense=0.02")])) == []


def test_seconds_on_the_wall_are_compared_where_a_run_recorded_them(turbogs, tmp_path):
    runs = [a_run(tmp_path / name, 30, "scene.path=/a/fox", f"train.seed={seed}") for seed, name in enumerate("xy")]
    runs.append(a_run(tmp_path / "z", 30, "scene.path=/a/fox", "schedule.pixel_budget=2.0"))
    assert turbogs("compare", *runs, "--out", tmp_path / "without")[0] == 0
    assert "wall" not in (tmp_path / "without/table.csv").read_text()
    assert "| wall in s |" not in (tmp_path / "without/report.md").read_text()
    for path, seconds in zip(runs, (25.0, 27.0), strict=False):
        WallRecord(20.0, seconds).write(path / "wall.json")
    assert turbogs("compare", *runs, "--out", tmp_path / "with")[0] == 0
    page = (tmp_path / "with/report.md").read_text()
    assert "| wall in s |" in page and "| 26.0 [25.0, 27.0] | " in page and re.search(r"\| z \|.*\| - \|", page)
    rows = list(csv.DictReader((tmp_path / "with/table.csv").open()))
    assert [row["wall_seconds_mean"] for row in rows] == ["26.0", ""]


def test_refining_the_cameras_counts_as_loading(small, capture, tmp_path, monkeypatch):
    """In a cell's seconds on the wall, as in those of a run."""
    ticks, told = itertools.count(), []

    def cell(*arguments):
        told.append(arguments[6])
        raise InputError("enough")

    clock = SimpleNamespace(perf_counter=lambda: float(next(ticks)), monotonic=time.monotonic, sleep=time.sleep)
    monkeypatch.setattr(sweep, "time", clock)
    monkeypatch.setattr(sweep, "train_cell", cell)
    sweep.run_sweep(
        load_ablation(small),
        ["full"],
        SweepOptions([capture], device="cpu", steps=2),
        provenance("cpu"),
        StudyFolder(tmp_path / "study"),
    )
    assert told == [2.0], "one tick to load, one to refine"


def test_the_bar_of_a_cell_has_the_planned_length(tmp_path, monkeypatch):
    scene = load_scene(tiny_capture(tmp_path))
    monkeypatch.setitem(RULES, "train.iterations", lambda facts, config: Verdict(6, "few"))
    config = load_config("turbogs", [*TINY, "train.iterations=auto"])
    told = []

    class Bar(Listener):
        def advanced(self, loop: TrainingLoop) -> None:
            told.append((loop.trainer.iteration, loop.trainer.iterations))

    train_cell("short", config, scene, torch.device("cpu"), provenance("cpu"), [Bar()])
    assert told == [(iteration, 6) for iteration in range(1, 7)] and config.train.iterations == "auto"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["ablate", "--out", "X"], ["--scene"]),
        (["ablate", "component", "--scene", "CAPTURE", "--out", "X"], ["did you mean 'components'"]),
        (["ablate", "components", "--scene", "absent", "--out", "X"], ["no such scene"]),
        (["ablate", "components", "--scene", "CAPTURE", "--out", "X", "--only", "+geo"], ["+geo-vs"]),
        (["ablate", "components", "--scene", "CAPTURE", "--out", "X", "--seeds", "1", "1"], ["seeds"]),
        (["ablate", "components", "--scene", "CAPTURE", "--scene", "CAPTURE", "--out", "X"], ["scenes"]),
        (["ablate", "components", "--scene", "CAPTURE", "--out", "X", "--steps", "0"], ["--steps 0"]),
        (
            ["ablate", "components", "--scene", "x/CAPTURE", "--scene", "y/CAPTURE", "--out", "X"],
            ["x/CAPTURE and", "y/"],
        ),
        *(
            (["ablate", "components", "--scene", "CAPTURE", "--out", "X", "--time-budget", time], ["amount of time"])
            for time in ("0", "nan", "inf")
        ),
        (["ablate", "components", "--scene", "CAPTURE", "--out", "CAPTURE"], ["not empty"]),
        (["ablate", "--merge", "CAPTURE", "--out", "X"], ["holds no study"]),
        *(
            (["ablate", "--merge", "CAPTURE", "--out", "X", *ignored.split()], ["--merge trains nothing"])
            for ignored in ("--steps 5", "--within 1s", "--gpus 0", "--seeds 3", "--device cpu")
        ),
        (["compare", "CAPTURE", "CAPTURE", "--out", "X"], ["holds no run"]),
        (["compare", "CAPTURE", "--out", "X"], ["two runs or more"]),
        (["report", "CAPTURE"], ["holds no study"]),
        (["report", "CAPTURE", "--psnr", "-1"], ["--psnr"]),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_bad_calls_are_refused(turbogs, capture, tmp_path, arguments, words):
    places = {"CAPTURE": capture, "X": tmp_path / "x"}
    code, out, err = turbogs(*(places.get(argument, argument) for argument in arguments))
    assert code == 2 and out == "" and err.count("\n") == 1, err
    for word in words:
        assert word in err
    assert not (tmp_path / "x").exists()


def test_a_limit_of_memory_which_is_of_a_process_is_refused():
    with pytest.raises(InputError, match=r"variant 'sparse-adam'.*max_memory.*max_gaussians"):
        variant_config(load_ablation("parts"), "sparse-adam", 0, ("budget.max_memory=2GiB",), None)


def test_a_cell_keeps_a_cap_on_gaussians(tmp_path):
    scene = load_scene(tiny_capture(tmp_path))
    config = load_config("turbogs", [*TINY, "density.max_gaussians=90"])
    result = train_cell("capped", config, scene, torch.device("cpu"), provenance("cpu"))
    assert [evaluation.num_gaussians <= 90 for evaluation in result.history] == [True] * 3
