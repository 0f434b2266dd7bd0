"""Tables of what was timed on one machine, from the JSON files in docs/results/h200."""

from __future__ import annotations

import json
import math
import re
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scaling_results

from turbogs_plugin.bench.numerics import SolverResult, solvers_table
from turbogs_plugin.bench.statistics import StatisticsResult, statistics_table
from turbogs_plugin.bench.wall import WallRun
from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.plan.memory import MemoryDemand
from turbogs_plugin.report.provenance import MODIFIED
from turbogs_plugin.report.tables import table

ABSENT = "Not measured yet."
"""In the place of a table whose record is not there."""
H200 = Path(__file__).resolve().parent / "results/h200"


def measured(name: str) -> dict[str, Any]:
    return json.loads((H200 / name).read_text())


def house_runs() -> str:
    """Whole runs of the base and of the new build: mean and range of five seeds."""
    record, lines = measured("house.json"), []
    for capture in record["base_runs"]:
        for build in ("base", "new"):
            run = record[f"{build}_runs"][capture]
            texts = [
                f"{mean:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"
                for (mean, low, high), digits in zip((run["seconds"], run["psnr"], run["ssim"]), (1, 2, 4), strict=True)
            ]
            lines.append((capture, build, *texts, run["gaussians"]))
    return table(("capture", "build", "s", "PSNR", "SSIM", "Gaussians"), lines)


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
    for commit, points in measured("masks.json")["exposures"].items():
        for point, clocks in points.items():
            off, on = clocks["off"], clocks["on"]
            share = (on["loss"] - off["loss"]) / off["iteration"]
            values = (f"{value:.3f}" for value in (off["iteration"], off["loss"], on["loss"]))
            lines.append((commit, point, *values, f"{100 * share:.1f} %"))
    return table(("build", "model, views", "iteration", "loss without", "loss with", "share"), lines)


DROPIN = "dropin*.json"
"""What examples/simple_trainer/compare.py wrote: each file is of one machine and day, with its own stock."""

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


def dropin(folder: Path = H200) -> str:
    """gsplat's trainer with each swap at its end, and beside stock at the earlier of both ends: a table a file."""
    records = sorted((json.loads(file.read_text()) for file in folder.glob(DROPIN)), key=lambda record: record["date"])
    parts = [f"{record['device']}, {record['date']}:\n\n{dropin_table(record['runs'])}" for record in records]
    return "\n\n".join(parts) or ABSENT


def dropin_table(runs: list[dict[str, Any]]) -> str:
    runs = [run for run in runs if "error" not in run]
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


def pixels_on_an_mlp(file: Path = H200.parent / "pixels_on_an_mlp.json") -> str:
    """PSNR of a network without Gaussians by both ways, means of seeds: what examples/pixels_on_an_mlp.py wrote."""
    lines, photos = [], json.loads(file.read_text())
    for photo, (plain, ours) in ((name, found["psnr"].values()) for name, found in photos.items()):
        gains = [after - before for before, after in zip(plain, ours, strict=True)]
        means = (f"{statistics.mean(values):.2f}" for values in (plain, ours))
        spread = f"{statistics.mean(gains):+.2f} [{min(gains):+.2f}, {max(gains):+.2f}]"
        lines.append((photo, *means, spread))
    made = table(("photo", "random pixels, Charbonnier", "error-guided pixels, NCC", "gain in dB"), lines)
    return f"{'; '.join(dict.fromkeys(map(where, photos.values())))}.\n\n{made}"


WALL = H200 / "wall.json"
"""Variant of the ablation `sizes` -> capture -> what `turbogs bench wall` wrote."""


def wall(file: Path = WALL) -> str:
    """Where each second of `turbogs train` goes, with the configuration `turbogs`: of each capture the run in the
    middle, by what it took beside training."""
    reports = json.loads(file.read_text())["turbogs"]
    runs = {capture: WallRun(**report["median"]) for capture, report in reports.items()}
    rows: dict[str, list[float]] = {part: [] for run in runs.values() for part in run.parts}
    for run in runs.values():
        for part, column in rows.items():
            column.append(run.parts.get(part, 0.0))
    rows["whole command"] = [run.seconds for run in runs.values()]
    rows["training alone"] = [run.train_seconds for run in runs.values()]
    rows["until model, report and pictures are there"] = [run.ready_seconds for run in runs.values()]
    rows["beside training, until then"] = [run.beside_training for run in runs.values()]
    rows["from decoded photos to the first iteration"] = [run.to_first_iteration for run in runs.values()]
    made = table(("s", *runs), [(name, *(f"{value:.2f}" for value in column)) for name, column in rows.items()])
    return f"{'; '.join(dict.fromkeys(map(where, reports.values())))}.\n\n{made}"


