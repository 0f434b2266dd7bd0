"""Benches on the reference path: what they measure adds up, and they say what they ran on."""

import itertools
import json
import math
import pickle
import sys
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.framework_runs import tiny_config
from helpers.simulated_time import OperatorTime, SimulatedTime

from turbogs_plugin.bench import commands, floors
from turbogs_plugin.bench.clocks import BLOCKS, Mark, back_to_back, measure, summary
from turbogs_plugin.bench.commands import raster_lines, step_lines
from turbogs_plugin.bench.models import resized, ring_cameras, surface_gaussians, tile_samples, trained_model
from turbogs_plugin.bench.precision import precision
from turbogs_plugin.bench.raster import STAGES, RasterBench, stages_recorded
from turbogs_plugin.bench.recorder import STEPS, Recorder, recorded
from turbogs_plugin.bench.step import tensor_bytes
from turbogs_plugin.captures import load_scene
from turbogs_plugin.engine.cuda import library
from turbogs_plugin.engine.rendering import rasterize
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.geometry import evenly
from turbogs_plugin.train.trainer import Trainer

CPU = torch.device("cpu")


def test_clocks_measure_what_passes(monkeypatch):
    clock = SimulatedTime(monkeypatch)
    first = Mark(CPU)
    clock.passes(0.25)
    assert first.until(Mark(CPU)) == first.host_until(Mark(CPU)) == 250.0
    assert summary([3.0, 1.0, 2.0]) == {"median_ms": 2.0, "p10_ms": 1.2, "p90_ms": 2.8}
    durations = iter([64.0, 1.0, 2.0, 4.0])  # the first is a call to warm up
    assert measure(lambda: clock.passes(next(durations)), 3, CPU) == summary([1000.0, 2000.0, 4000.0])
    assert next(durations, None) is None
    durations = itertools.chain.from_iterable([0.0, 2.0 * block] for block in range(BLOCKS))
    assert back_to_back(lambda: clock.passes(next(durations)), 2, CPU) == summary([1e3 * b for b in range(BLOCKS)])


def test_the_recorder_marks_the_trainers_own_steps_and_leaves_no_trace(capture, monkeypatch):
    config = tiny_config(capture).without_plan()
    plain, watched = (Trainer(config, load_scene(capture), CPU) for _ in range(2))
    before = {name: set(vars(getattr(watched, name))) for name in ("schedule", "optimizer", "density", "maps")}
    engine, loss = watched.engine, watched.loss
    recorder, operators = Recorder(CPU), OperatorTime(monkeypatch)
    for trainer in (plain, watched):
        trainer.initialise_maps()
    with operators, recorded(watched, recorder) as iteration:
        for _ in range(3):
            iteration()
    for _ in range(3):
        plain.step()
    for (_, one), (_, other) in zip(plain.gaussians.items(), watched.gaussians.items(), strict=True):
        assert torch.equal(one, other)
    assert watched.engine is engine and watched.loss is loss
    assert before == {name: set(vars(getattr(watched, name))) for name in before}
    steps = recorder.summaries()
    assert set(steps) == {"iteration", *STEPS}
    assert all(len(spans) == 3 for spans in recorder.spans.values())
    for number in range(3):  # with operators for a clock: the steps lie one after the other, and are nearly all of it
        spans = {name: tuple(mark.host for mark in recorder.spans[name][number]) for name in steps}
        start, end = spans.pop("iteration")
        marks = [start, *itertools.chain.from_iterable(sorted(spans.values())), end]
        assert marks == sorted(marks)
        assert sum(last - first for first, last in spans.values()) > 0.9 * (end - start) > 100


def test_launches_are_recorded_also_of_operators_that_were_called_before(monkeypatch):
    for operator in STAGES:
        monkeypatch.setattr(library.operators, operator, lambda *lists: None, raising=False)
    launches = [SimpleNamespace(operator=operator, lists=lambda: ([], [], [], [])) for operator in STAGES]
    recorder = Recorder(CPU)
    for entered in (nullcontext(), stages_recorded(recorder), nullcontext()):
        with entered:
            for launch in launches:
                library.launch(launch)
    assert {stage: len(spans) for stage, spans in recorder.spans.items()} == dict.fromkeys(STAGES.values(), 1)


