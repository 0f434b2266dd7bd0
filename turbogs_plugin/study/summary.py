"""From cells to rows of a table: each variant over its seeds, beside the baseline."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from turbogs_plugin.study.results import Study
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


def summarise(study: Study, targets: Sequence[float] = ()) -> list[SceneSummary]:
    """The rows of each scene.

    Args:
        targets: PSNRs whose time is asked for; none: the baseline's result, and `TARGET_STEP` and twice that below it.
    """
    return [_summarise_scene(study, scene, targets) for scene in study.scenes]


def _summarise_scene(study: Study, scene: str, targets: Sequence[float]) -> SceneSummary:
    cells = {name: study.of(scene, name) for name in study.ablation.variants}
    cells = {name: results for name, results in cells.items() if results}
    baseline = study.ablation.baseline if study.ablation.baseline in cells else ""
    if not targets:
        reference = cells[baseline] if baseline else next(iter(cells.values()))
        result = Spread.of(cell.final.psnr for cell in reference).low
        targets = [math.floor(10 * result) / 10 - step * TARGET_STEP for step in (2, 1, 0)]
    times = {
        name: [Spread.of(seconds_to_reach(cell.history, psnr) for cell in results) for psnr in targets]
        for name, results in cells.items()
    }
    reference = cells.get(baseline, [])
    reference_psnr, reference_seconds = (
        Spread.of(getattr(cell.final, name) for cell in reference) for name in ("psnr", "train_seconds")
    )
    rows = []
    for name, results in cells.items():
        psnr, seconds = (
            Spread.of(getattr(cell.final, field) for cell in results) for field in ("psnr", "train_seconds")
        )
        reaches = []
        for number, target in enumerate(targets):
            spread = times[name][number]
            against = times[baseline][number].mean if baseline else math.nan
            ratio = spread.mean / against if against > 0 else math.nan
            reached = sum(math.isfinite(seconds_to_reach(cell.history, target)) for cell in results)
            reaches.append(Reach(target, spread, reached, ratio if 0 < ratio < math.inf else math.nan))
        rows.append(
            VariantRow(
                name=name,
                seeds=[cell.seed for cell in results],
                seconds=seconds,
                psnr=psnr,
                worst_psnr=Spread.of(cell.final.worst_psnr for cell in results),
                ssim=Spread.of(cell.final.ssim for cell in results),
                l1=Spread.of(cell.final.l1 for cell in results),
                lpips=Spread.of(cell.lpips for cell in results),
                gaussians=Spread.of(cell.final.num_gaussians for cell in results),
                fps=Spread.of(cell.fps for cell in results),
                peak_bytes=Spread.of(math.nan if cell.peak_bytes is None else cell.peak_bytes for cell in results),
                iterations=[cell.final.iteration for cell in results if cell.time_budget],
                psnr_difference=psnr.mean - reference_psnr.mean,
                psnr_differs=differ(psnr, reference_psnr),
                seconds_differ=differ(seconds, reference_seconds),
                reaches=reaches,
                on_front=False,
                psnr_curve=Curve.of([cell.history for cell in results], "psnr"),
                l1_curve=Curve.of([cell.history for cell in results], "l1"),
            )
        )
    for row, on_front in zip(rows, pareto_front([(row.seconds.mean, row.psnr.mean) for row in rows]), strict=True):
        row.on_front = on_front
    return SceneSummary(scene, baseline, list(targets), rows)
