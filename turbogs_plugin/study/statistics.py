"""Numbers over seeds: means with standard errors, differences, and time to reach an error."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import ttest_ind

from turbogs_plugin.study.results import CellResult, Study

FEWEST_SEEDS = 3
"""Seeds of a variant and of the baseline from which a difference may be called clear."""
NOISE = 0.05
"""A difference is clear where noise alone would make as large a one in a smaller share of cases."""
TARGET_STEP = 0.5
"""dB between the targets of the time to a PSNR. The highest one is what every seed of the baseline reached,
rounded down."""


@dataclass(frozen=True)
class Spread:
    """Mean over `count` seeds, NaN where there is none, and its standard error, NaN for fewer than two."""

    mean: float
    standard_error: float
    count: int

    @classmethod
    def of(cls, values: Iterable[float]) -> Spread:
        """Spread of the seeds' values; NaN or inf in any makes all NaN: means over different seeds do not compare."""
        array = np.array(list(values), dtype=np.float64)  # [S]
        if not len(array) or not np.isfinite(array).all():
            return cls(math.nan, math.nan, len(array))
        error = float(array.std(ddof=1)) / math.sqrt(len(array)) if len(array) > 1 else math.nan
        return cls(float(array.mean()), error, len(array))


@dataclass(frozen=True)
class Difference:
    """A quantity's mean over a variant's seeds minus its mean over the baseline's.

    Seeds are not paired: one seed gives different trainings to two variants, and their results do not correlate.

    Args:
        mean: the difference; NaN where either has no value.
        standard_error: of the difference; NaN where either has fewer than two seeds.
        clear: whether noise alone would seldom make as large a difference (`NOISE`, Welch's t-test); None where either
            has fewer than `FEWEST_SEEDS` seeds.
    """

    mean: float
    standard_error: float
    clear: bool | None

    @classmethod
    def of(cls, own: Sequence[float], base: Sequence[float]) -> Difference:
        first, second = Spread.of(own), Spread.of(base)
        mean, error = first.mean - second.mean, math.hypot(first.standard_error, second.standard_error)
        if min(first.count, second.count) < FEWEST_SEEDS or math.isnan(mean):
            return cls(mean, error, None)
        if error == 0.0:  # the test divides by it
            return cls(mean, error, mean != 0.0)
        return cls(mean, error, bool(ttest_ind(own, base, equal_var=False).pvalue < NOISE))


def seconds_to_reach(curve: Mapping[str, Sequence[float]], level: float) -> float:
    """Seconds of training after which a cell, by its `CellResult.curve`, first reached a PSNR of `level` dB, linear
    between evaluations; inf if never."""
    seconds, values = curve["seconds"], curve["psnr"]
    for place, reached in enumerate(values):
        if reached >= level:
            if place == 0:
                return seconds[0]
            share = (level - values[place - 1]) / (reached - values[place - 1])
            return seconds[place - 1] + share * (seconds[place] - seconds[place - 1])
    return math.inf


def mean_curve(curves: Sequence[Mapping[str, Sequence[float]]], measure: str) -> tuple[np.ndarray, np.ndarray]:
    """Seconds and a measure over seeds: [2, E], their means, and [2, E], their standard errors (0 for one seed).

    Evaluations are paired in their order, as they are at the same shares of a training. Where budgets have given seeds
    different numbers of evaluations, the first ones and the last one are.
    """
    count = min(len(curve["seconds"]) for curve in curves)
    chosen = [*range(count - 1), -1]
    values = np.array([[np.array(curve[name])[chosen] for name in ("seconds", measure)] for curve in curves])
    errors = values.std(axis=0, ddof=1) / math.sqrt(len(curves)) if len(curves) > 1 else np.zeros_like(values[0])
    return values.mean(axis=0), errors


@dataclass(frozen=True)
class VariantRow:
    """The seeds of one variant on one capture, `cells`, and the baseline's, `base`, which may have none here."""

    name: str
    cells: Sequence[CellResult]
    base: Sequence[CellResult]

    def spread(self, measure: str) -> Spread:
        return Spread.of(finals(self.cells, measure))

    def difference(self, measure: str) -> Difference:
        """Difference from the baseline."""
        return Difference.of(finals(self.cells, measure), finals(self.base, measure))

    def ratio(self, measure: str) -> float:
        """Mean over the baseline's mean; NaN where there is none."""
        return self.spread(measure).mean / (Spread.of(finals(self.base, measure)).mean or math.nan)

    def seconds_to(self, psnr: float) -> list[float]:
        """Seconds in which each seed reached a PSNR in dB; inf where it never did."""
        return [seconds_to_reach(cell.curve, psnr) for cell in self.cells]

    def ratio_to(self, psnr: float) -> float:
        """Mean `seconds_to` over the baseline's; NaN where a seed of either never reached it, or began there."""
        base = Spread.of(seconds_to_reach(cell.curve, psnr) for cell in self.base).mean
        own = Spread.of(self.seconds_to(psnr)).mean
        return own / base if base > 0 and own > 0 else math.nan


def finals(cells: Sequence[CellResult], measure: str) -> list[float]:
    """A measure of `CellResult.final`, for each seed; NaN where a seed lacks it."""
    return [cell.final.get(measure, math.nan) for cell in cells]


@dataclass
class SceneSummary:
    """All variants on one capture, in the order of the ablation; `baseline` is "" where that has no result here.
    `targets`: PSNRs in dB whose time is asked for."""

    scene: str
    baseline: str
    targets: list[float]
    rows: list[VariantRow]


def summarise(study: Study) -> list[SceneSummary]:
    """Rows of each capture, with targets by the baseline's result."""
    summaries = []
    for scene in study.scenes:
        cells = {name: results for name in study.ablation.variants if (results := study.of(scene, name))}
        baseline = study.ablation.baseline if study.ablation.baseline in cells else ""
        rows = [VariantRow(name, results, cells.get(baseline, [])) for name, results in cells.items()]
        reached = min(finals(rows[0].base or rows[0].cells, "psnr"))
        steps = (2, 1, 0) if math.isfinite(reached) else ()
        targets = [math.floor(10 * reached) / 10 - step * TARGET_STEP for step in steps]
        summaries.append(SceneSummary(scene, baseline, targets, rows))
    return summaries
