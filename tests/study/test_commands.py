"""`turbogs ablate` and `turbogs compare`: sweeps that go on where they stopped, and their reports."""

import csv
import itertools
import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.framework_runs import TINY, tiny_capture

from turbogs_plugin import cli
from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.config.scaling import with_iterations
from turbogs_plugin.errors import InputError
from turbogs_plugin.report import provenance as provenance_module
from turbogs_plugin.report.provenance import provenance
from turbogs_plugin.scene import load_scene, write_demo_capture
from turbogs_plugin.study.cell import capture_digest, train_cell
from turbogs_plugin.study.compare import study_of_runs
from turbogs_plugin.study.grid import load_ablation, variant_config
from turbogs_plugin.study.results import CellResult, StudyFolder
from turbogs_plugin.train.history import Evaluation, append_evaluation
from turbogs_plugin.train.trainer import Trainer

SMALL = """
title: Tiny
base: turbogs
baseline: full
variants:
  full: []
  random: [pixel_sampler.type=random]
notes: {random: "a | bar"}
"""


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    return tiny_capture(tmp_path_factory.mktemp("ablation"))


@pytest.fixture
def small(tmp_path) -> Path:
    path = tmp_path / "small.yaml"
    path.write_text(SMALL)
    return path


SETTINGS = ("train.sh_degree=1", "schedule.min_views=1", "schedule.max_views=2", "train.evaluate_at=[0.5]")


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


def test_a_sweep_is_complete_and_goes_on_where_it_stopped(turbogs, small, capture, tmp_path, monkeypatch):
    out = tmp_path / "study"
    code, printed, err = turbogs(*call(small, capture, out, "--seeds", "0", "1"))
    assert code == 0 and str(out / "report.html") in printed
    assert "[4/4]" in err and "left" in err
    cells = sorted(out.glob("cells/capture/*.json"))
    assert [path.name for path in cells] == [f"{name}--seed{n}.json" for name in ("full", "random") for n in (0, 1)]
    first = json.loads(cells[0].read_text())
    assert first["history"][-1]["iteration"] == 4 and first["warmup_iterations"] == 2
    assert first["provenance"]["machine"] and first["config"]["train"]["iterations"] == 4

    rows = list(csv.DictReader((out / "table.csv").open()))
    assert [row["variant"] for row in rows] == ["full", "random"]
    mean = np.mean([json.loads(path.read_text())["history"][-1]["psnr"] for path in cells[2:]])
    assert float(rows[1]["psnr_mean"]) == pytest.approx(mean) and rows[1]["lpips_mean"] == ""
    worst = [json.loads(path.read_text())["history"][-1]["worst_psnr"] for path in cells[2:]]
    assert float(rows[1]["worst_psnr_low"]) == pytest.approx(min(worst)) and min(worst) < mean

    page, markdown = (out / "report.html").read_text(), (out / "report.md").read_text()
    assert page.count("data:image/png;base64,") == 2 and not re.search(r"(src|href)=\"(?!data:)", page)
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
    code, _, err = turbogs(*call(small, capture, study, "--only", "full", "--time-budget", "1"))
    assert code == 2 and "time budget" in err
    assert {path: path.read_bytes() for path in study.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"time_budget": None}, "full--seed0.json.*time_budget: expected a number"),
        ({"variant": 1}, "full--seed0.json.*variant: expected text"),
        ({"seed": "0"}, "full--seed0.json.*seed: expected a whole number"),
        ({"variant": "other"}, "other--seed0.json.*no variant"),
    ],
)
def test_a_cell_that_cannot_be_used_is_named_by_its_file(small, tmp_path, changes, words):
    folder = StudyFolder(tmp_path / "study")
    folder.write_ablation(load_ablation(str(small)))
    folder.write(CellResult("fox", "full", 0, {}, 0.0, [Evaluation(4, 1.0, 30.0, 0.8, 0.1, 100, 2**20)]))
    path = folder.cells / "fox" / "full--seed0.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    with pytest.raises(InputError, match=words):
        folder.read_study()


