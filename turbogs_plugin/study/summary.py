"""From cells to rows of a table: each variant over its seeds, beside the baseline."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from turbogs_plugin.study.results import CellResult, Study
from turbogs_plugin.study.statistics import Curve, Spread, differ, pareto_front, seconds_to_reach

TARGET_STEP = 0.5
"""Default targets of the time to a PSNR are this many dB apart, from what every seed of the baseline reached down."""


@dataclass
class Reach:
    """Time to reach a PSNR.

    Args:
        psnr: in dB.
        seconds: over seeds; inf where a seed never reached it.
        reached: seeds that did.
        ratio: mean seconds over the baseline's; NaN where one of the two did not reach it with every seed, or began
            there.
    """

    psnr: float
    seconds: Spread
    reached: int
    ratio: float


@dataclass
class VariantRow:
    """One variant on one scene.

    Args:
        name: of the variant.
        seconds, psnr, worst_psnr, ssim, l1, lpips, gaussians, fps, peak_bytes: over seeds; NaN where not computed or
            not measured.
        iterations: of the seeds, where a time budget decided them, else empty.
        psnr_difference: mean PSNR minus the baseline's.
        psnr_differs, seconds_differ: whether the seeds' spreads are apart from the baseline's; None where that is open.
        reaches: time to each target.
        on_front: no other variant is at least as fast and as good.
        psnr_curve, l1_curve: against seconds.
    """

    name: str
    seeds: list[int]
    seconds: Spread
    psnr: Spread
    worst_psnr: Spread
    ssim: Spread
    l1: Spread
    lpips: Spread
    gaussians: Spread
    fps: Spread
    peak_bytes: Spread
    iterations: list[int]
    psnr_difference: float
    psnr_differs: bool | None
    seconds_differ: bool | None
    reaches: list[Reach]
    on_front: bool
    psnr_curve: Curve
    l1_curve: Curve


@dataclass
class SceneSummary:
    """All variants on one scene, in the order of the ablation.

    Args:
        baseline: name of the variant that the others are compared with, or "" where it has no result here.
    """

    scene: str
    baseline: str
    targets: list[float]
    rows: list[VariantRow]

    def row(self, name: str) -> VariantRow | None:
        return next((row for row in self.rows if row.name == name), None)


def summarise(study: Study) -> list[SceneSummary]:
    """The rows of each scene."""
    return [_summarise_scene(study, scene) for scene in study.scenes]


def _summarise_scene(study: Study, scene: str) -> SceneSummary:
    cells = {name: results for name in study.ablation.variants if (results := study.of(scene, name))}
    baseline = study.ablation.baseline if study.ablation.baseline in cells else ""
    targets = study.targets or _default_targets(cells[baseline] if baseline else next(iter(cells.values())))
    rows = [_row(name, results, cells.get(baseline, []), targets) for name, results in cells.items()]
    for row, on_front in zip(rows, pareto_front([(row.seconds.mean, row.psnr.mean) for row in rows]), strict=True):
        row.on_front = on_front
    return SceneSummary(scene, baseline, targets, rows)


def _default_targets(reference: Sequence[CellResult]) -> list[float]:
    """What every seed of these reached, rounded down, and `TARGET_STEP` and twice that below it."""
    reached = _spread(reference, "psnr").low
    return [math.floor(10 * reached) / 10 - step * TARGET_STEP for step in (2, 1, 0)]


def _row(name: str, results: Sequence[CellResult], base: Sequence[CellResult], targets: Sequence[float]) -> VariantRow:
    psnr, seconds = _spread(results, "psnr"), _spread(results, "train_seconds")
    base_psnr, base_seconds = _spread(base, "psnr"), _spread(base, "train_seconds")
    return VariantRow(
        name=name,
        seeds=[cell.seed for cell in results],
        seconds=seconds,
        psnr=psnr,
        worst_psnr=_spread(results, "worst_psnr"),
        ssim=_spread(results, "ssim"),
        l1=_spread(results, "l1"),
        lpips=Spread.of(cell.lpips for cell in results),
        gaussians=_spread(results, "num_gaussians"),
        fps=Spread.of(cell.fps for cell in results),
        peak_bytes=Spread.of(math.nan if cell.peak_bytes is None else cell.peak_bytes for cell in results),
        iterations=[cell.final.iteration for cell in results if cell.time_budget],
        psnr_difference=psnr.mean - base_psnr.mean,
        psnr_differs=differ(psnr, base_psnr),
        seconds_differ=differ(seconds, base_seconds),
        reaches=[_reach(results, base, target) for target in targets],
        on_front=False,
        psnr_curve=Curve.of([cell.history for cell in results], "psnr"),
        l1_curve=Curve.of([cell.history for cell in results], "l1"),
    )


def _spread(results: Sequence[CellResult], measure: str) -> Spread:
    """Of a field of `Evaluation`, at the final models."""
    return Spread.of(getattr(cell.final, measure) for cell in results)


def _reach(results: Sequence[CellResult], base: Sequence[CellResult], target: float) -> Reach:
    times, base_times = ([seconds_to_reach(cell.history, target) for cell in cells] for cells in (results, base))
    seconds, against = Spread.of(times), Spread.of(base_times).mean
    ratio = seconds.mean / against if against > 0 else math.nan
    reached = sum(map(math.isfinite, times))
    return Reach(target, seconds, reached, ratio if 0 < ratio < math.inf else math.nan)
