"""Tables of docs/captures.md, from docs/results/h200/captures.json, which docs/measure_captures.py wrote."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from machine_tables import ABSENT, H200, where

from turbogs_plugin.report.tables import table
from turbogs_plugin.study.pages import difference_text, spread_text
from turbogs_plugin.study.statistics import Difference, Spread

CAPTURES = H200 / "captures.json"

RAW = {"seconds": ("s", 2), "psnr": ("PSNR", 2), "ssim": ("SSIM", 4)}
"""Measure -> head of its column, and digits behind the point."""
ALIGNED = {"aligned_psnr": ("PSNR, aligned", 2), "aligned_ssim": ("SSIM, aligned", 4)}


def measured(name: str, file: Path = CAPTURES) -> dict[str, Any] | None:
    """What was measured by this name, or None."""
    return json.loads(file.read_text()).get(name) if file.is_file() else None


def grouped(record: dict[str, Any], having: str, key: str) -> dict[Any, list[dict[str, Any]]]:
    """Value of `key` -> the runs that have it, in their order; of those runs alone that have `having`."""
    groups: dict[Any, list[dict[str, Any]]] = {}
    for run in record["runs"]:
        if having in run:
            groups.setdefault(run[key], []).append(run)
    return groups


def lenses() -> str:
    """Whole trainings on photos undistorted on loading, and by COLMAP beforehand."""
    return trainings("lenses", RAW)


def exposure_runs() -> str:
    """Whole trainings without and with exposures."""
    return trainings("exposures", RAW | ALIGNED)


def masked_runs() -> str:
    """Whole trainings without masks and with half of each photo masked."""
    return trainings("masks", RAW)


def trainings(name: str, columns: dict[str, tuple[str, int]], file: Path = CAPTURES) -> str:
    """A row for each variant, mean and range of its seeds; and a row for the last minus the first, seed by seed."""
    record = measured(name, file)
    if record is None:
        return ABSENT
    variants = grouped(record, "seed", "variant")
    rows = []
    for variant, runs in variants.items():
        texts = [spread_text(Spread.of(run[measure] for run in runs), columns[measure][1]) for measure in columns]
        size = f"{Spread.of(run['gaussians'] for run in runs).mean / 1e3:.0f}k"
        photo = "{}x{}".format(*runs[0]["size"])
        rows.append((variant, photo, len(runs), runs[0]["iterations"], *texts, size))
    if len(variants) > 1:
        first, *_, last = variants.values()
        pairs = list(zip(first, last, strict=False))
        differences = (
            Difference.of([after[measure] - before[measure] for before, after in pairs]) for measure in columns
        )
        texts = map(difference_text, differences, (digits for _, digits in columns.values()))
        rows.append(("difference", "", len(pairs), "", *texts, ""))
    heads = (head for head, _ in columns.values())
    made = table(("", "photos", "seeds", "iterations", *heads, "Gaussians"), rows)
    return f"{where(record)}.\n\n{made}"


def masked_iterations(file: Path = CAPTURES) -> str:
    """Milliseconds of an iteration of one model, without masks and with half of each photo masked."""
    record = measured("masks", file)
    if record is None:
        return ABSENT
    times = grouped(record, "views", "views")
    rows = []
    for views, (whole, half) in ((views, pair) for views, pair in times.items() if len(pair) == 2):
        cells = []
        for clock in ("free_running", "wall"):
            before, after = (run[clock]["median_ms"] for run in (whole, half))
            cells += [f"{before:.3f}", f"{after:.3f}", f"{100 * (after / before - 1):+.0f} %"]
        rows.append((f"{whole['gaussians'] / 1e3:.0f}k", views, whole["samples"], half["samples"], *cells))
    if not rows:
        return ABSENT
    heads = [f"{head}{clock}" for clock in ("", ", wall") for head in ("whole, ms", "half, ms", "change")]
    return table(("Gaussians", "K", "samples", "samples, half", *heads), rows)


def many_photos(file: Path = CAPTURES) -> str:
    """One training on thousands of photos within a limit of memory."""
    record = measured("many", file)
    if record is None:
        return ABSENT
    rows = []
    for run in record["runs"]:
        ended = "with a model" if run["exit_code"] == 0 and run.get("model") else f"exit code {run['exit_code']}"
        sizes = [f"{run[key] / 2**30:.2f} GiB" if key in run else "" for key in ("tensor_bytes", "peak_bytes")]
        trained = [
            run.get("iterations", ""),
            *(f"{run[key]:.0f}" for key in ("train_seconds", "seconds") if key in run),
        ]
        errors = [f"{run['psnr']:.2f}", f"{run['gaussians'] / 1e3:.0f}k"] if "psnr" in run else ["", ""]
        rows.append((run["photos"], " ".join(run["limit"]), *trained, *errors, *sizes, ended))
    heads = ("photos", "limit", "iterations", "s of training", "s on the wall", "PSNR", "Gaussians")
    made = table((*heads, "tensors on the GPU, peak", "main memory of all processes, peak", "ended"), rows)
    return f"{where(record)}.\n\n{made}"


def photos_alone(file: Path = CAPTURES) -> str:
    """Cameras that were found from photos alone, against the published ones."""
    record = measured("alone", file)
    if record is None:
        return ABSENT
    rows = []
    for run in record["runs"]:
        distances = [f"{100 * run[key]:.2f} %" for key in ("median", "largest")]
        rows.append((f"{run['registered']} of {run['photos']}", *distances, f"{run['seconds']:.0f} s"))
    made = table(("photos registered", "error of centers, median", "largest", "time"), rows)
    return f"{where(record)}.\n\n{made}"
