"""docs/measure_captures.py and docs/capture_tables.py: what is measured of captures, and its tables."""

import importlib
import json
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch

from turbogs_plugin.report.provenance import provenance

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "docs"), str(ROOT / "examples")]  # the scripts import their neighbours
capture_tables, measure_captures, many_photos = (
    importlib.import_module(name) for name in ("capture_tables", "measure_captures", "many_photos")
)
TINY = ["train.iterations=4", "train.sh_degree=0", "train.backdrop=false"]


@pytest.fixture(scope="module")
def measured(tmp_path_factory) -> Path:
    """The record of exposures and masks on a few small photos, one seed."""
    folder = tmp_path_factory.mktemp("captures")
    many_photos.write_flight(folder / "flight", 12, 48, 32)
    measurement = measure_captures.Measurement(folder / "out", torch.device("cpu"), 1, 1, 0, TINY)
    measurement.exposures(folder / "flight")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measure_captures, "VIEWS", (5,))
        measurement.masks(folder / "flight")
    return measurement.file


def cells(made: str) -> dict[str, list[str]]:
    rows = [line.strip("| ").split(" | ") for line in made.splitlines() if line.startswith("|")]
    return {row[0]: row[1:] for row in rows[2:]}


def test_each_variant_is_trained_with_the_same_seed_and_read_into_a_table(measured):
    runs = json.loads(measured.read_text())["exposures"]["runs"]
    assert [run["variant"] for run in runs] == ["false", "true"]
    assert all(run["iterations"] == 4 and run["seconds"] > 0 for run in runs)
    assert runs[0]["aligned_psnr"] != runs[1]["aligned_psnr"], "exposures change the model"
    assert runs[0]["aligned_psnr"] > runs[0]["psnr"]
    columns = capture_tables.RAW | capture_tables.ALIGNED
    rows = cells(capture_tables.trainings("exposures", columns, measured))
    assert rows["false"][:3] == ["48x32", "1", "4"] and rows["false"][4] == f"{runs[0]['psnr']:.2f}"
    assert rows["difference"][4] == f"{runs[1]['psnr'] - runs[0]['psnr']:+.2f}"


def test_masks_leave_half_of_the_samples_of_the_same_model(measured):
    runs = [run for run in json.loads(measured.read_text())["masks"]["runs"] if "views" in run]
    whole, half = runs
    assert whole["gaussians"] == half["gaussians"]
    assert 0.4 < half["samples"] / whole["samples"] < 0.7
    assert len(capture_tables.masked_iterations(measured).splitlines()) == 2 + 1


def test_what_came_so_far_is_a_table(measured, tmp_path):
    record = json.loads(measured.read_text())
    record["exposures"]["runs"] = record["exposures"]["runs"][:1]
    record["masks"]["runs"] = [run for run in record["masks"]["runs"] if run["variant"] == "none"]
    record["many"] = {"provenance": record["masks"]["provenance"], "runs": []}
    failed = {"limit": ["8GiB"], "photos": 30, "exit_code": 1, "peak_bytes": 2**30, "seconds": 4.0}
    record["many"]["runs"].append(failed)
    partial = tmp_path / "captures.json"
    partial.write_text(json.dumps(record))
    assert list(cells(capture_tables.trainings("exposures", capture_tables.RAW, partial))) == ["false"]
    assert capture_tables.masked_iterations(partial) == capture_tables.ABSENT
    assert "exit code 1" in capture_tables.many_photos(partial)
    assert capture_tables.trainings("lenses", capture_tables.RAW, partial) == capture_tables.ABSENT
    assert capture_tables.many_photos(tmp_path / "none.json") == capture_tables.ABSENT


def test_cameras_are_compared_after_the_similarity_that_brings_most_together(tmp_path):
    """Nine of ten are equal but for turn, size and place; one stands half a radius away."""
    corners = np.random.default_rng(0).normal(size=(10, 3))
    published = {f"{number}.jpg": corner for number, corner in enumerate(corners)}
    radius = np.linalg.norm(corners - corners.mean(axis=0), axis=1).mean()
    moved = corners + np.eye(10, 3, k=-9) * radius / 2
    found = dict(zip(published, 3.0 * moved[:, [1, 2, 0]] + 5.0, strict=True))
    distances = measure_captures.distances_of_centers(found, published)
    assert distances[:9] == pytest.approx(0, abs=1e-9) and distances[9] == pytest.approx(0.5)
    run = {"photos": 11, "registered": 10, "seconds": 120.0, "median": 0.0, "largest": 0.5}
    record = tmp_path / "captures.json"
    record.write_text(json.dumps({"alone": {"provenance": asdict(provenance("cpu")), "runs": [run]}}))
    assert "| 10 of 11 | 0.00 % | 50.00 % | 120 s |" in capture_tables.photos_alone(record)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux says what processes share")
def test_the_memory_of_processes_is_that_of_their_children_too():
    """64 MiB in a child of the process that is watched."""
    child = "import time; held = bytearray(b'x' * (1 << 26)); time.sleep(1)"
    parent = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])"
    process = subprocess.Popen([sys.executable, "-c", parent])
    assert 1 << 26 < measure_captures.peak_of_processes(process) < 1 << 28
