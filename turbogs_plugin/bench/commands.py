"""What `turbogs bench` does: measure, write the numbers as JSON, and print the gist."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from turbogs_plugin.bench.large_capture import synthetic_scene
from turbogs_plugin.bench.numerics import bench_solvers, solvers_table
from turbogs_plugin.bench.ranks import RanksBench
from turbogs_plugin.bench.raster import RasterBench
from turbogs_plugin.bench.statistics import bench_statistics, statistics_table
from turbogs_plugin.bench.step import StepBench
from turbogs_plugin.bench.viewer import bench_viewer, viewer_lines
from turbogs_plugin.bench.wall import bench_wall, wall_lines
from turbogs_plugin.captures import load_scene
from turbogs_plugin.captures.capture import FEWEST_PHOTOS
from turbogs_plugin.config.configuration import Config
from turbogs_plugin.engine import compiled_kernels
from turbogs_plugin.engine.cuda.library import LIBRARY_VARIABLE, require
from turbogs_plugin.errors import InputError, exit_code
from turbogs_plugin.files import require_writable, write_text_atomically
from turbogs_plugin.report.provenance import missing_bytecode, provenance
from turbogs_plugin.study.cell import scene_on
from turbogs_plugin.train.inputs import open_scene
from turbogs_plugin.viewer.server import require_server

AGAIN = "this build, in a process of its own"
"""The name of this build among the others, which compare with it and not with the first measurement: in the process
that trained the models, the same kernels take up to 10 % less or more."""


def run_step(bench: StepBench, scene: Path | None, factor: int, device: torch.device, out: Path | None) -> None:
    if (scene is None) == (bench.photos == 0):
        raise InputError("bench step needs cameras and photos: --scene SCENE, or --photos N for synthetic ones")
    if scene is None and bench.photos < FEWEST_PHOTOS:
        raise InputError(f"--photos {bench.photos}: at least {FEWEST_PHOTOS} are needed, as of any capture")
    if scene is None:
        capture = synthetic_scene(bench.photos, *bench.size, device)
    else:
        capture = scene_on(load_scene(scene, factor), device)
    report = _report("step", bench.run(capture, device), device)
    _keep(report, step_lines(report), out)
    _finish(report, out)


def run_raster(bench: RasterBench, scene: Path | None, factor: int, device: torch.device, out: Path | None) -> None:
    capture = None if scene is None else load_scene(scene, factor)
    about = {"scene": None, "model": "synthetic"}
    if capture is not None:
        about = {"scene": capture.name, "model": f"trained for {bench.training} iterations"}
    # What another build trains would differ in the last bits: all measure the same models.
    job = bench, bench.models(capture, device), bench.cameras(capture), device
    report = _report("raster", {**about, **bench.run(*job[1:]), "other_builds": {}}, device)
    _keep(report, raster_lines(report), out)  # a build that fails takes nothing away
    builds = {library.name: library for library in bench.libraries}
    if builds and not compiled_kernels().unavailable:
        builds = {AGAIN: compiled_kernels().path, **builds}
    for name, library in builds.items():
        report["other_builds"][name] = {**about, **other_build(library, job)}
        _keep(report, [f"{name}:", *raster_lines(report["other_builds"][name])], out)
    _finish(report, out)


def other_build(library: Path, job: tuple) -> dict[str, Any]:
    """The same measurements by another build of the library, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "job"
        path.write_bytes(pickle.dumps(job))
        environment = {**os.environ, LIBRARY_VARIABLE: str(library.resolve())}
        command = [sys.executable, "-m", __name__, str(path)]
        ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if ended.returncode:
            said = ended.stderr.strip().splitlines() or [f"its process ended with {ended.returncode} and said nothing"]
            raise InputError(f"library '{library}': {said[-1]}")
        return json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))


def run_ranks(bench: RanksBench, scene: Path, factor: int, device: torch.device, out: Path | None) -> None:
    """Prints a line a measurement, and writes the JSON where there is a file."""
    _keep(_report("ranks", bench.run(scene, factor, device), device), [f"json  {out}"], out)


def run_numerics(device: torch.device, out: Path) -> None:
    require_writable(out, f"--out '{out}'")
    tables = solvers_table(bench_solvers(out, device)), statistics_table(bench_statistics(out, device))
    print("\n\n".join((*tables, f"folder  {out}")))


