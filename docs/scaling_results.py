"""Prints what docs/measure_scaling.sh has measured so far, beside the predictions of docs/scaling_model.py.

python docs/scaling_results.py OUT

Reads what is there of OUT/ranks.json (or the lines of ranks.txt, where the bench was cut short), OUT/runs/*-SEED with
their histories, and OUT/study-GPUS with the times at which its cells ended. Of the last two, OUT/scaling.json is
written, which docs/results/h200 keeps beside ranks.json.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import mean
from typing import Any

import torch
from scaling_model import MEASURED, Case, table, way_of

from turbogs_plugin.report.provenance import provenance
from turbogs_plugin.study.statistics import seconds_to_reach
from turbogs_plugin.train.history import Evaluation, read_history

KEPT = "scaling.json"
"""The file of OUT with what is kept of runs and studies."""

BELOW = {"psnr": (0.0, 0.25, 0.5, 1.0), "ssim": (0.0, 0.002, 0.005, 0.01)}
"""Times to so much below the last PSNR, and SSIM, of the run that ends with the lowest one."""

KINDS = {"two": "two GPUs", "four": "four GPUs", "batch": "two GPUs, `train.batch_for=auto`"}
"""Names of runs beside those on one GPU."""

LINE = re.compile(r"(\d+) GPU  M=(\d+) K=(\d+) lambda=([\d.]+) \(([\w, ]+)\): ([\d.]+) ms")


def passes(out: Path) -> Iterator[tuple[int, int, int, float, str, float]]:
    """(GPUs, Gaussians, K, lambda, exchange, milliseconds) of each measurement."""
    if (out / "ranks.json").is_file():
        for one in json.loads((out / "ranks.json").read_text())["passes"]:
            time = one["wall"]["median_ms"]
            yield one["gpus"], one["gaussians"], one["views"], one["pixel_budget"], one["exchange"], time
    elif (out / "ranks.txt").is_file():
        for gpus, gaussians, views, images, exchange, time in LINE.findall((out / "ranks.txt").read_text()):
            yield int(gpus), int(gaussians), int(views), float(images), exchange, float(time)


def iterations(out: Path) -> str:
    """A table of the iterations, times one GPU's with the same K; where all is N times as much, in pixels a second."""
    measured = list(passes(out))
    alone = {(count, views): time for gpus, count, views, _, _, time in measured if gpus == 1}
    usual = min((images for *_, images, _, _ in measured), default=1.0)
    rows = {}
    for gpus, count, views, images, exchange, time in measured:
        grown = round(images / usual)
        case: Case | None = MEASURED.get(f"{count // 1000}k, K = {views // grown}")
        base = alone.get((count, views // grown))
        found = f"{time:.2f} ms" + (f", {grown * base / time:.2f}x" if base else "")
        expected = "-"
        if case is not None:
            predicted = case.grown(grown).on(gpus, *way_of(exchange))
            expected = f"{predicted:.2f} ms, {grown * case.on(1) / predicted:.2f}x"
        batch = f", {grown} times the batch" if grown > 1 else ""
        machine = "1 GPU" if gpus == 1 else f"{gpus} GPUs, {exchange}"
        rows[f"{count // 1000}k, K = {views}{batch}, {machine}"] = [found, expected]
    return table("an iteration", rows, ("measured", "predicted"))


def recorded(out: Path) -> dict[str, Any]:
    """What is kept of whole runs and of a study: ``runs``, name -> evaluations as (iteration, seconds, PSNR, SSIM,
    Gaussians), ``studies``, GPUs -> seconds at which cells ended, and ``provenance``. Of OUT, or of the file that
    `main` made of it there."""
    kept = json.loads((out / KEPT).read_text()) if (out / KEPT).is_file() else {}
    if kept and not (out / "runs").is_dir():
        return kept
    runs = {}
    for run in sorted((out / "runs").glob("*-*")):
        history = read_history(run / "history.jsonl")
        if history:
            columns = ("iteration", "train_seconds", "psnr", "ssim", "num_gaussians")
            runs[run.name] = [[getattr(line, column) for column in columns] for line in history]
    studies = {}
    for gpus in ("0", "0,1", "0,1,2,3"):
        ends = sorted(file.stat().st_mtime for file in (out / f"study-{gpus}").glob("cells/*/*.json"))
        if ends:
            studies[gpus] = [round(end - ends[0], 3) for end in ends]
    # Of the machine that measured, which has written the file first.
    place = kept.get("provenance") or asdict(provenance("cuda" if torch.cuda.is_available() else "cpu"))
    return {"provenance": place, "runs": runs, "studies": studies}


def trainings(out: Path) -> str:
    """A table of the runs, and their means against those of one GPU with the same seeds."""
    histories = {
        name: [Evaluation(step, seconds, psnr, ssim, 0.0, count) for step, seconds, psnr, ssim, count in lines]
        for name, lines in recorded(out)["runs"].items()
    }
    if not histories:
        return "no run has ended"
    marks = []  # (heading, measure, level)
    for measure, unit, digits in (("psnr", " dB", 2), ("ssim", "", 4)):
        wanted = min(max(getattr(line, measure) for line in history) for history in histories.values())
        marks += [(f"{wanted - below:.{digits}f}{unit}", measure, wanted - below) for below in BELOW[measure]]
    times = {  # the end is the last one
        name: [*(seconds_to_reach(history, level, measure) for _, measure, level in marks), history[-1].train_seconds]
        for name, history in histories.items()
    }
    rows = {}
    for name, history in histories.items():
        last = history[-1]
        rows[name] = [f"{time:.2f} s" for time in times[name]]
        rows[name] += [f"{last.psnr:.2f} dB", f"{last.ssim:.4f}", str(last.num_gaussians), str(last.iteration)]
    head = (*(f"to {heading}" for heading, _, _ in marks), "end", "PSNR", "SSIM", "Gaussians", "iterations")
    return f"{table('run', rows, head)}\n\n{_sooner(histories, times, head[: len(marks) + 1])}"


def _sooner(histories: dict[str, list[Evaluation]], times: dict[str, list[float]], marks: Sequence[str]) -> str:
    """A table: how many times as soon as one GPU each kind of run is at its marks, the mean over seeds of both, and its
    errors less those of one GPU."""
    rows = {}
    for kind, name in KINDS.items():
        seeds = [seed for seed in "01234" if f"one-{seed}" in histories and f"{kind}-{seed}" in histories]
        if not seeds:
            continue
        pairs = [(times[f"one-{seed}"], times[f"{kind}-{seed}"]) for seed in seeds]
        sooner = (mean(alone[place] / ours[place] for alone, ours in pairs) for place in range(len(marks)))
        ends = [(histories[f"one-{seed}"][-1], histories[f"{kind}-{seed}"][-1]) for seed in seeds]
        rows[f"{name} ({len(seeds)})"] = [
            *(f"{factor:.2f}x" for factor in sooner),
            f"{mean(ours.psnr - alone.psnr for alone, ours in ends):+.2f} dB",
            f"{mean(ours.ssim - alone.ssim for alone, ours in ends):+.4f}",
        ]
    return table("times as soon as one GPU (seeds)", rows, (*marks, "PSNR", "SSIM")) if rows else ""


def study(out: Path) -> str:
    """Cells a minute of a study, from the end of each GPU's first cell on: without the start of the processes."""
    rates = {}
    for gpus, ends in recorded(out)["studies"].items():
        count = len(gpus.split(","))
        if len(ends) > count and ends[-1] > ends[count - 1]:
            rates[gpus] = (len(ends) - count) / (ends[-1] - ends[count - 1])
    lines = [f"A study on GPUs {gpus}: {60 * rate:.1f} cells a minute." for gpus, rate in rates.items()]
    for gpus, least in (("0,1", 1.9), ("0,1,2,3", 3.8)):
        if {"0", gpus} <= rates.keys():
            count = len(gpus.split(","))
            lines.append(f"{count} GPUs: {rates[gpus] / rates['0']:.2f} times one (wanted: {least}).")
    return "\n".join(lines) or "no study has ended"


def wanted(out: Path) -> str:
    """What issue and page ask of an iteration, so far as it is measured."""
    found: dict[tuple[int, int, int], float] = {}
    for gpus, count, views, _, how, time in passes(out):
        if not how.startswith("records to all"):
            found.setdefault((gpus, count, views), time)  # the way that training takes comes first
    lines = []
    for count, views, least in ((600_000, 10, 1.3), (150_000, 10, 1.0), (150_000, 3, 1.0)):
        one, two = found.get((1, count, views)), found.get((2, count, views))
        if one and two:
            verdict = "reached" if one / two >= least else "missed"
            lines.append(
                f"{count // 1000}k, K = {views}: {one / two:.2f} times one GPU, wanted at least {least}: {verdict}"
            )
    return "\n".join(lines)


def main() -> None:
    out = Path(sys.argv[1])
    (out / KEPT).write_text(f"{json.dumps(recorded(out), indent=1)}\n")
    print("\n\n".join(filter(None, [iterations(out), wanted(out), trainings(out), study(out)])))


if __name__ == "__main__":
    main()
