"""`turbogs bench wall`: the command in a process of its own, part by part."""

import io
import json
import subprocess
import sys
from contextlib import redirect_stderr
from types import SimpleNamespace

import pytest
from helpers.framework_runs import tiny_capture

from turbogs_plugin import cli
from turbogs_plugin.bench import wall
from turbogs_plugin.bench.wall import REST, WallRun, bench_wall, wall_lines
from turbogs_plugin.train.session import CHECKPOINT, MODEL


def test_the_parts_of_a_run_are_all_of_its_time(turbogs, tmp_path):
    options = ("train.iterations=2", "train.sh_degree=0", "--device", "cpu", "--repeats", 1)
    code, out, _ = turbogs("bench", "wall", "--scene", tiny_capture(tmp_path), *options, "--out", tmp_path / "w.json")
    assert code == 0
    report = json.loads((tmp_path / "w.json").read_text())
    median = report["median"]
    assert sum(median["parts"].values()) == pytest.approx(median["seconds"])
    parts = {"interpreter and imports", "photos", "training", "pictures and plots", MODEL, CHECKPOINT, REST}
    assert parts <= set(median["parts"])
    assert 0 < median["train_seconds"] < median["model_seconds"] < median["seconds"]
    ready = WallRun(**median).ready_seconds
    assert median["model_seconds"] - 0.01 < ready < median["seconds"]
    assert median["parts"][REST] > 0
    sums = ("whole command", "beside training, until then", "from photos to the first iteration")
    for part in (*median["parts"], *sums):
        assert part in out


def test_the_run_in_the_middle_is_shown(monkeypatch):
    runs = iter([WallRun(9.0, 5.0, 8.0, {"plan": 4.0}), WallRun(30.0, 5.0, 8.0, {}), WallRun(9.5, 5.0, 8.0, {})])
    monkeypatch.setattr(wall, "time_command", lambda arguments: next(runs))
    measured = bench_wall(["/of/mine/capture", "--factor", "1"], 3)
    assert measured["command"] == ["turbogs", "train", "capture", "--factor", "1"], "no path of this machine"
    assert measured["median"]["seconds"] == 9.5 and len(measured["runs"]) == 3
    assert "4.00, 25.00, 4.50" in wall_lines(measured)[-1]
    assert WallRun(9.0, 5.0, 8.0, {"plan": 4.0, "photos": 1.0}).to_first_iteration == 4.0
    assert WallRun(9.0, 5.0, 8.0, {CHECKPOINT: 0.5, REST: 0.25}).beside_training == 3.25


@pytest.mark.parametrize("arguments", [(), ("--scene", "nowhere"), ("--scene", "nowhere", "--offload")])
def test_bad_input_is_one_line(turbogs, monkeypatch, arguments):
    def run_here(command: list[str], stderr: int, **options: object) -> SimpleNamespace:
        assert command[:4] == [sys.executable, "-m", cli.__name__, "train"] and stderr == subprocess.PIPE
        monkeypatch.setattr(sys, "argv", command[2:])
        with redirect_stderr(io.StringIO()) as told, pytest.raises(SystemExit) as end:
            cli.main()
        return SimpleNamespace(returncode=end.value.code, stderr=told.getvalue())

    monkeypatch.setattr(wall.subprocess, "run", run_here)
    code, out, err = turbogs("bench", "wall", *arguments, "--device", "cpu")
    assert (code, out) == (2, "") and err.count("\n") == 1
    assert "bench wall needs --scene" in err or "no such scene: nowhere" in err


def test_no_run_is_not_a_measurement(turbogs):
    assert "--repeats 0" in turbogs("bench", "wall", "--scene", "x", "--repeats", 0)[2]
