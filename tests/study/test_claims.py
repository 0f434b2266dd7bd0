"""Cells shared by several processes: one has a cell, a dead one's is taken over, nothing is trained twice."""

from __future__ import annotations

import itertools
import json
import multiprocessing
import os
import sys
import time
from pathlib import Path

import pytest
from helpers.framework_runs import TINY, tiny_capture
from helpers.processes import PRELOADED, comes_true

from turbogs_plugin import cli
from turbogs_plugin.commands import studies
from turbogs_plugin.errors import InputError
from turbogs_plugin.report.provenance import provenance
from turbogs_plugin.study import claims as claims_module
from turbogs_plugin.study import sweep
from turbogs_plugin.study.claims import STALE_SECONDS, Claims
from turbogs_plugin.study.folder import StudyFolder
from turbogs_plugin.study.grid import Ablation, CellKey, load_ablation
from turbogs_plugin.study.results import CellResult, Failure, Study
from turbogs_plugin.study.results_file import study_from_json
from turbogs_plugin.study.sweep import SweepOptions
from turbogs_plugin.train.history import Evaluation

pytestmark = pytest.mark.usefixtures("plotted")

KEY = CellKey("fox", "a.b[1]", 3)
OTHER = CellKey("fox", "a.b[1]", 31)


def claim_many(folder: Path, ready, results) -> None:
    ready.wait()
    claims = Claims(folder)
    results.put([seed for seed in range(30) if claims.take(CellKey("fox", "full", seed)) is not None])


def test_of_many_processes_one_has_each_cell(tmp_path):
    """They live on until all have claimed: a dead one's cells would be taken over."""
    context = multiprocessing.get_context("fork")
    ready, results = context.Event(), context.Queue()
    processes = [context.Process(target=claim_many, args=(tmp_path, ready, results)) for _ in range(3)]
    for process in processes:
        process.start()
        os.kill(process.pid, 0)
    ready.set()
    taken = [results.get(timeout=60) for _ in processes]
    for process in processes:
        process.join()
    assert len(taken) == 3
    claimed = {path.name for path in (tmp_path / "fox").iterdir() if not path.name.startswith(".")}
    assert {f"full--seed{seed}.0" for seed in range(30)} <= claimed
    firsts = [seed for seeds in taken for seed in seeds]
    again = [name for name in claimed if name.endswith(".1")]
    assert len(firsts) == 30 + len(again)  # a second time only where its first holder had ended


def test_a_claim_is_alone_and_gone_when_its_cell_is_trained(tmp_path):
    claims = Claims(tmp_path)
    claim = claims.take(KEY)
    with claim.kept():
        assert claims.take(KEY) is None and claims.take(OTHER) is not None
        assert claim.held
    assert claims.take(KEY) is not None


def test_a_dead_process_of_this_host_loses_its_claim_at_once(tmp_path):
    context = multiprocessing.get_context("fork")
    dead = context.Process(target=lambda: Claims(tmp_path).take(KEY))
    dead.start()
    dead.join()
    first = json.loads((tmp_path / "fox/a.b[1]--seed3.0").read_text())
    assert first["process"] == dead.pid
    claim = Claims(tmp_path).take(KEY)
    assert claim.generation == 1
    with claim.kept():
        pass
    assert [path.name for path in (tmp_path / "fox").iterdir()] == []


@pytest.mark.parametrize("age", [0.5 * STALE_SECONDS, 2 * STALE_SECONDS])
def test_a_process_of_another_host_loses_its_claim_when_it_is_silent(tmp_path, age):
    claims = Claims(tmp_path)
    claim = claims.take(KEY)
    claim.path.write_text(json.dumps({"host": "elsewhere", "process": 1, "started": "1"}))
    then = time.time() - age
    os.utime(claim.path, (then, then))
    taken = Claims(tmp_path).take(KEY)
    assert (taken is not None) == (age > STALE_SECONDS)
    assert claim.held == (taken is None)


def test_a_kept_claim_stays_alive(tmp_path, monkeypatch):
    monkeypatch.setattr(claims_module, "HEARTBEAT_SECONDS", 0.01)
    claim = Claims(tmp_path).take(KEY)
    os.utime(claim.path, (0, 0))
    with claim.kept():
        assert comes_true(lambda: claim.path.stat().st_mtime > 0, 30.0)


ABLATION = """
title: Shared
base: turbogs
baseline: full
variants:
  full: []
  random: [pixel_sampler.type=random]
"""
SETTINGS = [text for text in TINY if text.startswith("schedule")] + ["train.sh_degree=1", "train.evaluate_at=[0.5]"]


def call(folder: Path, capture: Path, *more: str) -> list[str]:
    (folder / "shared.yaml").write_text(ABLATION)
    names = ["ablate", str(folder / "shared.yaml"), *SETTINGS, "--scene", str(capture), "--out", str(folder / "study")]
    return [*names, "--device", "cpu", "--steps", "4", "--seeds", "0", "1", *more]