@pytest.mark.parametrize("count", [150, 300, 1000])
def test_a_resized_model_covers_what_it_did(count):
    model = surface_gaussians(300, CPU)
    other = resized(model, count)
    assert len(other) == count and all(value.isfinite().all() for _, value in other.items())
    area = lambda gaussians: (2 * gaussians.scales.mean(dim=1)).exp().sum().item()  # noqa: E731
    assert area(other) == pytest.approx(area(model), rel=0.35)
    if count == 300:
        assert all(torch.equal(a, b) for (_, a), (_, b) in zip(model.items(), other.items(), strict=True))


def test_samples_are_distinct_pixels_in_order():
    sizes = np.array([[40, 33], [40, 33]])
    samples = tile_samples(sizes, 0.2, CPU, seed=1)
    assert len(samples) == 2 * 9 * 51
    for start, end in zip(samples.tile_offsets[:-1].tolist(), samples.tile_offsets[1:].tolist(), strict=True):
        held = samples.pixel_ids[start:end]
        held = held[held >= 0]
        assert len(held.unique()) == len(held) > 0


def test_views_are_spread():
    assert evenly(43, 3) == [0, 21, 42] and evenly(2, 5) == [0, 1]


def test_cameras_look_at_the_model():
    cameras = ring_cameras(3, 64, 48, CPU)
    center = cameras.viewmats[:, :3, 3]
    assert torch.allclose(center[:, :2], torch.zeros(3, 2), atol=1e-5) and (center[:, 2] > 0).all()


def test_contributions_are_the_set_bits_of_the_walked_masks():
    # Two tiles of 40 and 5 intersections, one chunk each: buckets of 32, so 2 and 1. The masks of tile t begin at
    # start // 32 + t.
    forward = SimpleNamespace(
        tile_starts=torch.tensor([0, 40, 45], dtype=torch.int32),
        bucket_counts=torch.tensor([2, 1], dtype=torch.int32),
        chunks=1,
        masks=torch.tensor([0b1011, -1, 0b1, 0b11111], dtype=torch.int32),
    )
    forward.masks[2] = 0b1  # tile 1 begins at 40 // 32 + 1 = 2
    counts = floors.count_contributions(SimpleNamespace(_forward=forward))
    assert counts == {"walked": 96, "contributing": 3 + 32 + 1}


def test_floors_grow_with_counts_and_fall_with_bandwidth(monkeypatch):
    properties = SimpleNamespace(multi_processor_count=132, clock_rate=1_980_000)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: properties)
    counts = {
        "tiles": 5_000,
        "gaussians": 150_000, "instances": 450_000, "visible": 300_000, "intersections": 900_000, "samples": 1_200_000,
        "items": 15_000, "walked": 3_000_000, "contributing": 1_000_000, "pixels": 3_800_000, "touched": 120_000,
    }  # fmt: skip
    usual = floors.step_floors(counts, 4e12)
    assert set(usual) == {"EPS", "FWD", "gather+L+E", "BWD", "solve+update"}
    assert usual["solve+update"] == pytest.approx(
        1e3 * (64 * 300_000 + 8 * 450_000 + 6 * 4 * 59 * 120_000) / 4e12, rel=1e-9
    )
    assert usual["BWD"] >= 1e3 * 1_000_000 * 3 * 56 / (4 * 132 * 1.98e9)
    more = floors.step_floors({name: 2 * value for name, value in counts.items()}, 4e12)
    slower = floors.step_floors(counts, 1e12)
    assert all(more[name] > usual[name] for name in usual) and all(slower[name] >= usual[name] for name in usual)


def test_bytes_of_nested_tensors():
    assert tensor_bytes({"a": torch.zeros(3), "b": [torch.zeros(2, dtype=torch.float16), 1], "c": None}) == 16


def test_the_reference_is_as_exact_as_single_precision():
    errors = precision(CPU)
    assert errors["forward_mean"] < 1e-5 and errors["forward_beyond_1e-4"] < 1e-2
    assert all(errors[f"{name}_gradient"] < 1e-2 for name in ("mean", "conic", "color", "opacity"))