STEPS = {
    "EPS": "draw",
    "FWD": "projection to colour",
    "gather+L+E": "photo, loss, maps",
    "BWD": "backward",
    "solve+update": "solve, update",
}
"""The paper's steps of an iteration that take time, and what they are called in a table."""


def on(name: str, made: Callable[[], str]) -> str:
    """A table of a file of `turbogs bench`, below a line with what it was measured on."""
    record = measured(name)
    width, height = record["image_size"]
    views = f"{record['training_views']} training views of " if "training_views" in record else ""
    return f"{where(record)}; {record['scene']}, {views}{width}x{height}.\n\n{made()}"


def where(record: dict[str, Any]) -> str:
    """Machine, commit, day and torch of a file of `turbogs bench`."""
    provenance = record["provenance"]
    found = place(provenance["machine"], provenance["commit"], provenance.get("day", ""))
    return f"{found}, torch {provenance['software']['torch']}"


def place(machine: str, commit: str, day: str) -> str:
    """The GPU, or the CPU where none was used; how many cores the host has, which makes the seconds differ; commit; and
    day, where it was recorded."""
    device, cores = machine.partition(" (")[0], re.findall(r"\d+ cores", machine)
    cores = [] if device.endswith(" cores") else cores
    return ", ".join([device, *cores, f"commit {short(commit)}", *([day] if day else [])])


def short(commit: str) -> str:
    """As pages name it; sources that differ from it say so."""
    return commit[:7] + (MODIFIED if commit.endswith(MODIFIED) else "")


def ranks() -> str:
    """Milliseconds of an iteration on one GPU and on several, beside the predictions."""
    return f"{where(measured('ranks.json'))}.\n\n{scaling_results.iterations(H200)}"


def rank_runs() -> str:
    """Whole runs and a study on one GPU and on several."""
    if not (H200 / scaling_results.KEPT).is_file():
        return ABSENT
    machine = where(measured(scaling_results.KEPT))
    parts = [f"{machine}.", scaling_results.trainings(H200)]
    if scaling_results.recorded(H200)["studies"]:
        parts.append(scaling_results.study(H200))
    return "\n\n".join(parts)


def steps(name: str) -> str:
    """Milliseconds of a whole iteration [10 %, 90 %], of its steps [floor], and of all with events around each, from a
    file of `turbogs bench step`."""
    return on(name, lambda: _steps(name))


def _steps(name: str) -> str:
    lines = []
    for entry in measured(name)["passes"]:
        whole, parts, floors = entry["free_running"], entry["steps"], entry["floors_ms"]
        texts = (f"{parts[step]['device']['median_ms']:.3f} [{floors[step]:.3f}]" for step in STEPS)
        spread = f"{whole['median_ms']:.2f} [{whole['p10_ms']:.2f}, {whole['p90_ms']:.2f}]"
        events = f"{parts['iteration']['device']['median_ms']:.2f}"
        density = f"{entry['density_event']['wall']['median_ms']:.1f}"
        lines.append((f"{entry['gaussians'] // 1000}k", entry["views"], spread, *texts, events, density))
    return table(("Gaussians", "K", "whole", *STEPS.values(), "with events", "an event of density control"), lines)


MEMORY = {
    "parameters": "parameters",
    "optimizer": "optimizer",
    "density_statistics": "statistics",
    "error_maps": "maps",
    "training_photos": "photos",
    "raster_workspace": "rasterizer",
    "temporary": "temporaries",
}
"""Parts of a peak, and what they are called in a table."""


def memory() -> str:
    """Bytes of the device at the peak, what they are, and what turbogs_plugin/plan/memory.py predicts."""
    record = measured("bench-step.json")
    photos = np.full((record["training_views"], 2), record["image_size"])
    lines = []
    for entry in record["passes"]:
        places = (f"train.{of}_place=device" for of in ("photos", "maps"))
        config = load_config(
            "turbogs", ["schedule.type=fixed", f"schedule.views={entry['views']}", "train.sh_degree=3", *places]
        )
        demand = MemoryDemand.of(config, train_sizes=photos, test_sizes=photos[:0])
        sizes = entry["memory_bytes"]
        predicted = (demand.fixed + demand.per_gaussian * entry["gaussians"]) / sizes["peak"]
        texts = (f"{sizes[part] / 1e9:.2f}" for part in (*MEMORY, "peak"))
        lines.append((f"{entry['gaussians'] // 1000}k", entry["views"], *texts, f"{predicted:.2f}"))
    return table(("Gaussians", "K", *MEMORY.values(), "peak", "predicted, times the peak"), lines)


