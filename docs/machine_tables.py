"""Tables of what was timed on one machine, from the JSON files in docs/results/h200."""

from __future__ import annotations

import json
import math
import statistics
from pathlib import Path
from typing import Any

import numpy as np

from turbogs_plugin.bench.viewer import summarised
from turbogs_plugin.bench.wall import WallRun
from turbogs_plugin.report.tables import table

H200 = Path(__file__).resolve().parent / "results/h200"


def house() -> dict[str, Any]:
    return json.loads((H200 / "house.json").read_text())


def masks() -> dict[str, Any]:
    return json.loads((H200 / "masks.json").read_text())


def iterations(record: dict[str, Any]) -> str:
    """Milliseconds of an iteration before and after a change, and ratios of the pairs."""
    lines = []
    for commit, points in record["iterations"].items():
        for point, clocks in points.items():
            base, new = (statistics.median(clocks["free_running"][build]) for build in ("base", "new"))
            ratios = []
            for clock in ("free_running", "wall"):
                pairs = [after / before for before, after in zip(*clocks[clock].values(), strict=True)]
                ratios.append(f"{statistics.median(pairs):.3f} [{min(pairs):.3f}, {max(pairs):.3f}]")
            lines.append((commit, point, f"{base:.3f}", f"{new:.3f}", *ratios, len(pairs)))
    return table(("new build", "model, views", "base", "new", "ratio, free running", "ratio, wall", "pairs"), lines)


def exposures() -> str:
    """Milliseconds of an iteration without exposures, of its loss with and without them, and the difference's share."""
    lines = []
    for commit, points in masks()["exposures"].items():
        for point, measured in points.items():
            off, on = measured["off"], measured["on"]
            share = (on["loss"] - off["loss"]) / off["iteration"]
            values = (f"{value:.3f}" for value in (off["iteration"], off["loss"], on["loss"]))
            lines.append((commit, point, *values, f"{100 * share:.1f} %"))
    return table(("build", "model, views", "iteration", "loss without", "loss with", "share"), lines)


DROPIN = H200 / "dropin.json"
"""Runs of examples/simple_trainer/compare.py."""

DROPIN_NAMES = {
    "stock": "stock",
    "density": "density control",
    "errors": "the same, ranked by errors",
    "lm": "and Moment-LM",
    "sparse": "sparse pixels, 4 views",
    "all": "all of them",
}


def psnr_at(run: dict[str, Any], seconds: float) -> float:
    """A run's PSNR after so many seconds of training, on the straight line between its evaluations; NaN before the
    first."""
    times, values = ([mark[key] for mark in run["marks"]] for key in ("seconds", "psnr"))
    return float(np.interp(seconds, times, values, left=math.nan))


def dropin(file: Path = DROPIN) -> str:
    """gsplat's trainer with each swap at its end, and beside stock at the earlier of both ends."""
    if not file.exists():
        return "Not measured yet."
    runs = [run for run in json.loads(file.read_text())["runs"] if "error" not in run]
    stock = {run["scene"]: run for run in runs if run["variant"] == "stock"}
    lines = []
    for run in runs:
        end, equal = run["marks"][-1], ""
        if run["variant"] != "stock" and run["scene"] in stock:
            seconds = min(end["seconds"], stock[run["scene"]]["marks"][-1]["seconds"])
            ours, theirs = psnr_at(run, seconds), psnr_at(stock[run["scene"]], seconds)
            if not math.isnan(ours + theirs):
                equal = f"{ours - theirs:+.2f} dB: {ours:.2f} for {theirs:.2f} at {seconds:.0f} s"
        size = f"{end['gaussians'] / 1e3:.0f}k"
        texts = (f"{end['seconds']:.1f}", f"{end['psnr']:.2f}", f"{end['ssim']:.4f}", size, equal)
        lines.append((run["scene"], DROPIN_NAMES[run["variant"]], end["step"], *texts))
    return table(
        ("capture", "swap", "steps", "s", "PSNR", "SSIM", "Gaussians", "PSNR beside stock's, equal time"), lines
    )


def wall(file: Path = H200 / "wall.json") -> str:
    """Where each second of `turbogs train` goes: of each capture the run in the middle, by what it took beside
    training."""
    runs = {capture: WallRun(**report["median"]) for capture, report in json.loads(file.read_text()).items()}
    rows: dict[str, list[float]] = {part: [] for run in runs.values() for part in run.parts}
    for run in runs.values():
        for part, column in rows.items():
            column.append(run.parts.get(part, 0.0))
    rows["whole command"] = [run.seconds for run in runs.values()]
    rows["training alone"] = [run.train_seconds for run in runs.values()]
    rows["beside training"] = [run.beside_training for run in runs.values()]
    rows["from decoded photos to the first iteration"] = [run.to_first_iteration for run in runs.values()]
    return table(("s", *runs), [(name, *(f"{value:.2f}" for value in column)) for name, column in rows.items()])


def viewer(folder: Path = H200) -> str:
    """What a viewer costs a training: each ``viewer-CAPTURE.json`` is what `turbogs bench viewer --out` wrote."""
    lines = []
    for file in sorted(folder.glob("viewer-*.json")):
        measured = json.loads(file.read_text())
        ways = {row.way: row for row in summarised(measured)}
        alone, client = ways["without"], ways["client"]
        gaussians = statistics.median(run["gaussians"] for run in measured["runs"])
        lines.append(
            (
                measured["scene"],
                f"{gaussians / 1e3:.0f}k",
                f"{statistics.median(alone.rates):.0f}",
                ways["nobody looks"].change_text(),
                client.change_text(),
                f"{client.frame_rate:.1f}",
                f"{client.width:.0f}",
            )
        )
    if not lines:
        return "Not measured yet."
    header = ("capture", "Gaussians", "iterations a second, without", "nobody looks", "a client that moves")
    return table((*header, "its frames a second", "pixels wide"), lines)
