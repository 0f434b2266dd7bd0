"""What `bench viewer` measures: three ways of one training, with a client in a process of its own."""

import json
import math

import pytest
from helpers.framework_runs import TINY, tiny_capture

from turbogs_plugin.bench.viewer import WAYS, ViewerRun, summarised, viewer_lines
from turbogs_plugin.bench.viewer_client import turning
from turbogs_plugin.viewer.camera import ViewerCamera


def test_the_ways_stand_side_by_side():
    runs = [ViewerRun(way, 100, seconds) for seconds in (1.0, 2.0, 4.0) for way in WAYS]
    for run in runs:
        if run.way == "client":
            run.seconds, run.frames, run.frame_rate, run.width = run.seconds * 1.25, 50, 12.5, 640
    lines = viewer_lines({"runs": [vars(run) for run in runs]})
    assert [line.split("  ")[0].strip() for line in lines] == [*WAYS]
    assert "+0.0 % [+0.0, +0.0]" in lines[0] and "(100.00, 50.00, 25.00)" in lines[1]
    assert "-20.0 % [-20.0, -20.0]" in lines[2] and "12.5 frames a second, 640 pixels wide" in lines[2]


def test_changes_are_those_beside_the_run_of_the_same_repeat():
    """A machine that gets slower from repeat to repeat says nothing about the viewer."""
    seconds = {"without": (1.0, 2.0, 4.0), "nobody looks": (1.0, 2.2, 4.0), "client": (1.1, 2.0, 8.0)}
    runs = [ViewerRun(way, 100, seconds[way][repeat]) for repeat in range(3) for way in WAYS]
    alone, nobody, client = summarised({"runs": [vars(run) for run in runs]})
    assert alone.change_text() == "+0.0 % [+0.0, +0.0]" and nobody.change_text() == "+0.0 % [-9.1, +0.0]"
    assert client.changes == pytest.approx([100 / 110 - 1, 0.0, -0.5]) and client.change_text().startswith("-9.1 %")


def test_the_client_moves_and_comes_back():
    eye = ViewerCamera((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0), 1.0, 64, 48)
    half, whole = turning(eye, 1.0), turning(eye, 2.0)
    assert math.dist(half.position, whole.position) == pytest.approx(0.1)
    assert math.dist(whole.position, turning(eye, 0.0).position) < 1e-9


def test_a_training_is_measured_with_and_without_a_viewer(turbogs, tmp_path):
    pytest.importorskip("viser")
    out = tmp_path / "viewer.json"
    capture = tiny_capture(tmp_path)
    command = ("bench", "viewer", "--scene", capture, "--repeats", 1, "--device", "cpu", "--out", out, *TINY)
    code, said, _ = turbogs(*command)
    assert code == 0 and said.count("iterations a second") == 3
    measured = json.loads(out.read_text())
    assert [run["way"] for run in measured["runs"]] == list(WAYS)
    assert all(run["iterations"] == 14 and run["seconds"] > 0 for run in measured["runs"])
    assert measured["runs"][2]["frames"] > 0 and measured["runs"][0]["frames"] == 0
    assert measured["scene"] == "capture" and all(run["gaussians"] > 0 for run in measured["runs"])


def test_it_needs_a_scene(turbogs):
    code, out, err = turbogs("bench", "viewer", "--device", "cpu")
    assert (code, out) == (2, "") and "--scene SCENE" in err