def test_bench_step_says_what_it_measured_on(turbogs, capture, tmp_path):
    out = tmp_path / "step.json"
    arguments = ["bench", "step", "train.sh_degree=1", "--scene", capture, "--gaussians", 500, "--views", 3, 2]
    code, printed, _ = turbogs(*arguments, "--training", 4, "--repeats", 2, "--out", out, "--device", "cpu")
    assert code == 0 and str(out) in printed and "M=500 K=3" in printed
    report = json.loads(out.read_text())
    assert report["device"] == "cpu" and "reference" in report["provenance"]["kernels"]
    assert torch.__version__.startswith(report["provenance"]["software"]["torch"])
    assert [entry["views"] for entry in report["passes"]] == [3, 2]
    for entry in report["passes"]:
        assert set(entry["steps"]) == {"iteration", *STEPS}
        assert entry["counts"]["gaussians"] == 500 and 0 < entry["counts"]["touched"] <= 500
        assert entry["counts"]["pixels"] == entry["views"] * 48 * 40
        assert entry["memory_bytes"]["parameters"] == 500 * 4 * (14 + 9) and entry["memory_bytes"]["peak"] is None
        assert entry["lost_iterations"] == 0 and entry["floors_ms"] is None
        assert entry["wall"]["median_ms"] > 0 and entry["density_event"]["every"] == 100
    assert len(step_lines(report)) == 2


def test_bench_raster_says_what_it_measured_on(turbogs, tmp_path):
    out = tmp_path / "raster.json"
    arguments = ["--gaussians", 300, "--views", 2, "--rates", 0.1, "--size", 48, 32, "--repeats", 2]
    code, printed, _ = turbogs("bench", "raster", *arguments, "--out", out, "--device", "cpu")
    assert code == 0 and "r=0.50" in printed and "r=0.10" in printed
    report = json.loads(out.read_text())
    assert report["gsplat"][0]["reason"] and report["other_builds"] == {}
    assert [(entry["rate"], entry["density_sums"]) for entry in report["passes"]] == [
        (0.5, False), (0.1, False), (0.5, True),
    ]  # fmt: skip
    assert all(math.isfinite(entry["forward_backward"]["median_ms"]) for entry in report["passes"])
    assert len(raster_lines(report)) == 4
    assert (report["scene"], report["image_size"], report["model"]) == (None, [48, 32], "synthetic")


RASTER_PASSES = ("--views", 2, "--rates", 0.1, "--repeats", 1, "--device", "cpu")


def visible(model, cameras) -> int:
    """Gaussians that one of two views of the capture sees."""
    chosen = cameras.select(evenly(len(cameras), 2))
    radii = rasterize(model, chosen, tile_samples(chosen.sizes, 0.1, CPU, seed=0)).projected().radii
    return int((radii > 0).all(dim=-1).any(dim=0).sum())


def test_bench_raster_times_models_trained_on_the_scene(turbogs, capture, tmp_path):
    out, sizes = tmp_path / "raster.json", (150, 300)
    options = ["--scene", capture, "--gaussians", *sizes, "--training", 3, *RASTER_PASSES]
    code, _, error = turbogs("bench", "raster", *options, "--out", out)
    assert code == 0, error
    report = json.loads(out.read_text())
    assert (report["scene"], report["image_size"]) == ("capture", [48, 40])
    assert report["model"] == "trained for 3 iterations"
    assert [entry["gaussians"] for entry in report["gsplat"]] == list(sizes)
    scene = load_scene(capture)
    for count in sizes:
        seen = {entry["counts"]["visible_gaussians"] for entry in report["passes"] if entry["gaussians"] == count}
        assert seen == {visible(trained_model(scene, count, 3, CPU, ()), scene.train.cameras)}
        assert seen != {visible(surface_gaussians(count, CPU), scene.train.cameras)}


