"""README's sentence, table and plot, and the tables of docs/comparison.md: docs/lab/record beside other programs.

Rows are those of ``record`` in rows.yaml. A method's number is a mean over five captures of its means over seeds, and
missing where one capture has none.
"""

from __future__ import annotations

import hashlib
import json
import math
import statistics
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from matplotlib.figure import Figure
from PIL import Image
from studies import LAB, ROWS, Cells, counted, duration, place, read_json, study_cells, table

CAPTURES = ("fox", "caliterra", "snowmiku", "bonsai", "train")
PICTURE = LAB / "headline.png"
BYTES = 59 * 4
"""Of a Gaussian with three bands of harmonics in single precision, without normals, in every program here."""

MEASURES: dict[str, tuple[str, Callable[[float], str]]] = {
    "psnr": ("PSNR", "{:.2f}".format),
    "ssim": ("SSIM", lambda value: f"{value:.3f}".lstrip("0")),
    "seconds": ("train s", duration),
    "wall_seconds": ("command s", duration),
    "gaussians": ("Gaussians", counted),
    "megabytes": ("MB", "{:.0f}".format),
    "peak_gib": ("GiB", "{:.1f}".format),
    "fps": ("FPS", "{:.0f}".format),
}
"""Measure of a training -> its heading and its text. README's table has the first five."""


def text(measure: str, value: float) -> str:
    return "-" if math.isnan(value) else MEASURES[measure][1](value)


@dataclass(frozen=True)
class Method:
    """A row of the tables.

    Args:
        name: as the tables have it.
        peer: another program, whose runs are in peers.json; "": ours, in docs/lab/record.
        of: capture -> the variant of the study, or the number of Gaussians that the other program was asked for.
        color: of its curve in the plot; "": not drawn.
    """

    name: str
    of: Mapping[str, Any]
    peer: str = ""
    color: str = ""

    def cells(self, capture: str) -> Cells:
        """Trainings, with the measures of `MEASURES` that are known."""
        if not self.peer:
            return study_cells("record").get(capture, {}).get(self.of[capture], [])
        runs = read_json("peers.json")["runs"].values()
        asked = (self.peer, capture, self.of[capture])
        return [as_cell(run) for run in runs if (run["name"], run["scene"], run.get("target_primitives")) == asked]

    def mean(self, measure: str, *captures: str) -> float:
        """NaN where one of the captures, of all five where none is named, lacks the measure."""
        known = [[measures(cell)[measure] for cell in self.cells(of)] for of in captures or CAPTURES]
        return statistics.fmean(statistics.fmean(values or [math.nan]) for values in known)

    def curve(self, measure: str) -> list[float]:
        """Means over the captures at each evaluation; empty where a capture has no curve."""
        found = [[cell["curve"][measure] for cell in self.cells(of) if cell["curve"]] for of in CAPTURES]
        means = [map(statistics.fmean, zip(*curves, strict=True)) for curves in found if curves]
        return list(map(statistics.fmean, zip(*means, strict=True))) if all(found) else []

    def columns(self) -> dict[str, list[float]]:
        """The plot's curve: errors against seconds of the whole command, whose parts but training come first."""
        beside = self.mean("wall_seconds") - self.mean("seconds")
        curve = {name: self.curve(name) for name in ("seconds", "psnr", "ssim")}
        return curve | {"seconds": [beside + seconds for seconds in curve["seconds"]]}


METHODS = [Method(**row) for row in ROWS["record"]]
PROVENANCES = read_json("record/results.json")["provenances"] if study_cells("record") else []


def as_cell(run: Mapping[str, Any]) -> dict[str, Any]:
    """A run of peers.json as a training of a study."""
    names = {"gaussians": "num_gaussians", "peak_gib": "peak_memory_gib"}
    final = {measure: run[name] for measure in MEASURES if (name := names.get(measure, measure)) in run}
    return {"final": final, "curve": run.get("history"), "variant": "", "scene": run["scene"]}


def measures(cell: Mapping[str, Any]) -> dict[str, float]:
    """Every measure of a training; NaN for what is not known."""
    found = dict.fromkeys(MEASURES, math.nan) | cell["final"]
    found["megabytes"] = found["gaussians"] * BYTES / 1e6
    found["peak_gib"] = found["peak_mib"] / 1024 if "peak_mib" in found else found["peak_gib"]
    timed = read_json("wall.json").get(cell["variant"], {}).get(cell["scene"])  # of ours, at the record's commit
    if timed and timed["provenance"]["commit"] in [of["commit"] for of in PROVENANCES]:
        found["wall_seconds"] = statistics.median(run["seconds"] for run in timed["runs"])
    return found


def headline() -> str:
    """Means over the five captures, the best of each column in bold."""
    shown, columns = list(MEASURES)[:5], []
    for measure in shown:
        values = [method.mean(measure) for method in METHODS]
        top = (max if measure in ("psnr", "ssim") else min)(values)
        best = "-" if any(map(math.isnan, values)) else text(measure, top)
        columns.append([f"**{cell}**" if cell == best != "-" else cell for cell in map(partial(text, measure), values)])
    return table(("", *(MEASURES[of][0] for of in shown)), zip((of.name for of in METHODS), *columns, strict=True))


