"""Numbers over seeds: means and spreads, differences, time to reach an error, and the Pareto front."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from turbogs_plugin.train.history import Evaluation


@dataclass(frozen=True)
class Spread:
    """A quantity over seeds.

    Args:
        mean, low, high: of the seeds' values; NaN where there is none.
        count: seeds.
    """

    mean: float
    low: float
    high: float
    count: int

    @classmethod
    def of(cls, values: Iterable[float | None]) -> Spread:
        """NaN or None in any makes all NaN: a mean over some seeds would be compared with means over all."""
        values = list(values)
        if not values or any(value is None or math.isnan(value) for value in values):
            return cls(math.nan, math.nan, math.nan, len(values))
        return cls(math.fsum(values) / len(values), min(values), max(values), len(values))


T95 = (12.71, 4.30, 3.18, 2.78, 2.57, 2.45, 2.36, 2.31, 2.26, 2.23)
"""Student's t of 1 .. 10 degrees of freedom: standard errors within which 95 % of means of pure noise lie."""


@dataclass(frozen=True)
class Difference:
    """A quantity minus the baseline's, seed by seed: both ran with the same seed, so that what it decides cancels.

    Args:
        mean: over the seeds that both have; NaN where there is none.
        standard_error: of the mean; NaN for fewer than two seeds.
        count: seeds.
    """

    mean: float
    standard_error: float
    count: int

    @classmethod
    def of(cls, values: Sequence[float]) -> Difference:
        """Of the differences of each seed."""
        count = len(values)
        mean = math.fsum(values) / count if count else math.nan
        squares = math.fsum((value - mean) ** 2 for value in values)
        return cls(mean, math.sqrt(squares / (count - 1) / count) if count > 1 else math.nan, count)

    @property
    def clear(self) -> bool | None:
        """Whether noise alone would make so much in less than one case of twenty; None for one seed."""
        if math.isnan(self.standard_error):
            return None
        return abs(self.mean) > T95[min(self.count - 1, len(T95)) - 1] * self.standard_error


def seconds_to_reach(history: Sequence[Evaluation], level: float, measure: str = "psnr") -> float:
    """Seconds of training after which a run first reached this test PSNR, linear between evaluations; inf if never.

    Args:
        measure: another one that rises: ``ssim``.
    """
    for before, after in zip([None, *history], history, strict=False):
        reached = getattr(after, measure)
        if reached >= level:
            if before is None:
                return after.train_seconds
            earlier = getattr(before, measure)
            share = (level - earlier) / (reached - earlier)
            return before.train_seconds + share * (after.train_seconds - before.train_seconds)
    return math.inf


def crossing_gap(history: Sequence[Evaluation], psnr: float) -> float:
    """Seconds of training between the evaluations on either side of the moment of `seconds_to_reach`; NaN where a run
    never reached it, or began there."""
    for before, after in itertools.pairwise(history):
        if before.psnr >= psnr:
            break
        if after.psnr >= psnr:
            return after.train_seconds - before.train_seconds
    return math.nan


@dataclass(frozen=True)
class Curve:
    """One measure against seconds over seeds, at the iterations that every seed evaluated.

    Args:
        seconds: [E] mean over seeds.
        mean, low, high: [E] of the measure.
    """

    seconds: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, histories: Sequence[Sequence[Evaluation]], name: str) -> Curve:
        """The curve of a field of `Evaluation`. If a time budget ended seeds at different iterations, evaluations are
        paired in order when all seeds have as many, as they are at the same fractions of it; else their ends are."""
        common = set.intersection(*({entry.iteration for entry in history} for history in histories))
        rows = [[entry for entry in history if entry.iteration in common] for history in histories]
        if any(history[-1].iteration not in common for history in histories):
            rows = [[*row, history[-1]] for row, history in zip(rows, histories, strict=True)]
            if len({len(history) for history in histories}) == 1:
                rows = histories
        values = np.array([[getattr(entry, name) for entry in row] for row in rows])  # [seeds, E]
        seconds = np.array([[entry.train_seconds for entry in row] for row in rows])
        return cls(seconds.mean(axis=0), values.mean(axis=0), values.min(axis=0), values.max(axis=0))


def pareto_front(points: Sequence[tuple[float, float]]) -> list[bool]:
    """For each (seconds, quality) whether no other is at least as fast and as good, and better in one of the two.

    A point with NaN is not on the front and keeps no other point from it, as no comparison with NaN is true.
    """

    def beaten(point: tuple[float, float]) -> bool:
        return any(other[0] <= point[0] and other[1] >= point[1] and other != point for other in points)

    return [not math.isnan(sum(point)) and not beaten(point) for point in points]
