"""Benches on the reference path: what they measure adds up, and they leave no trace."""

import itertools
import json
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from helpers.framework_runs import assert_identical, tiny_trainer
from helpers.refusals import assert_one_line
from helpers.simulated_time import OperatorTime, SimulatedTime
from helpers.synthetic_capture import surface_gaussians

from turbogs_plugin.bench import floors
from turbogs_plugin.bench.step import bench_step
from turbogs_plugin.bench.timing import BLOCKS, STEPS, Mark, Recorder, back_to_back, measure, recorded, summary
from turbogs_plugin.bench.workloads import resized
from turbogs_plugin.model.initial import with_degree
from turbogs_plugin.model.ply import save_ply

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def ply(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("model") / "model.ply"
    save_ply(surface_gaussians(300, CPU), path)
    return path


def test_clocks_measure_what_passes(monkeypatch):
    clock = SimulatedTime(monkeypatch)
    first = Mark(CPU)
    clock.passes(0.25)
    assert first.until(Mark(CPU)) == first.host_until(Mark(CPU)) == 250.0
    assert summary([3.0, 1.0, 2.0]) == {"median_ms": 2.0, "p10_ms": 1.2, "p90_ms": 2.8}
    durations = iter([64.0, 1.0, 2.0, 4.0])  # the first is a call to warm up
    assert measure(lambda: clock.passes(next(durations)), 3, CPU) == summary([1000.0, 2000.0, 4000.0])
    durations = itertools.chain.from_iterable([0.0, 2.0 * block] for block in range(BLOCKS))
    assert back_to_back(lambda: clock.passes(next(durations)), 2, CPU) == summary([1e3 * b for b in range(BLOCKS)])


def test_the_recorder_marks_the_trainers_own_steps_and_leaves_no_trace(capture, monkeypatch):
    recorder, operators = Recorder(CPU), OperatorTime(monkeypatch)
    plain, watched = (tiny_trainer(capture) for _ in range(2))
    with operators, recorded(watched, recorder) as iteration:
        for _ in range(2):
            iteration()
    watched.step()
    for _ in range(3):
        plain.step()
    assert_identical(dict(plain.gaussians.items()), dict(watched.gaussians.items()))
    steps = recorder.summaries()
    assert set(steps) == {"iteration", *STEPS} and all(len(spans) == 2 for spans in recorder.spans.values())
    for number in range(2):  # with operators for a clock: the steps lie one after the other, and are nearly all of it
        spans = {name: tuple(mark.host for mark in recorder.spans[name][number]) for name in steps}
        start, end = spans.pop("iteration")
        marks = [start, *itertools.chain.from_iterable(sorted(spans.values())), end]
        assert marks == sorted(marks)
        assert sum(last - first for first, last in spans.values()) > 0.9 * (end - start) > 100


@pytest.mark.parametrize("count", [150, 300, 1000])
def test_a_resized_model_covers_what_it_did(count):
    model = surface_gaussians(300, CPU)
    other = resized(model, count)
    assert len(other) == count and all(value.isfinite().all() for _, value in other.items())
    before, after = ((2 * gaussians.scales.mean(dim=1)).exp().sum().item() for gaussians in (model, other))
    assert after == pytest.approx(before, rel=0.35)


def test_contributions_are_the_set_bits_of_the_walked_masks():
    """Two tiles of 40 and 5 intersections, one chunk each: buckets of 32, so 2 and 1. The masks of tile t begin at
    start // 32 + t."""
    counts, masks = torch.tensor([2, 1], dtype=torch.int32), torch.tensor([0b1011, -1, 0b1, 0b11111], dtype=torch.int32)
    pixels = SimpleNamespace(bucket_counts=counts, chunks=1, masks=masks)
    forward = SimpleNamespace(tile_starts=torch.tensor([0, 40, 45], dtype=torch.int32), pixels=pixels)
    counts = floors.count_contributions(SimpleNamespace(_forward=forward))
    assert counts == {"walked": 96, "contributing": 3 + 32 + 1}


def bench(turbogs, what: str, out: Path, *options: object) -> tuple[str, dict]:
    """What a bench prints, and its file."""
    code, printed, error = turbogs("bench", what, *options, "--out", out, "train.device=cpu")
    assert code == 0 and str(out) in printed, error
    return printed, json.loads(out.read_text())


def test_bench_step_says_what_it_measured_on(turbogs, capture, ply, tmp_path):
    sizes = ("--gaussians", 500, "--views", 3, 2, "--repeats", 1)
    options = ("--scene", capture, "--ply", ply, *sizes, "train.sh_degree=1")
    printed, report = bench(turbogs, "step", tmp_path / "step.json", *options)
    assert "M=500 K=3" in printed and report["overrides"] == ["train.sh_degree=1", "train.device=cpu"]
    assert report["device"] == "cpu" and "reference" in report["provenance"]["kernels"]
    assert [entry["views"] for entry in report["passes"]] == [3, 2]
    for entry in report["passes"]:
        assert set(entry["steps"]) == {"iteration", *STEPS}
        assert entry["counts"]["gaussians"] == 500 and 0 < entry["counts"]["touched"] <= 500
        assert entry["counts"]["pixels"] == entry["views"] * 40 * 24
        assert entry["memory_bytes"]["parameters"] > 500 * 4 * 14
        assert entry["lost_iterations"] == 0 and entry["wall"]["median_ms"] > 0


def test_bench_step_uses_the_bands_that_the_model_has(scene):
    model = with_degree(surface_gaussians(100, CPU), 1)
    assert len(bench_step(scene, [model], (1,), 1, ["train.device=cpu"])["passes"]) == 1


def test_bench_raster_says_what_it_measured_on(turbogs, capture, ply, tmp_path):
    options = ("--scene", capture, "--ply", ply, "--gaussians", 300, "--views", 2, "--repeats", 1)
    printed, report = bench(turbogs, "raster", tmp_path / "raster.json", *options)
    passes = [(entry["rate"], entry["density_sums"]) for entry in report["passes"]]
    assert passes == [(0.5, False), (1.0, False), (0.1, False), (0.5, True)] and "r=0.50:" in printed
    assert (report["scene"], report["image_size"], report["model"]) == ("capture", [40, 24], "model.ply")


@pytest.mark.parametrize(
    ("call", "word"),
    [
        ("step --ply PLY", "it needs --scene"),
        ("step --scene CAPTURE", "--ply MODEL.ply"),
        ("wall --scene CAPTURE --ply PLY", "leave --ply out"),
        ("step --scene CAPTURE --ply absent.ply", "absent.ply"),
        ("raster --scene CAPTURE --ply PLY --views 0", "--views 0"),
        ("wall --scene CAPTURE --out absent/bench.json", "name a file"),
    ],
)
def test_bad_calls_are_refused(turbogs, capture, ply, call, word):
    words = call.replace("CAPTURE", str(capture)).replace("PLY", str(ply)).split()
    assert_one_line(turbogs("bench", words[0], "train.device=cpu", *words[1:]), word)
