"""Benches on the GPU: the fused steps are marked, nothing is lost, and floors are below what was measured."""

import json
import shutil

import numpy as np
import pytest
import torch
from helpers.framework_runs import tiny_capture

from turbogs_plugin.bench.commands import AGAIN
from turbogs_plugin.bench.raster import STAGES, RasterBench
from turbogs_plugin.bench.step import StepBench
from turbogs_plugin.captures import load_scene
from turbogs_plugin.engine.cuda import library as kernels
from turbogs_plugin.study.cell import scene_on

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not kernels.available(), reason=kernels.unavailable_reason() or "available"),
]


def test_steps_on_the_kernels(tmp_path):
    pytest.importorskip("pycolmap", reason="the capture is written by pycolmap")
    device = torch.device("cuda")
    scene = scene_on(load_scene(tiny_capture(tmp_path)), device)
    bench = StepBench((2000,), (3,), pixel_budget=1.0, training=20, repeats=5, overrides=())
    (entry,) = bench.run(scene, device)["passes"]
    assert {"GVS", "EPS", "FWD", "gather+L+E", "BWD", "solve+update", "EDC"} <= set(entry["steps"])
    assert entry["lost_iterations"] == 0 and entry["counts"]["touched"] > 0
    assert (
        entry["memory_bytes"]["peak"] >= entry["memory_bytes"]["parameters"] and entry["memory_bytes"]["temporary"] >= 0
    )
    for name, floor in entry["floors_ms"].items():
        assert 0 < floor < entry["steps"][name]["device"]["p90_ms"], name
    parts = sum(value["device"]["median_ms"] for name, value in entry["steps"].items() if name != "iteration")
    assert parts < 1.2 * entry["steps"]["iteration"]["device"]["median_ms"]


@pytest.mark.parametrize("density", [False, True])
def test_stages_of_the_rasterizer(density):
    device = torch.device("cuda")
    bench = RasterBench((3000,), (3,), (1.0,), 1.0, (160, 120), 5)
    report = bench.run(bench.models(None, device), bench.cameras(None), device)
    entry = next(entry for entry in report["passes"] if entry["density_sums"] is density)
    assert set(entry["stages"]) == set(STAGES.values()) and entry["lost_passes"] == 0
    assert np.isfinite(report["gsplat"][0]["packed"]["median_ms"])
    assert report["precision"]["forward_mean"] < 1e-5


def test_the_rasterizer_is_timed_on_models_of_the_scene(tmp_path):
    pytest.importorskip("pycolmap", reason="the capture is written by pycolmap")
    device, scene = torch.device("cuda"), load_scene(tiny_capture(tmp_path))
    bench = RasterBench((2000,), (3,), (1.0,), 1.0, (160, 120), 5, training=20)
    (model,) = bench.models(scene, device)
    assert len(model) == 2000 and model.device.type == "cpu"
    held = torch.cuda.memory_allocated(device)
    bench.models(scene, device)
    assert torch.cuda.memory_allocated(device) <= held  # no photos, trainers or models stay there
    report = bench.run([model], bench.cameras(scene), device)
    assert report["image_size"] == [48, 40]
    for entry in report["passes"]:
        assert entry["counts"]["visible_gaussians"] > 0.9 * len(model) and entry["lost_passes"] == 0
    assert np.isfinite(report["gsplat"][0]["packed"]["median_ms"])


def test_this_build_is_measured_as_the_others_are(turbogs, tmp_path):
    """Each in a process of its own, which loads the library that it is about."""
    other, out = tmp_path / "other.so", tmp_path / "raster.json"
    shutil.copy(kernels.library_path(), other)
    options = ["--gaussians", 500, "--views", 2, "--size", 64, 48, "--repeats", 2, "--library", other]
    code, _, error = turbogs("bench", "raster", *options, "--out", out, "--device", "cuda")
    assert code == 0, error
    report = json.loads(out.read_text())
    builds = report["other_builds"]
    loaded = {name: build["provenance"]["kernels"].partition(" ")[0] for name, build in builds.items()}
    assert loaded == {AGAIN: kernels.library_path().name, "other.so": "other.so"}
    what = ("gaussians", "views", "rate", "density_sums")
    for build in builds.values():
        measured, here = ([[entry[name] for name in what] for entry in r["passes"]] for r in (build, report))
        assert measured == here
        assert all(set(entry["stages"]) == set(STAGES.values()) for entry in build["passes"])
