"""Tables made of what was timed on one machine: the files that `turbogs bench` and examples/ wrote into docs/lab/."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Sequence
from typing import Any

import numpy as np
from studies import LAB, read_json, table, where

Marks = list[dict[str, float]]
"""Evaluations of a run of gsplat's trainer: step, seconds of training, PSNR, SSIM, Gaussians."""


def wall() -> str:
    """Where each second of `turbogs train` goes: the run in the middle of each capture's."""
    reports = read_json("wall.json")["turbogs"]
    by_seconds = [sorted(report["runs"], key=lambda run: run["seconds"]) for report in reports.values()]
    runs = [found[(len(found) - 1) // 2] for found in by_seconds]
    parts = list(dict.fromkeys(part for run in runs for part in run["parts"]))
    lines = [(part, *(f"{run['parts'].get(part, 0.0):.2f}" for run in runs)) for part in parts]
    lines += [("whole command", *(f"{run['seconds']:.2f}" for run in runs))]
    return f"{'; '.join(dict.fromkeys(map(where, reports.values())))}.\n\n{table(('s', *reports), lines)}"


STEPS = {
    "EPS": "draw",
    "FWD": "projection to colour",
    "gather+L+E": "photo, loss, maps",
    "BWD": "backward",
    "solve+update": "solve, update",
}
"""Steps of an iteration -> their columns."""


def on(record: dict[str, Any], made: str) -> str:
    """A table below a line that says what it was measured on."""
    return f"{where(record)}; {record['scene']}, {'x'.join(map(str, record['image_size']))}.\n\n{made}"


def steps() -> str:
    """Milliseconds of an iteration [10 %, 90 %], and of its steps [floor]."""
    record, lines = read_json("step-h200.json"), []
    for entry in record["passes"]:
        whole, parts, floors = entry["free_running"], entry["steps"], entry["floors_ms"]
        texts = (f"{parts[step]['device']['median_ms']:.3f} [{floors[step]:.3f}]" for step in STEPS)
        spread = f"{whole['median_ms']:.2f} [{whole['p10_ms']:.2f}, {whole['p90_ms']:.2f}]"
        density = f"{entry['density_event']['wall']['median_ms']:.1f}"
        lines.append((f"{entry['gaussians'] // 1000}k", entry["views"], spread, *texts, density))
    head = ("Gaussians", "K", "whole", *STEPS.values(), "an event of density control")
    return on(record, table(head, lines))


def raster() -> str:
    """Milliseconds of a forward and backward pass beside gsplat's, in brackets times gsplat's."""
    record, lines = read_json("raster.json"), []
    for peer in record["gsplat"]:
        theirs, cells = peer["unpacked"]["median_ms"], []
        for rate in (1.0, 0.1):
            asked = {"gaussians": peer["gaussians"], "views": peer["views"], "rate": rate, "density_sums": False}
            (entry,) = (entry for entry in record["passes"] if asked.items() <= entry.items())
            ours = entry["forward_backward"]["median_ms"]
            cells.append(f"{ours:.2f} ({ours / theirs:.2f})")
        lines.append((f"{peer['gaussians'] // 1000}k", peer["views"], f"{theirs:.2f}", *cells))
    return on(record, table(("Gaussians", "K", "gsplat 1.5.3, dense", "ours, r = 1", "ours, r = 0.1"), lines))


def gsplat_main() -> str:
    """Milliseconds of our sparse pass and of gsplat main's, MiB, and the largest relative L2 error of a gradient."""
    record, lines = read_json("gsplat_main.json"), []
    for row in record["rows"]:
        for who in ("ours", "main"):
            found = row[who]
            times = (f"{found[name]:.2f}" for name in ("lists", "forward", "backward", "pass"))
            lines.append((f"{row['rate']:.0%}", who, *times, f"{found['mib']:.0f}", f"{found['error']:.0e}"))
    head = ("pixels", "", "layout and lists", "forward", "backward", "pass", "MiB", "error of a gradient")
    return f"{record['device']}, commit {record['commit'][:7]}, {record['day']}.\n\n{table(head, lines)}"


def ranks() -> str:
    """Milliseconds of an iteration on several GPUs, and times one GPU: in pixels a second where the batch is larger."""
    record = read_json("ranks.json")
    alone = {(of["gaussians"], of["views"]): of["wall"]["median_ms"] for of in record["passes"] if of["gpus"] == 1}
    lines: dict[str, dict[str, str]] = {}
    for of in record["passes"]:
        batch, time = round(of["pixel_budget"]), of["wall"]["median_ms"]
        one = alone[of["gaussians"], of["views"] // batch]
        case = f"{of['gaussians'] // 1000}k, K = {of['views'] // batch}{', N times the batch' if batch > 1 else ''}"
        exchange = of.get("exchange", "").removeprefix("owners of rows, ")
        machine = f"{of['gpus']} GPUs, {exchange}" if of["gpus"] > 1 else "1 GPU"
        lines.setdefault(case, {})[machine] = f"{time:.2f} ms, {batch * one / time:.2f}x"
    machines = dict.fromkeys(name for of in lines.values() for name in of if "all" not in name)
    rows = [(case, *(found.get(machine, "") for machine in machines)) for case, found in lines.items()]
    return f"{where(record)}.\n\n{table(('an iteration', *machines), rows)}"


RUNS = {"one": "one GPU", "two": "two GPUs", "batch": "two GPUs, `train.batch_for=auto`"}
"""Prefix of a run's name in rank_runs.json -> its row."""


def rank_runs() -> str:
    """Whole runs on one GPU and on two: means over seeds."""
    record, lines, alone = read_json("rank_runs.json"), [], None
    for prefix, name in RUNS.items():
        ends = [history[-1] for run, history in record["runs"].items() if run.startswith(f"{prefix}-")]
        iteration, seconds, psnr, ssim, gaussians = (statistics.fmean(column) for column in zip(*ends, strict=True))
        alone = alone or seconds
        texts = (f"{seconds:.2f}", f"{alone / seconds:.2f}x", f"{psnr:.2f}", f"{ssim:.4f}", f"{gaussians / 1e3:.0f}k")
        lines.append((f"{name} ({len(ends)})", f"{iteration:.0f}", *texts))
    head = ("run (seeds)", "iterations", "training s", "times as soon", "PSNR", "SSIM", "Gaussians")
    return f"{where(record)}.\n\n{table(head, lines)}"


SWAPS = {
    "step": "the whole step",
    "density": "density control",
    "errors": "density control, ranked by errors",
    "lm": "density control by errors, and Moment-LM",
    "sparse": "sparse pixels, 4 views",
}

PASSED = (7000, 30000)
"""Steps of stock whose result the whole step is to pass; the last is the length of stock's run."""


def by_length(record: dict[str, Any]) -> dict[tuple[str, str, float], list[Marks]]:
    """(Capture, variant, steps of a run) -> its seeds."""
    runs: dict[tuple[str, str, float], list[Marks]] = {}
    for run in record["runs"]:
        runs.setdefault((run["scene"], run["variant"], run["marks"][-1]["step"]), []).append(run["marks"])
    return runs


def dropin() -> str:
    """Variants of examples/simple_trainer/compare.py, means over seeds, and what they have beside stock."""
    parts = []
    for record in sorted((read_json(file.name) for file in LAB.glob("dropin*.json")), key=lambda of: of["date"]):
        runs, lines = by_length(record), []
        stocks = {scene: seeds for (scene, variant, _), seeds in runs.items() if variant == "stock"}
        for (scene, variant, _), seeds in runs.items():
            end, beside = {name: statistics.fmean(marks[-1][name] for marks in seeds) for name in seeds[0][-1]}, ""
            if variant not in ("stock", "step") and (stock := stocks.get(scene)):
                beside = at_equal_time(stock, seeds)
            texts = (f"{end[name]:.{digits}f}" for name, digits in (("seconds", 1), ("psnr", 2), ("ssim", 4)))
            texts = (f"{end['step']:.0f}", *texts, f"{end['gaussians'] / 1e3:.0f}k")
            lines.append((scene, f"{SWAPS.get(variant, variant)} ({len(seeds)})", *texts, beside))
        head = ("capture", "swap (seeds)", "steps", "s", "PSNR", "SSIM", "Gaussians", "beside stock at equal time")
        parts.append(f"{record['device']}, {record['date']}:\n\n{table(head, lines)}")
    return "\n\n".join(parts)


def at_equal_time(stock: Sequence[Marks], ours: Sequence[Marks]) -> str:
    """Both measures when the first of them has ended, on straight lines between evaluations."""
    seconds = min(of[0][-1]["seconds"] for of in (stock, ours))

    def mean(of: Sequence[Marks], name: str) -> float:
        curves = ([[mark[key] for mark in marks] for key in ("seconds", name)] for marks in of)
        return statistics.fmean(float(np.interp(seconds, *curve)) for curve in curves)

    theirs, own, gain = mean(stock, "psnr"), mean(ours, "psnr"), mean(ours, "ssim") - mean(stock, "ssim")
    return f"{own - theirs:+.2f} dB, {gain:+.4f}: {own:.2f} for {theirs:.2f} dB at {seconds:.0f} s"


def sooner(stock: Sequence[Marks], ours: Sequence[Marks], step: float) -> tuple[float, float]:
    """The fewest and the most times sooner that our runs pass PSNR and SSIM of stock's runs at a step; 0: never."""
    ends, times = [mark for marks in stock for mark in marks if mark["step"] == step], []
    for end, marks in itertools.product(ends, ours):
        past = (mark["seconds"] for mark in marks if mark["psnr"] >= end["psnr"] and mark["ssim"] >= end["ssim"])
        times.append(end["seconds"] / next(past, np.inf))
    return min(times), max(times)


def whole_step() -> str:
    """How much sooner the whole step passes stock's results, by the length of its run that does so soonest."""
    runs, rows = by_length(read_json("dropin-step.json")), []
    captures = dict.fromkeys(scene for scene, *_ in runs)
    for step in PASSED:
        cells = [step]
        for capture in captures:
            found = {
                of[2]: sooner(runs[capture, "stock", PASSED[-1]], runs[of], step)
                for of in runs
                if of[:2] == (capture, "step")
            }
            length, (low, high) = max(found.items(), key=lambda of: of[1])
            cells.append(f"{low:.0f} to {high:.0f} times, by {length} steps")
        rows.append(cells)
    return table(("stock's steps", *captures), rows)


def pixels_on_an_mlp() -> str:
    """PSNR of a network without Gaussians by both ways, means of seeds: what examples/pixels_on_an_mlp.py wrote."""
    lines, photos = [], read_json("pixels_on_an_mlp.json")
    for photo, (plain, ours) in ((name, found["psnr"].values()) for name, found in photos.items()):
        gains = [after - before for before, after in zip(plain, ours, strict=True)]
        means = (f"{statistics.fmean(values):.2f}" for values in (plain, ours))
        lines.append((photo, *means, f"{statistics.fmean(gains):+.2f} [{min(gains):+.2f}, {max(gains):+.2f}]"))
    made = table(("photo", "random pixels, Charbonnier", "error-guided pixels, NCC", "gain in dB"), lines)
    return f"{'; '.join(dict.fromkeys(map(where, photos.values())))}.\n\n{made}"