def claim() -> str:
    """README's sentence: three rows of its table."""
    values = {of.name: [text(measure, of.mean(measure)) for measure in list(MEASURES)[:3]] for of in METHODS}
    ours, lite, fast = ("{} dB, {} SSIM after {} s".format(*values[METHODS[row].name]) for row in (4, 1, 0))
    said = f"**{ours} of training, {values[METHODS[5].name][0]} dB with exposures, the default;"
    return f"{said}\nLiteGS: {lite}; FastGS: {fast}. Means over five captures, on an H200.**"


def by_capture() -> str:
    """Every method on every capture; another program at each number of Gaussians that it was asked for."""
    runs, lines = read_json("peers.json")["runs"].values(), []
    for capture in CAPTURES:
        asked = dict.fromkeys((run["name"], run.get("target_primitives")) for run in runs if run["scene"] == capture)
        peers = [Method(name, {capture: of}, name) for name, of in asked]
        for method in (*peers, *(of for of in METHODS if not of.peer)):
            if cells := method.cells(capture):
                texts = (text(measure, method.mean(measure, capture)) for measure in MEASURES)
                lines.append((capture, method.name, *texts, len(cells)))
    return table(("capture", "method", *(heading for heading, _ in MEASURES.values()), "seeds"), lines)


def held() -> str:
    """Captures that no setting was chosen on: seconds of training, PSNR, SSIM and Gaussians, means over seeds."""
    record, lines = read_json("held.json"), {}
    for entry in (*record["others"], *record["ours"]):
        method, _, cap = (entry.get("method") or entry["settings"]).partition(", max_gaussians ")
        cell = ", ".join(text(of, entry.get(of, math.nan)) for of in ("seconds", "psnr", "ssim", "gaussians"))
        lines.setdefault(entry["scene"], {}).setdefault(f"{method} at a cap" if cap else method, []).append(cell)
    names = dict.fromkeys(name for cells in lines.values() for name in cells)
    rows = [(scene, *("<br>".join(cells.get(name, "-")) for name in names)) for scene, cells in lines.items()]
    return table(("capture", *names), rows)


def sources() -> str:
    """Machine, commit and day of the record, and where the others ran."""
    ours = dict.fromkeys(place(of["machine"], of["commit"], of["day"]) for of in PROVENANCES)
    others = read_json("peers.json")["method"]["what"]
    return table(("rows", "measured on"), [("ours", "; ".join(ours) or "-"), ("the others", others)])


def draw(drawn: list[tuple[str, str, dict[str, list[float]]]]) -> Figure:
    """PSNR, and beside it SSIM, against seconds of the command: a curve a method (name, colour, columns)."""
    figure = Figure(figsize=(11.0, 4.2), layout="constrained")
    for axis, (measure, span) in zip(figure.subplots(1, 2), (("psnr", 6.0), ("ssim", 0.12)), strict=True):
        names: list[tuple[float, float]] = []  # beside its curve's end, the first or above, the others or below
        for name, color, curve in sorted(drawn, key=lambda of: -of[2][measure][-1]):
            axis.plot(curve["seconds"], curve[measure], color=color, marker="o", markevery=[-1])
            end, place = curve["seconds"][-1], curve[measure][-1]
            taken = [*names, *((of["seconds"][-1], of[measure][-1]) for *_, of in drawn if of["seconds"][-1] > end)]
            while any(abs(place - other) < 0.06 * span and 0.25 < end / at < 4.0 for at, other in taken):
                place += 0.01 * span * (-1 if names else 1)
            names.append((end, place))
            axis.text(1.15 * end, place, name, color=color, verticalalignment="center")
        top = max(curve[measure][-1] for *_, curve in drawn)
        axis.set(xlabel="seconds of the command", xscale="log", xlim=(10, 320), ylim=(top - span, top + 0.08 * span))
        axis.set_title({"psnr": "test PSNR in dB", "ssim": "test SSIM"}[measure], loc="left")
        axis.set_xticks([10, 20, 40, 80, 160], ["10", "20", "40", "80", "160"])
        axis.set_xticks([], minor=True)
        axis.spines[["top", "right"]].set_visible(False)
    return figure


def draw_picture() -> None:
    """Draw README's plot where the file was drawn of other data."""
    drawn = [(of.name.partition(", at")[0], of.color, of.columns()) for of in METHODS if of.color and of.curve("psnr")]
    digest = hashlib.sha256(json.dumps(drawn).encode()).hexdigest()[:16]
    if not PICTURE.is_file() or Image.open(PICTURE).info.get("Comment") != digest:
        draw(drawn).savefig(PICTURE, dpi=90, metadata={"Comment": digest})
