"""Benches on the GPU: the fused steps are marked, nothing is lost, and floors are below what was measured."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.raster_cases import GPU_ONLY
from helpers.synthetic_capture import surface_gaussians

from turbogs_plugin.bench.raster import STAGES, bench_raster
from turbogs_plugin.bench.step import bench_step

pytestmark = GPU_ONLY

GPU = torch.device("cuda")


@pytest.fixture(scope="module")
def on_gpu(scene):
    return replace(scene, train=scene.train.to(GPU), test=scene.test.to(GPU))


def test_steps_on_the_kernels(on_gpu):
    (entry,) = bench_step(on_gpu, [surface_gaussians(2000, GPU)], (3,), repeats=5)["passes"]
    assert {"GVS", "EPS", "FWD", "gather+L+E", "BWD", "solve+update", "EDC"} <= set(entry["steps"])
    assert entry["lost_iterations"] == 0 and entry["counts"]["touched"] > 0
    held = entry["memory_bytes"]
    assert held["peak"] >= held["parameters"] and held["temporary"] >= 0
    for name, floor in entry["floors_ms"].items():
        assert 0 < floor < entry["steps"][name]["device"]["p90_ms"], name
    parts = sum(value["device"]["median_ms"] for name, value in entry["steps"].items() if name != "iteration")
    assert parts < 1.2 * entry["steps"]["iteration"]["device"]["median_ms"]


def test_stages_of_the_rasterizer(on_gpu):
    report = bench_raster(on_gpu, [surface_gaussians(3000, GPU)], (3,), repeats=5)
    assert {entry["density_sums"] for entry in report["passes"]} == {False, True}
    for entry in report["passes"]:
        assert set(entry["stages"]) == set(STAGES.values()) and entry["lost_passes"] == 0
    assert np.isfinite(report["gsplat"][0]["packed"]["median_ms"])