def test_a_time_budget_ends_a_cell(turbogs, small, capture, tmp_path):
    out = tmp_path / "study"
    arguments = call(small, capture, out, "--only", "full", "--time-budget", "0.001")
    arguments[arguments.index("4")] = "400"
    assert turbogs(*arguments)[0] == 0
    result = StudyFolder(out).read_study().results[0]
    assert result.stopped_early and 1 <= result.final.iteration < 4
    assert "Stopped by the time budget" in (out / "report.md").read_text()


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
    assert list(StudyFolder(out).read_ablation().variants) == ["full", "random", "l1"]
    assert turbogs("ablate", "--merge", out, "--out", tmp_path / "merged")[0] == 0


def test_a_variant_that_steps_make_a_copy_is_left_out_and_said(turbogs, capture, tmp_path):
    looks, out = tmp_path / "looks.yaml", tmp_path / "study"
    looks.write_text(
        "title: Looks\nvariants: {nothing: [plan.iterations=keep], few: [plan.iterations=auto, plan.looks=5]}"
    )
    code, _, err = turbogs(*call(looks, capture, out))
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
    other.write_text(other.read_text().replace('"fps": ', '"fps": 1'))
    code, _, err = turbogs("ablate", "--merge", *parts, out, "--out", tmp_path / "c")
    assert code == 2 and "two different results" in err


def test_cells_of_the_same_settings_are_reused_from_another_study(turbogs, capture, study, tmp_path, monkeypatch):
    first, other = study, tmp_path / "other.yaml"
    other.write_text("title: Other\nvariants: {same: [], l1: [loss.type=charbonnier]}\n")
    code, _, err = turbogs(*call(other, capture, tmp_path / "second", "--reuse", first))
    assert code == 0 and "1 finished cells are kept" in err and "[1/1]" in err
    taken, (made,) = StudyFolder(tmp_path / "second").read_study().results[0], StudyFolder(first).read_study().results
    assert taken.variant == "same" and taken.history == made.history
    monkeypatch.setenv("TURBOGS_COMMIT", "another")
    code, _, err = turbogs(*call(other, capture, tmp_path / "third", "--reuse", first))
    assert code == 0 and "kept" not in err and "[2/2]" in err
    monkeypatch.setenv("TURBOGS_COMMIT", "one-modified")
    code, _, err = turbogs(*call(other, capture, tmp_path / "fourth", "--reuse", first))
    assert code == 2 and "known commit" in err and not (tmp_path / "fourth").exists()


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
    code, _, err = turbogs(*call(small, other, second, "--only", "full", "--reuse", first))
    assert code == 0 and "kept" not in err and "[1/1]" in err
    code, _, err = turbogs("ablate", "--merge", first, second, "--out", tmp_path / "both")
    assert code == 2 and "two different captures" in err


def test_a_cell_of_an_unknown_capture_is_kept_and_merged_but_not_reused(turbogs, small, capture, study, tmp_path):
    old = study
    (path,) = old.glob("cells/*/*.json")
    mapping = json.loads(path.read_text())
    assert mapping.pop("capture") == capture_digest(load_scene(capture))
    path.write_text(json.dumps(mapping))
    code, _, err = turbogs(*call(small, capture, old, "--only", "full"))
    assert code == 0 and "1 finished cells are kept" in err
    assert turbogs("ablate", "--merge", old, "--out", tmp_path / "merged")[0] == 0
    code, _, err = turbogs(*call(small, capture, tmp_path / "new", "--only", "full", "--reuse", old))
    assert code == 0 and "kept" not in err and "[1/1]" in err


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
    shutil.copytree(tmp_path / "a", tmp_path / "again")
    code, _, err = turbogs("compare", *paths, tmp_path / "again", "--out", tmp_path / "other")
    assert code == 2 and "same run" in err


