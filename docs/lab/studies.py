"""Tables made of trainings: docs/lab/STUDY/results.json."""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml

LAB = Path(__file__).resolve().parent
CAPTURES = ("fox", "caliterra", "snowmiku")
ROWS = yaml.safe_load((LAB / "rows.yaml").read_text(encoding="utf-8"))
"""What the rows of the record's tables and of docs/paper.md are."""
STUDIES = tuple(sorted(file.parent.name for file in LAB.glob("*/results.json")))
Cell = dict[str, Any]
"""One training, as `turbogs_plugin/study/results.py` describes its entry in results.json."""
Cells = list[Cell]
"""Trainings of one variant on one capture, a seed each."""


@cache
def study_cells(study: str) -> dict[str, dict[str, Cells]]:
    """Capture -> variant -> trainings; the baseline first. Empty where the study is not there."""
    if not (LAB / study / "results.json").is_file():
        return {}
    record = read_json(f"{study}/results.json")
    baseline = record["baseline"] or next(iter(record["variants"]))
    found: dict[str, dict[str, Cells]] = {}
    for capture in dict.fromkeys((*CAPTURES, *(cell["scene"] for cell in record["cells"]))):
        for variant in sorted(record["variants"], key=lambda name: name != baseline):  # stable
            cells = [cell for cell in record["cells"] if (cell["scene"], cell["variant"]) == (capture, variant)]
            if cells:
                found.setdefault(capture, {})[variant] = cells
    return found


@cache
def read_json(name: str) -> Any:
    """A record in docs/lab/."""
    return json.loads((LAB / name).read_text(encoding="utf-8"))


def values(cells: Cells, measure: str) -> list[float]:
    """A field of each training's last evaluation."""
    return [cell["final"][measure] for cell in cells]


def mean(cells: Cells, measure: str) -> float:
    return math.fsum(values(cells, measure)) / len(cells)


T95 = (12.71, 4.30, 3.18, 2.78, 2.57, 2.45, 2.36, 2.31, 2.26, 2.23)
"""Student's t of 1 .. 10 degrees of freedom: 95 % of means of pure noise lie within t standard errors."""


@dataclass(frozen=True)
class Difference:
    """A measure minus the baseline's, mean over the seeds that both have.

    Args:
        mean, error: the mean and its standard error; NaN without two seeds.
        count: seeds.
    """

    mean: float
    error: float
    count: int

    @classmethod
    def between(cls, cells: Cells, base: Cells, measure: str) -> Difference:
        known = {cell["seed"]: cell["final"][measure] for cell in base}
        found = [cell["final"][measure] - known[cell["seed"]] for cell in cells if cell["seed"] in known]
        count = len(found)
        error = statistics.stdev(found) / math.sqrt(count) if count > 1 else math.nan
        return cls(math.fsum(found) / count if count else math.nan, error, count)

    @classmethod
    def over(cls, parts: Sequence[Difference]) -> Difference:
        """The mean of captures' differences, with the error that the spread of their seeds gives it."""
        error = math.hypot(*(part.error for part in parts)) / len(parts)
        return cls(statistics.fmean(part.mean for part in parts), error, 1 + sum(part.count - 1 for part in parts))

    @property
    def clear(self) -> bool:
        """Noise alone gives a mean this large in fewer than 1 of 20 cases."""
        return self.count > 1 and abs(self.mean) > T95[min(self.count - 1, len(T95)) - 1] * self.error

    def text(self, digits: int, unit: str = "") -> str:
        error = "" if math.isnan(self.error) else f" ± {self.error:.{digits}f}"
        return f"{self.mean:+.{digits}f}{error}{unit}{' (clear)' if self.clear else ''}"


def table(head: Sequence[str], lines: Iterable[Sequence[Any]]) -> str:
    """A table in Markdown."""
    rows = [head, ["---"] * len(head), *lines]
    return "\n".join(f"| {' | '.join(map(str, row))} |" for row in rows)


def by_capture(head: str, lines: Mapping[str, Mapping[str, str]]) -> str:
    """A table with a column a capture, of rows that have a cell for some captures."""
    found = [capture for cells in lines.values() for capture in cells]
    captures = sorted(set(found), key=[*CAPTURES, *found].index)
    return table((head, *captures), [[name, *(cells.get(of, "") for of in captures)] for name, cells in lines.items()])


