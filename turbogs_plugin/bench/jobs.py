"""What `turbogs bench` does: measure, and print the gist or write the numbers as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from turbogs_plugin.bench.raster import bench_raster, raster_lines
from turbogs_plugin.bench.step import bench_step, step_lines
from turbogs_plugin.bench.wall import wall_lines
from turbogs_plugin.bench.workloads import resized
from turbogs_plugin.captures.load import load_scene
from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.errors import InputError
from turbogs_plugin.files import require_writable, write_text_atomically
from turbogs_plugin.report.provenance import missing_bytecode, provenance
from turbogs_plugin.train.saved_model import load_given

LINES = {"step": step_lines, "raster": raster_lines, "wall": wall_lines}


def time_engine(
    what: str,
    scene: Path,
    ply: Path,
    sizes: Sequence[int],
    views: Sequence[int],
    repeats: int,
    overrides: Sequence[str],
    device: torch.device,
) -> dict[str, Any]:
    """What ``step`` or ``raster`` measures on a capture, with its model resized to these numbers of Gaussians, for each
    of these numbers of views."""
    capture = load_scene(scene, load_config("turbogs", overrides).scene.factor)
    capture = replace(capture, train=capture.train.to(device))
    loaded = load_given(ply, capture)[0].map(lambda value: value.to(device))
    models = (resized(loaded, size) for size in sizes)
    if what == "step":
        return {"model": ply.name, **bench_step(capture, models, views, repeats, overrides)}
    return {"model": ply.name, **bench_raster(capture, models, views, repeats)}


def require_result_file(out: Path) -> None:
    """Raise `InputError` before anything is measured, where no file of the result can be made or replaced."""
    if out.is_dir() or not out.absolute().parent.is_dir():
        raise InputError(f"--out '{out}': name a file in a folder that exists")
    require_writable(out.parent, f"--out '{out}'")


def write(what: str, measured: dict[str, Any], device: torch.device, out: Path | None) -> None:
    """Print the gist of a measurement; where there is a file, write all numbers with machine and commit as JSON."""
    print("\n".join(LINES[what](measured)))
    if reason := missing_bytecode():
        print(f"missing  {reason}")
    if out is not None:
        report = {"bench": what, "device": device.type, "provenance": asdict(provenance(device.type)), **measured}
        write_text_atomically(out, json.dumps(report, indent=2) + "\n")
        print(f"json  {out}")
