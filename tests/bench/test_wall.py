"""`turbogs bench wall`: the command in a process of its own, part by part."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
from helpers.framework_runs import tiny_capture
from helpers.processes import command_line, ended, said, start_ranks

from turbogs_plugin.bench import wall
from turbogs_plugin.bench.wall import REST, WallRun, bench_wall, wall_lines


def forked(command: list[str], tmp_path: Path) -> SimpleNamespace:
    """The command in a process that has torch already."""
    (code,) = ended(start_ranks(1, command_line, tmp_path, command[command.index("turbogs_plugin") + 1 :]))
    return SimpleNamespace(returncode=code, stderr=said(tmp_path))


def test_the_parts_of_a_run_are_all_of_its_time(turbogs, tmp_path, monkeypatch):
    run = SimpleNamespace(run=lambda command, **_: forked(command, tmp_path / "process"), DEVNULL=None, PIPE=None)
    monkeypatch.setattr(wall, "subprocess", run)
    options = ("train.iterations=2", "train.sh_degree=0", "train.device=cpu", "--repeats", 1)
    code, out, _ = turbogs("bench", "wall", "--scene", tiny_capture(tmp_path), *options, "--out", tmp_path / "w.json")
    assert code == 0
    median = json.loads((tmp_path / "w.json").read_text())["median"]
    assert sum(median["parts"].values()) == pytest.approx(median["seconds"])
    assert {"interpreter and imports", "photos", "training", "model", "checkpoints", REST} <= set(median["parts"])
    assert 0 < median["train_seconds"] < median["model_seconds"] < median["seconds"]
    assert median["model_seconds"] - 0.01 < WallRun(**median).ready_seconds < median["seconds"]
    assert all(part in out for part in (*median["parts"], "whole command"))


def test_the_run_in_the_middle_is_shown(monkeypatch):
    runs = iter([WallRun(9.0, 5.0, 8.0, {"plan": 4.0}), WallRun(30.0, 25.8, 28.0, {}), WallRun(9.5, 5.0, 8.0, {})])
    monkeypatch.setattr(wall, "time_command", lambda arguments: next(runs))
    measured = bench_wall(["/of/mine/capture", "train.device=cpu"], 3)
    assert measured["command"] == ["turbogs", "train", "capture", "train.device=cpu"], "no path of this machine"
    assert measured["median"]["seconds"] == 9.5 and "4.00, 4.20, 4.50" in wall_lines(measured)[-1]
    assert WallRun(9.0, 5.0, 8.0, {REST: 0.25}).beside_training == 3.75