def run_wall(arguments: Sequence[str], repeats: int, device: torch.device, out: Path | None) -> None:
    """Times `turbogs train` with these arguments; prints the parts, and writes the JSON where there is a file."""
    measured = bench_wall(arguments, repeats)
    print("\n".join(wall_lines(measured)))
    if reason := missing_bytecode():
        print(f"missing  {reason}")
    _keep(_report("wall", measured, device), [f"json  {out}"], out)


def run_viewer(config: Config, repeats: int, device: torch.device, out: Path | None) -> None:
    """Times trainings with and without a viewer; prints them side by side, and writes the JSON if there is a file."""
    require_server("127.0.0.1", 0)
    measured = bench_viewer(config, open_scene(config), device, repeats)
    print("\n".join(viewer_lines(measured)))
    _keep(_report("viewer", measured, device), [f"json  {out}"], out)


def require_result_file(out: Path | None) -> None:
    """Check the place of the result before anything is measured. An older result of the same name is replaced.

    Raises:
        InputError: it is a folder, or no file can be made there.
    """
    if out is None:
        return
    if out.is_dir() or not out.absolute().parent.is_dir():
        raise InputError(f"--out '{out}': name a file in a folder that exists")
    require_writable(out.parent, f"--out '{out}'")


def _report(what: str, measured: dict[str, Any], device: torch.device) -> dict[str, Any]:
    return {"bench": what, "device": device.type, "provenance": asdict(provenance(device.type)), **measured}


def _keep(report: dict[str, Any], gist: Sequence[str], out: Path | None) -> None:
    """Write what is known so far, and print its gist. Without a file, standard output is for the JSON alone."""
    if out is not None:
        write_text_atomically(out, json.dumps(report, indent=2) + "\n")
        print("\n".join(gist), flush=True)


def _finish(report: dict[str, Any], out: Path | None) -> None:
    print(json.dumps(report, indent=2) if out is None else f"json  {out}")


def step_lines(measured: dict[str, Any]) -> list[str]:
    """One line for each pass: the whole iteration, then its steps with their floors in brackets."""
    lines = []
    for entry in measured["passes"]:
        steps, floors = entry["steps"], entry["floors_ms"] or {}
        parts = [
            f"{name} {value['device']['median_ms']:.3f}" + (f" [{floors[name]:.3f}]" if name in floors else "")
            for name, value in steps.items()
            if name != "iteration"
        ]
        lines.append(
            f"M={entry['gaussians']} K={entry['views']}: {steps['iteration']['device']['median_ms']:.3f} ms "
            f"(wall {entry['wall']['median_ms']:.3f}) | {'  '.join(parts)}"
        )
        for name, row in (entry["offload"] or {}).items():
            wall, slower = row["wall"]["median_ms"], row["wall"]["median_ms"] - entry["wall"]["median_ms"]
            lines.append(f"  {name} in host memory: wall {wall:.3f} ({slower:+.3f})")
    return lines


def raster_lines(measured: dict[str, Any]) -> list[str]:
    """One line for each pass, and one for gsplat's dense pass."""
    lines = []
    for entry in measured["passes"]:
        parts = [f"{name} {value['median_ms']:.3f}" for name, value in entry.get("stages", {}).items()]
        lines.append(
            f"M={entry['gaussians']} K={entry['views']} r={entry['rate']:.2f}: "
            f"{entry['forward_backward']['median_ms']:.3f} ms" + (f" | {'  '.join(parts)}" if parts else "")
        )
    for entry in measured["gsplat"]:
        times = [f"{kind} {entry[kind]['median_ms']:.3f} ms" for kind in ("unpacked", "packed") if kind in entry]
        text = ", ".join(times) or entry["reason"]
        lines.append(f"gsplat {entry['version']} dense, M={entry['gaussians']} K={entry['views']}: {text}")
    return lines


def main() -> int:
    """A process that `other_build` started."""
    path = Path(sys.argv[1])
    bench, *rest, device = pickle.loads(path.read_bytes())
    if device.type == "cuda":
        require()  # or a library that does not load would be timed as the reference, which takes its place
    report = _report("raster", bench.run(*rest, device), device)
    path.with_suffix(".json").write_text(json.dumps(report), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