def duration(seconds: float) -> str:
    return "-" if math.isnan(seconds) else f"{seconds:.1f}" if seconds < 10 else f"{seconds:.0f}"


def counted(gaussians: float) -> str:
    return f"{gaussians / 1e6:.2f}M" if gaussians >= 1e6 else f"{gaussians / 1e3:.0f}k"


def result(cells: Cells, psnr: str, errors: str = "") -> str:
    """``4.1 s, 32.20 dB, .893, 209k``, means over seeds. `errors`: as of `change`."""
    ssim = f"{mean(cells, f'{errors}ssim'):.3f}".lstrip("0")
    return f"{duration(mean(cells, 'seconds'))} s, {psnr} dB, {ssim}, {counted(mean(cells, 'gaussians'))}"


def psnr_text(cells: Cells, measure: str = "psnr") -> str:
    """The mean, and with several seeds the lowest and the highest."""
    found = values(cells, measure)
    spread = f" [{min(found):.2f}, {max(found):.2f}]" if len(found) > 1 else ""
    return f"{mean(cells, measure):.2f}{spread}"


def place(machine: str, commit: str, day: str = "") -> str:
    """The GPU, or the CPU where none was used; the host's cores; commit and day."""
    device, _, host = machine.partition(" (")
    cores = [part for part in host.split(", ") if part.endswith(" cores")]
    return ", ".join(filter(None, [device, *cores, f"commit {commit[:7]}", day]))


def where(record: Mapping[str, Any]) -> str:
    """Machine, commit, day and torch of a file that a bench wrote."""
    of = record["provenance"]
    return f"{place(of['machine'], of['commit'], of.get('day', ''))}, torch {of['software']['torch']}"


def ratio(cells: Cells, base: Cells, measure: str) -> float:
    """Mean over the baseline's mean, both over the seeds that both have."""
    seeds = {cell["seed"] for cell in cells} & {cell["seed"] for cell in base}
    own, of_base = (mean([cell for cell in of if cell["seed"] in seeds], measure) for of in (cells, base))
    return own / of_base


def change(cells: Cells, base: Cells, errors: str = "", timed: bool = True) -> str:
    """Differences in PSNR and SSIM, ratios of seconds and Gaussians, and how many seeds.

    Args:
        errors: "refined_": by refined cameras of the test photos.
        timed: the seconds mean something.
    """
    psnr, ssim = (Difference.between(cells, base, f"{errors}{measure}") for measure in ("psnr", "ssim"))
    seconds = f"x {ratio(cells, base, 'seconds'):.2f} s, " if timed else ""
    ratios = f"{seconds}x {ratio(cells, base, 'gaussians'):.2f} N"
    return f"{psnr.text(2, ' dB')}, {ssim.text(4)}, {ratios} ({psnr.count})"


def study_table(study: str, errors: str = "") -> str:
    """Every variant of a study: seconds of training, errors and Gaussians; below them the change from the baseline. In
    a study of further captures, the mean change over all of them, too, of the variants that all have."""
    lines: dict[str, dict[str, str]] = {}
    found = study_cells(study)
    for capture, by_variant in found.items():
        baseline, *_ = by_variant.values()
        for variant, cells in by_variant.items():
            text = f"{result(cells, psnr_text(cells, f'{errors}psnr'), errors)} ({len(cells)})"
            compared = cells is not baseline and Difference.between(cells, baseline, "psnr").count
            text += f"<br>{change(cells, baseline, errors)}" if compared else ""
            lines.setdefault(variant, {})[capture] = text
    baseline, *others = lines
    everywhere = [variant for variant in others if all(variant in of for of in found.values())]
    for variant in everywhere if len(found) > len(CAPTURES) else ():
        pairs = [(of[variant], of[baseline]) for of in found.values()]
        psnr, ssim = (Difference.over([Difference.between(*pair, of) for pair in pairs]) for of in ("psnr", "ssim"))
        lines[variant]["mean change"] = f"{psnr.text(3, ' dB')}, {ssim.text(4)}"
    return by_capture("", lines)
