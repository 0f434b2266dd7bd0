"""`turbogs ablate`: cells are trained once, by one process or several, and calls go on where others stopped."""

import json
import multiprocessing
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.framework_runs import TINY, tiny_capture
from helpers.processes import PRELOADED
from helpers.refusals import assert_one_line
from helpers.simulated_time import SimulatedTime

from turbogs_plugin.captures.demo import write_demo_capture
from turbogs_plugin.captures.load import load_scene
from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.plan.decisions import RULES
from turbogs_plugin.report.provenance import provenance
from turbogs_plugin.study import cell as cell_module
from turbogs_plugin.study import run_cells
from turbogs_plugin.study.cell import capture_digest, train_cell
from turbogs_plugin.study.grid import CellKey, load_ablation
from turbogs_plugin.study.results import StudyFolder, flat_settings
from turbogs_plugin.study.run_cells import CellChoice, run_study
from turbogs_plugin.train.history import read_history
from turbogs_plugin.train.run import train
from turbogs_plugin.train.run_files import RunFolder
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


SETTINGS = ("train.sh_degree=1", "schedule.min_views=1", "schedule.max_views=2", "train.evaluate_at=[]")
SETTINGS += ("schedule.pixel_budget=0.3", "train.device=cpu")


def call(small: Path, capture: Path, out: Path, *more) -> list:
    return ["ablate", small, *SETTINGS, "--scene", capture, "--out", out, "--steps", "4", *more]


@pytest.fixture(scope="module")
def trained(capture, tmp_path_factory) -> Path:
    """Folder of a study with the cell of `full` and seed 0. Not to be changed."""
    folder = tmp_path_factory.mktemp("trained")
    (folder / "small.yaml").write_text(SMALL)
    choice = CellChoice([capture], only=["full"], overrides=SETTINGS, steps=4)
    assert run_study(load_ablation(str(folder / "small.yaml")), choice, folder / "study") == []
    return folder / "study"


@pytest.fixture
def study(trained, tmp_path) -> Path:
    return Path(shutil.copytree(trained, tmp_path / "study"))


def no_training(monkeypatch) -> None:
    monkeypatch.setattr(Trainer, "step", lambda trainer: pytest.fail("a finished cell was trained again"))


def test_a_study_is_complete_and_goes_on_where_it_stopped(turbogs, small, capture, tmp_path, monkeypatch, warm):
    out = tmp_path / "study"
    again = call(small, capture, out, "--seeds", "0", "1")
    code, printed, err = turbogs(*again)
    assert code == 0 and str(out / "report.md") in printed and "[4/4]" in err
    cells = sorted(out.glob("cells/capture/*.json"))
    assert [path.name for path in cells] == [f"{name}--seed{n}.json" for name in ("full", "random") for n in range(2)]
    results = StudyFolder(out).read_study().results
    assert results[0].final["iteration"] == 4 and results[0].provenance.machine
    assert all(each.final["cell_seconds"] > each.final["seconds"] for each in results), "and the loading"
    page = (out / "report.md").read_text()
    mean = np.mean([result.final["psnr"] for result in results[2:]])
    for word in (f"| {mean:.2f} ± ", "a \\| bar", "error-over-time.png", "LPIPS was not"):
        assert word in page, word
    assert {path.name for path in out.iterdir()} == {"cells", "error-over-time.png", "report.md", "results.json"}
    no_training(monkeypatch)
    stamps = [path.stat().st_mtime_ns for path in cells]
    code, printed, _ = turbogs(*again)
    assert code == 0 and [path.stat().st_mtime_ns for path in cells] == stamps and "4 of 4 cells" in printed
    shutil.rmtree(out / "cells")
    assert turbogs(*again)[0] == 0, "results.json alone is enough"
    before = (out / "report.md").read_bytes()
    assert turbogs("report", out)[0] == 0 and (out / "report.md").read_bytes() == before