def a_run(folder: Path, iterations: int, *overrides: str) -> Path:
    """What `compare` reads of a run."""
    folder.mkdir()
    (folder / "config.yaml").write_text(with_iterations(load_config("turbogs", overrides), iterations).to_yaml())
    append_evaluation(folder / "history.jsonl", Evaluation(iterations, 20.0, 30.0, 0.8, 0.1, 100, 2**20))
    return folder


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


def test_runs_of_one_time_budget_are_seeds_however_long_they_came_out(tmp_path):
    def run(name: str, seed: int, time: str, iterations: int, pixel_budget: float, *overrides: str) -> Path:
        settings = [f"train.seed={seed}", f"budget.time={time}", f"schedule.pixel_budget={pixel_budget}", *overrides]
        return a_run(tmp_path / name, iterations, *settings)

    runs = [
        run("a", 0, "20s", 2600, 1.0),
        run("b", 1, "20s", 2471, 1.5),
        run("longer", 0, "30s", 2600, 1.0),
        run("other", 0, "20s", 2600, 1.0, "density.prune_opacity=0.02"),
        run("free", 0, "''", 2600, 1.0),
        run("free-2", 1, "''", 2471, 1.0),
    ]
    study = study_of_runs(runs)
    assert {name: len(study.of("", name)) for name in study.ablation.variants} == {
        "a": 2, "longer": 1, "other": 1, "free": 1, "free-2": 1,
    }  # fmt: skip
    assert study.ablation.variants["longer"] == ["budget.time=30s"]


def test_the_bar_of_a_cell_has_the_planned_length(tmp_path):
    scene = load_scene(tiny_capture(tmp_path))
    config = load_config("turbogs", [*TINY, "plan.iterations=6"])
    told = []
    advance = lambda iteration, total: told.append((iteration, total))  # noqa: E731
    train_cell("short", config, scene, torch.device("cpu"), provenance("cpu"), progress=advance)
    assert told == [(iteration, 6) for iteration in range(1, 7)] and config.train.iterations == 14


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["ablate", "--out", "X"], ["--scene"]),
        (["ablate", "component", "--scene", "CAPTURE", "--out", "X"], ["did you mean 'components'"]),
        (["ablate", "components", "--scene", "absent", "--out", "X"], ["no such scene"]),
        (["ablate", "components", "--scene", "CAPTURE", "--out", "X", "--only", "+geo"], ["+geo-vs"]),
        (["ablate", "components", "--scene", "CAPTURE", "--out", "X", "--seeds", "1", "1"], ["seeds"]),
        (["ablate", "components", "--scene", "CAPTURE", "--scene", "CAPTURE", "--out", "X"], ["scenes"]),
        (["ablate", "components", "--scene", "CAPTURE", "--out", "X", "--steps", "0"], ["iteration"]),
        (
            ["ablate", "components", "--scene", "x/CAPTURE", "--scene", "y/CAPTURE", "--out", "X"],
            ["x/CAPTURE and", "y/"],
        ),
        *(
            (["ablate", "components", "--scene", "CAPTURE", "--out", "X", "--time-budget", time], ["time budget"])
            for time in ("-1", "nan", "inf")
        ),
        (["ablate", "components", "--scene", "CAPTURE", "--out", "CAPTURE"], ["not empty"]),
        (["ablate", "--merge", "CAPTURE", "--out", "X"], ["holds no ablation"]),
        (["compare", "CAPTURE", "--out", "X"], ["holds no run"]),
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


@pytest.mark.parametrize("budget", ["budget.time=20s", "budget.max_memory=2GiB"])
def test_budgets_of_single_runs_are_refused(budget):
    with pytest.raises(InputError, match=r"variant 'moment-lm'.*--time-budget"):
        variant_config(load_ablation("optimizer"), "moment-lm", 0, (budget,), None)


def test_a_cell_keeps_a_cap_on_gaussians(tmp_path):
    scene = load_scene(tiny_capture(tmp_path))
    config = load_config("turbogs", [*TINY, "budget.max_gaussians=90"])
    result = train_cell("capped", config, scene, torch.device("cpu"), provenance("cpu"))
    assert [evaluation.num_gaussians <= 90 for evaluation in result.history] == [True] * 3
