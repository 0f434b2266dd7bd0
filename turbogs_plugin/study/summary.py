"""From cells to rows of a table: each variant over its seeds, beside the baseline."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter

from turbogs_plugin.study.results import CellResult, Study
from turbogs_plugin.study.statistics import Curve, Difference, Spread, pareto_front, seconds_to_reach

TARGET_STEP = 0.5
"""dB between the default targets of the time to a PSNR. The highest one is what every seed of the baseline reached,
rounded down."""

CELL_VALUES = {
    "seconds": attrgetter("final.train_seconds"),
    "wall_seconds": attrgetter("wall_seconds"),
    "cell_seconds": attrgetter("cell_seconds"),
    "psnr": attrgetter("final.psnr"),
    "worst_psnr": attrgetter("final.worst_psnr"),
    "ssim": attrgetter("final.ssim"),
    "l1": attrgetter("final.l1"),
    "refined_psnr": attrgetter("final.refined_psnr"),
    "refined_ssim": attrgetter("final.refined_ssim"),
    "lpips": attrgetter("lpips"),
    "flip": attrgetter("flip"),
    "gaussians": attrgetter("final.num_gaussians"),
    "fps": attrgetter("fps"),
    "peak_bytes": attrgetter("peak_bytes"),
}
"""What is compared: name -> its value in a `CellResult`, at the final model."""


@dataclass(eq=False)
class VariantRow:
    """One variant on one scene, measured over its seeds and compared with the baseline.

    Args:
        name: of the variant.
        cells: its seeds' results.
        base: the baseline's results; none where it has none here.
        on_front: whether no other variant is at least as fast and as good.
    """

    name: str
    cells: Sequence[CellResult]
    base: Sequence[CellResult]
    on_front: bool = False

    @property
    def seconds(self) -> Spread:
        return self.spread("seconds")

    @property
    def psnr(self) -> Spread:
        return self.spread("psnr")

    def spread(self, measure: str) -> Spread:
        """The spread of one of `CELL_VALUES` over the seeds; NaN if a seed lacks it."""
        return Spread.of(map(CELL_VALUES[measure], self.cells))

    def difference(self, measure: str) -> Difference:
        """From the baseline, over the seeds that both have."""
        return Difference.of([own - base for own, base in self._pairs(CELL_VALUES[measure])])

    def ratio(self, measure: str) -> float:
        """The mean over the baseline's mean, both over the seeds that both have; NaN where there is none."""
        own, base = self._means(CELL_VALUES[measure])
        return own / base

    def curve(self, name: str) -> Curve:
        """The curve of a field of `Evaluation` against seconds."""
        return Curve.of([cell.history for cell in self.cells], name)

    def seconds_to(self, psnr: float) -> list[float]:
        """For each seed, the seconds in which it reached this PSNR in dB; inf where it never did."""
        return [seconds_to_reach(cell.history, psnr) for cell in self.cells]

    def ratio_to(self, psnr: float) -> float:
        """Mean `seconds_to` over the baseline's, both over the seeds that both have; NaN where one of these never
        reached it, or began there."""
        own, base = self._means(lambda cell: seconds_to_reach(cell.history, psnr))
        ratio = own / base if base > 0 else math.nan
        return ratio if 0 < ratio < math.inf else math.nan

    def _pairs(self, value: Callable[[CellResult], float]) -> list[tuple[float, float]]:
        """(own, baseline's) of every seed that both have."""
        base = {cell.seed: value(cell) for cell in self.base}
        return [(value(cell), base[cell.seed]) for cell in self.cells if cell.seed in base]

    def _means(self, value: Callable[[CellResult], float]) -> tuple[float, float]:
        pairs = self._pairs(value)
        return Spread.of(own for own, _ in pairs).mean, Spread.of(base for _, base in pairs).mean


@dataclass
class SceneSummary:
    """All variants on one scene, in the order of the ablation.

    Args:
        baseline: name of the variant that the others are compared with, or "" where it has no result here.
        targets: PSNRs in dB whose time is asked for.
    """

    scene: str
    baseline: str
    targets: list[float]
    rows: list[VariantRow]


def summarise(study: Study) -> list[SceneSummary]:
    """The rows of each scene."""
    return [_summarise_scene(study, scene) for scene in study.scenes]


def _summarise_scene(study: Study, scene: str) -> SceneSummary:
    cells = {name: results for name in study.ablation.variants if (results := study.of(scene, name))}
    baseline = study.ablation.baseline if study.ablation.baseline in cells else ""
    rows = [VariantRow(name, results, cells.get(baseline, [])) for name, results in cells.items()]
    points = [(row.seconds.mean, row.psnr.mean) for row in rows]
    for row, on_front in zip(rows, pareto_front(points), strict=True):
        row.on_front = on_front
    reached = next((row for row in rows if row.name == baseline), rows[0]).psnr.low  # by every seed
    targets = study.targets or [math.floor(10 * reached) / 10 - step * TARGET_STEP for step in (2, 1, 0)]
    return SceneSummary(scene, baseline, targets, rows)