def offload() -> str:
    """Milliseconds of an iteration by the wall clock with photos and maps in host memory, and what travels."""
    (entry,) = measured("bench-4k.json")["passes"]
    alone = entry["wall"]["median_ms"]
    stored = (entry["memory_bytes"]["error_maps"] + entry["memory_bytes"]["training_photos"]) / 1e9
    lines = [(f"all on the GPU ({stored:.1f} GB of photos and maps)", f"{alone:.2f}", "", "", "")]
    for place, found in entry["offload"].items():
        time = found["wall"]["median_ms"]
        sizes = (found[key] / 1e9 for key in ("window_bytes", "bytes_in", "bytes_out"))
        texts = (f"{size:.2f} GB" if size else "" for size in sizes)
        lines.append((f"{place} in host memory", f"{time:.2f} ({time - alone:+.2f})", *texts))
    return table(("", "ms", "in the windows", "travels in", "travels out"), lines)


def builds() -> dict[str, dict[str, Any]]:
    record = measured("bench-raster.json")
    (exact,) = record["other_builds"].values()
    return {"default": record, "exact": exact}


def raster() -> str:
    """Milliseconds of a forward and backward pass of three views, beside gsplat's and beside the exact build."""
    lines = []
    for peer in measured("bench-raster.json")["gsplat"]:
        theirs, cells = peer["unpacked"]["median_ms"], []
        for record in builds().values():
            for rate in (1.0, 0.1):
                ours = pass_ms(record, peer["gaussians"], peer["views"], rate, False)
                cells.append(f"{ours:.2f} ({ours / theirs:.2f})")
        lines.append((f"{peer['gaussians'] // 1000}k", peer["views"], f"{theirs:.2f}", *cells))
    header = (f"{build}, r = {rate}" for build in ("ours", "exact build") for rate in (1, 0.1))
    return table(("Gaussians", "K", "gsplat 1.5.3, dense", *header), lines)


def pass_ms(record: dict[str, Any], gaussians: int, views: int, rate: float, sums: bool) -> float:
    """Median of the pass that is named."""
    asked = {"gaussians": gaussians, "views": views, "rate": rate, "density_sums": sums}
    (entry,) = (entry for entry in record["passes"] if asked.items() <= entry.items())
    return entry["forward_backward"]["median_ms"]


def precision() -> str:
    """Error against time of both builds: errors against float64, times of 600k Gaussians, K = 10, r = 0.1."""
    lines = []
    for build, record in builds().items():
        errors = record["precision"]
        gradients = (f"{errors[f'{name}_gradient']:.2e}" for name in ("mean", "conic", "color", "opacity"))
        colors = (f"{errors[f'forward_{name}']:.2e}" for name in ("mean", "max", "beyond_1e-4"))
        lines.append((build, f"{pass_ms(record, 600_000, 10, 0.1, True):.2f}", *colors, *gradients))
    header = ("colours: mean", "maximum", "share beyond 1e-4", "gradient of means", "conics", "colours", "opacities")
    return table(("build", "ms", *header), lines)


def solvers() -> str:
    """Error and time of the optimizer's solvers, as `turbogs bench numerics` printed it."""
    record = json.loads((H200.parent / "numerics/solvers.json").read_text())
    return f"{_where(record)}\n\n{solvers_table([SolverResult(**_numbers(result)) for result in record['results']])}"


def density_sums() -> str:
    """Errors of density control's statistics, as `turbogs bench numerics` printed them."""
    record = json.loads((H200.parent / "numerics/statistics.json").read_text())
    return f"{_where(record)}\n\n{statistics_table([StatisticsResult(**result) for result in record['results']])}"


def _where(record: dict[str, Any]) -> str:
    machine = record["machine"]
    return f"{machine['hardware']}, {machine['threads']} thread, torch {machine['software']['torch']}."


def _numbers(result: dict[str, Any]) -> dict[str, Any]:
    """JSON has null for NaN."""
    return {name: math.nan if value is None else value for name, value in result.items()}