@pytest.mark.parametrize(
    ("trouble", "of", "ended", "kept"),
    [(RuntimeError("no such kernel"), "error_guided", 1, "random"), (KeyboardInterrupt(), "random", 130, "full")],
    ids=["broken", "interrupted"],
)
def test_a_cell_that_did_not_end_is_tried_again(
    turbogs, small, capture, tmp_path, monkeypatch, trouble, of, ended, kept
):
    """The study has a report of the other cell, which is kept."""
    out, step = tmp_path / "study", Trainer.step

    def troubled(trainer):
        if trainer.config.pixel_sampler["type"] == of:
            raise trouble
        step(trainer)

    monkeypatch.setattr(Trainer, "step", troubled)
    code, printed, err = turbogs(*call(small, capture, out))
    assert code == ended and "report" in printed
    assert ended == 130 or ("no such kernel" in printed and "FAILED" in err)
    assert [result.variant for result in StudyFolder(out).read_study().results] == [kept]
    monkeypatch.setattr(Trainer, "step", step)
    code, _, err = turbogs(*call(small, capture, out))
    number = 1 if kept == "random" else 2
    assert code == 0 and f"[{number}/2]" in err and f"[{3 - number}/2]" not in err


def test_a_cell_of_other_settings_is_not_mixed_in(turbogs, small, capture, study, tmp_path):
    """Neither is one of another capture of the same name, nor of an ablation that has its variant no more."""
    before = {path: path.read_bytes() for path in study.rglob("*") if path.is_file()}
    ablate, file, *rest = call(small, capture, study, "--only", "full")
    for further in ((), ("--seeds", "1")):
        code, _, err = turbogs(ablate, file, "loss.ncc_weight=0.1", *rest, *further)
        assert code == 2 and "other settings (loss.ncc_weight)" in err
    small.write_text(SMALL.replace("full", "whole"))
    assert_one_line(turbogs(*call(small, capture, study)), "capture, full, seed 0", "put its variant back")
    assert {path: path.read_bytes() for path in study.rglob("*") if path.is_file()} == before
    small.write_text(SMALL)
    other = write_demo_capture(tmp_path / capture.name, views=9, width=48, height=40)
    code, _, err = turbogs(*call(small, other, study, "--only", "full", "--seeds", "1"))
    assert code == 2 and "has other photos than its kept cells" in err


def test_a_capture_that_cannot_be_read_stops_no_other(turbogs, small, capture, study, tmp_path):
    code, _, err = turbogs(*call(small, tmp_path, study, "--scene", capture, "--seeds", "1"))
    assert (code, len(StudyFolder(study).read_study().results)) == (2, 3) and err.count("turbogs reconstruct") == 1


def test_a_process_warms_up_once_for_a_variant_and_capture(turbogs, small, capture, tmp_path, monkeypatch):
    other, warmed = shutil.copytree(capture, tmp_path / "other"), []
    monkeypatch.setattr(cell_module, "warm_up", lambda config, scene, *rest: warmed.append(scene.name))
    code, _, err = turbogs(*call(small, capture, tmp_path / "study", "--scene", other, "--seeds", "0", "1"))
    assert code == 0 and "[8/8]" in err and warmed == ["capture", "capture", "other", "other"]


@pytest.mark.parametrize("length", ["train.iterations=30", "train.iterations=8"])
def test_a_cell_with_a_time_budget_is_trained_as_a_run_with_one(small, capture, tmp_path, length, warm, monkeypatch):
    """Fewer iterations than configured, or more pixels: the same numbers, and the same resolved configuration."""
    SimulatedTime(monkeypatch, tick=1e-9).in_iterations(monkeypatch, lambda trainer: 0.125)
    settings = (*TINY, length, "budget.time=2s")
    train(load_config("turbogs", [*settings, f"scene.path={capture}"]), tmp_path / "run")
    choice = CellChoice([capture], only=["full"], overrides=settings)
    assert run_study(load_ablation(str(small)), choice, tmp_path / "study") == []
    (cell,) = StudyFolder(tmp_path / "study").read_study().results
    assert 1.6 < cell.final["seconds"] < 2.4
    history = read_history(tmp_path / "run" / "history.jsonl")
    assert cell.curve["iteration"] == [entry.iteration for entry in history]
    assert cell.curve["psnr"] == [round(entry.psnr, 3) for entry in history]
    config = flat_settings(RunFolder(tmp_path / "run").read_config().to_mapping())
    assert cell.settings | cell.planned == config
    assert cell.planned["train.iterations"] != cell.settings["train.iterations"]


def told_to_a_file(gpu: int, gpus: int, arguments: tuple) -> list[str]:
    """`run_cells._work`, told to a file: the server of these processes has the stderr of the test that started it."""
    with (arguments[2].path.parent / f"told-{gpu}").open("w") as sys.stderr:
        return run_cells._work(gpu, gpus, arguments)