def test_two_workers_train_each_cell_once(tmp_path, monkeypatch, capfd):
    """Forked from a server that has torch, where the command starts Python; what they are told is pickled in both."""
    capture, server = tiny_capture(tmp_path), multiprocessing.get_context("forkserver")
    server.set_forkserver_preload(PRELOADED)
    monkeypatch.setattr(multiprocessing, "get_context", {"spawn": server}.__getitem__)
    arguments = ["turbogs", *call(tmp_path, capture, "--gpus", "0,1")]

    def told_by(code: int, *more: str) -> tuple[str, str]:
        monkeypatch.setattr(sys, "argv", [*arguments, *more])
        with pytest.raises(SystemExit) as end:
            cli.main()
        told = capfd.readouterr()
        assert (end.value.code or 0) == code, told.err
        return told.out, told.err

    failed, folder = CellKey(capture.name, "random", 1), StudyFolder(tmp_path / "study")
    folder.write_study(Study(load_ablation(str(tmp_path / "shared.yaml")), []))
    folder.write(Failure(failed, "broken by an earlier call"))
    assert "with 4 cells left" in told_by(3, "--within", "0.001s")[0]
    told = told_by(0)[1]
    study = folder.read_study()
    assert len(study.results) == 4 and not study.failures
    trained = [line for line in told.splitlines() if " dB in " in line]
    assert len(trained) == 4 == len({line.partition("] ")[2].partition(":")[0] for line in trained})
    assert (tmp_path / "study/report.md").is_file()
    assert not [path for path in (tmp_path / "study/claims").rglob("*") if path.is_file()]


@pytest.mark.parametrize("shared", [False, True], ids=["to-be-trained", "of-a-sibling"])
def test_a_cell_that_ends_elsewhere_while_photos_are_read_is_kept(capture, tmp_path, monkeypatch, shared):
    """It is not trained again, nor replaced by that of a sibling study. Each training takes a second more."""
    folder, sibling, seconds = StudyFolder(tmp_path / "study"), StudyFolder(tmp_path / "sibling"), itertools.count(1.0)
    load_and_find = sweep.load_and_find

    def train_cell(variant, config, scene, device, here, *more) -> CellResult:
        asked, where = config.to_mapping(), {"scene": scene.name, "capture": more[-1], "provenance": here}
        history = [Evaluation(4, next(seconds), 30.0, 0.8, 0.1, 100)]
        return CellResult(**where, variant=variant, seed=0, config=asked, asked=asked, history=history)

    def swept(folder: StudyFolder, *siblings: StudyFolder) -> int:
        ablation, options = Ablation("Shared", {"full": []}), SweepOptions([capture], device="cpu", steps=4)
        return sweep.run_sweep(ablation, ["full"], options, provenance("cpu"), folder, siblings)

    def load(*arguments):
        monkeypatch.setattr(sweep, "load_and_find", load_and_find)
        swept(folder)  # the other process
        folder.write_study(folder.read_study())  # with its report
        return load_and_find(*arguments)

    monkeypatch.setattr(sweep, "train_cell", train_cell)
    siblings = [sibling] if shared else []
    for other in siblings:
        swept(other)
    monkeypatch.setattr(sweep, "load_and_find", load)
    assert swept(folder, *siblings) == 0
    for study in (study_from_json(folder.file), folder.read_study()):
        assert [result.final.train_seconds for result in study.results] == [2.0 if shared else 1.0]
    assert next(seconds) == (3.0 if shared else 2.0)


def test_failures_since_the_beginning_are_not_left_to_be_tried(tmp_path):
    folder, options = StudyFolder(tmp_path), SweepOptions([Path("fox")], seeds=[0, 1, 2])
    old, new, _ = keys = [CellKey("fox", "full", seed) for seed in options.seeds]
    folder.write_study(Study(Ablation("Three", {"full": []}), []))
    folder.write(Failure(old, "broken by an earlier call"))
    before = sweep.written_before(options, ["full"], folder)
    folder.write(Failure(new, "broken"))
    assert list(before) == keys and sweep.cells_left(before, folder) == 2


def test_a_cell_that_another_process_trains_is_waited_for(tmp_path, monkeypatch, turbogs):
    """The other one dies: its cell is taken over."""
    capture = tiny_capture(tmp_path)
    folder = StudyFolder(tmp_path / "study")
    dead = multiprocessing.get_context("fork").Process(
        target=lambda: Claims(folder.claims).take(CellKey(capture.name, "full", 0))
    )
    arguments = call(tmp_path, capture, "--only", "full")
    arguments[arguments.index("--seeds") + 2] = "1"
    assert turbogs(*arguments, "--within", "0.001s")[0] == 3  # makes the study, trains nothing
    dead.start()
    dead.join()
    code, _, told = turbogs(*arguments)
    assert code == 0, told
    assert {str(result.key) for result in folder.read_study().results} == {
        f"{capture.name}, full, seed 0",
        f"{capture.name}, full, seed 1",
    }


@pytest.mark.parametrize("text", ["0,0", "a", "", "0;1"])
def test_gpus_are_different_numbers(text):
    with pytest.raises(InputError, match="--gpus"):
        studies.numbers("--gpus", text)