def test_other_builds_get_the_models_that_this_one_times(turbogs, capture, tmp_path, monkeypatch):
    library, out, runs = tmp_path / "other.so", tmp_path / "raster.json", []
    library.touch()
    run_one = RasterBench.run

    def watched(bench, *job):
        runs.append(job)
        return run_one(bench, *job)

    def run(command, env, **options):
        assert env["TURBOGS_LIBRARY"] == str(library.resolve())
        assert len(json.loads(out.read_text())["passes"]) == 6  # kept, whatever becomes of this build
        monkeypatch.setattr(sys, "argv", command[2:])
        return SimpleNamespace(returncode=commands.main(), stderr="")

    monkeypatch.setenv("TURBOGS_COMMIT", "one")  # git is not asked
    monkeypatch.setattr(RasterBench, "run", watched)
    monkeypatch.setattr(commands.subprocess, "run", run)
    options = ["--scene", capture, "--gaussians", 150, 200, "--training", 0, *RASTER_PASSES, "--library", library]
    code, output, error = turbogs("bench", "raster", *options, "--out", out)
    assert code == 0, error
    assert "other.so:" in output.splitlines() and output.splitlines()[-1] == f"json  {out}"
    (mine, cameras, _), (theirs, their_cameras, device) = runs
    assert [len(model) for model in theirs] == [150, 200] and device == CPU
    for model, other in zip(mine, theirs, strict=True):
        assert all(torch.equal(a, b) for (_, a), (_, b) in zip(model.items(), other.items(), strict=True))
    assert torch.equal(cameras.viewmats, their_cameras.viewmats)
    report = json.loads(out.read_text())
    other = report["other_builds"]["other.so"]
    assert report["model"] == other["model"] == "trained for 0 iterations" and len(other["passes"]) == 6
    assert other["provenance"] == report["provenance"]


def test_a_build_that_cannot_be_measured_says_so(monkeypatch, tmp_path):
    ended = SimpleNamespace(returncode=2, stderr="warning\nturbogs: error: no views\n")
    monkeypatch.setattr(commands.subprocess, "run", lambda *arguments, **options: ended)
    with pytest.raises(InputError, match=r"other\.so.*no views"):
        commands.other_build(tmp_path / "other.so", ())


def test_a_build_that_dies_without_a_word_is_named(monkeypatch, tmp_path):
    ended = SimpleNamespace(returncode=-11, stderr="")
    monkeypatch.setattr(commands.subprocess, "run", lambda *arguments, **options: ended)
    with pytest.raises(InputError, match=r"other\.so.*ended with -11 and said nothing"):
        commands.other_build(tmp_path / "other.so", ())


def test_a_build_that_does_not_load_is_not_measured(monkeypatch, tmp_path):
    """The reference would be timed under its name."""
    (tmp_path / "job").write_bytes(pickle.dumps((None, torch.device("cuda"))))
    monkeypatch.setattr(sys, "argv", ["commands", str(tmp_path / "job")])
    with pytest.raises(InputError, match="CUDA kernels: "):
        commands.main()


def test_another_build_measures_in_a_process_of_its_own(tmp_path):
    bench = RasterBench((30,), (2,), (), 1.0, (48, 32), 1)
    measured = commands.other_build(tmp_path / "other.so", (bench, bench.models(None, CPU), bench.cameras(None), CPU))
    assert measured["bench"] == "raster" and [entry["gaussians"] for entry in measured["passes"]] == [30, 30]


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["step"], "--scene"),
        (["step", "--scene", "absent"], "no such scene"),
        (["step", "--photos", "1"], "--photos 1: at least 3"),
        (["step", "--photos", "2"], "--photos 2: at least 3"),
        (["step", "--scene", "CAPTURE", "loss.nonsense=1"], "nonsense"),
        (["raster", "loss.type=charbonnier"], "section.key"),
        (["raster", "--views", "0"], "--views"),
        (["raster", "--out", "absent/bench.json"], "absent"),
        (["raster", "--training", "5"], "--scene"),
        (["raster", "--scene", "CAPTURE", "--training", "-1"], "--training"),
        (["raster", "--library", "absent.so"], "absent.so"),
        (["raster", "--scene", "CAPTURE", "--ply", "model.ply"], "--ply is for bench step"),
        (["step", "--ply", "model.ply"], "--scene"),
        (["step", "--scene", "CAPTURE", "--training", "5", "--ply", "model.ply"], "--training"),
        (["step", "--scene", "CAPTURE", "--ply", "absent.ply"], "absent.ply"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_bad_calls_are_refused(turbogs, capture, arguments, word):
    given = [capture if argument == "CAPTURE" else argument for argument in arguments]
    code, out, err = turbogs("bench", *given, "--device", "cpu")
    assert code == 2 and out == "" and word in err and err.count("\n") == 1