def test_two_workers_train_each_cell_once(turbogs, small, tmp_path, monkeypatch):
    """Forked from a server that has torch, where the command starts Python; what they are told is pickled in both."""
    capture, server = tiny_capture(tmp_path), multiprocessing.get_context("forkserver")
    server.set_forkserver_preload(PRELOADED)
    monkeypatch.setattr(multiprocessing, "get_context", {"spawn": server}.__getitem__)
    monkeypatch.setattr(run_cells, "_work", told_to_a_file)
    code, *_ = turbogs(*call(small, capture, tmp_path / "study", "--seeds", "0", "1", "--gpus", "2"))
    told = "".join(path.read_text() for path in tmp_path.glob("told-*"))
    assert code == 0 and len(StudyFolder(tmp_path / "study").read_study().results) == 4, told
    trained = [line.partition("] ")[2].partition(":")[0] for line in told.splitlines() if " dB in " in line]
    assert len(trained) == 4 == len(set(trained))
    assert (tmp_path / "study/report.md").is_file()


def claim(folder: StudyFolder, key: CellKey, claimed, end) -> None:
    with folder.claimed(key):
        claimed.set()
        end.wait()


def test_a_cell_that_another_process_trains_is_left_to_it_until_that_dies(small, capture, tmp_path, monkeypatch):
    folder, context = StudyFolder(tmp_path / "study"), multiprocessing.get_context("fork")
    folder.write_study(run_cells.Study(load_ablation(str(small)), []))
    key, claimed, end = CellKey(capture.name, "full", 0), context.Event(), context.Event()
    other = context.Process(target=claim, args=(folder, key, claimed, end), daemon=True)
    other.start()
    assert claimed.wait(60.0)
    choice = CellChoice([capture], only=["full"], overrides=SETTINGS, steps=4)
    with monkeypatch.context() as patch:
        no_training(patch)
        assert run_study(load_ablation(str(small)), choice, folder.path) == []
    other.kill()
    other.join(60.0)
    assert run_study(load_ablation(str(small)), choice, folder.path) == []
    assert [result.key for result in folder.read_study().results] == [key]


def test_the_digest_of_a_capture_is_of_names_and_sizes(capture):
    scene = load_scene(capture)
    before = capture_digest(scene)
    assert capture_digest(load_scene(capture)) == before != capture_digest(load_scene(capture, 2))
    scene.train.names = ("other", *scene.train.names[1:])
    assert capture_digest(scene) != before


def test_a_cell_has_the_planned_length_and_keeps_a_cap_on_gaussians(tmp_path, monkeypatch):
    scene = load_scene(tiny_capture(tmp_path))
    monkeypatch.setitem(RULES, "iterations", lambda facts, config: (6, "few"))
    capped = ["train.iterations=auto", "density.max_gaussians=90"]
    result = train_cell("x", load_config("turbogs", [*TINY, *capped]), scene, torch.device("cpu"), provenance("cpu"))
    assert result.final["iteration"] == 6 == result.planned["train.iterations"]
    assert max(result.curve["gaussians"]) <= 90 and result.settings["train.iterations"] == "auto"
    assert json.dumps(result.settings) and "lpips" not in result.final


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("ablate components --out X", "needs --scene"),
        ("ablate components --scene absent --out X", "no such scene"),
        ("ablate components --scene CAPTURE --out X --seeds 1 1", "seeds"),
        ("ablate components --scene CAPTURE --out X --seeds 1 --seeds 2", "--seeds is given twice"),
        ("ablate components --scene CAPTURE --scene CAPTURE --out X", "are called the same"),
        ("ablate components --scene CAPTURE --out X --gpus 0", "--gpus 0"),
        ("ablate components --scene CAPTURE --out X --gpus 999", "--gpus 999"),
        ("ablate components train.seed=5 --scene CAPTURE --out X", "train.seed is given by --seeds"),
        ("ablate components budget.time=1s --scene CAPTURE --out X --steps 4", "time budget 1s exclude each other"),
        ("ablate components budget.max_memory=2GiB --scene CAPTURE --out X", "max_memory limits a whole process"),
        ("ablate components --scene CAPTURE --out CAPTURE", "not empty"),
        ("report CAPTURE --out X", "two runs or more"),
        ("report CAPTURE", "holds no study"),
    ],
)
def test_bad_calls_are_refused(turbogs, capture, tmp_path, arguments, words):
    places = {"CAPTURE": capture, "X": tmp_path / "x"}
    assert_one_line(turbogs(*(places.get(argument, argument) for argument in arguments.split())), words)
    assert not (tmp_path / "x").exists()
