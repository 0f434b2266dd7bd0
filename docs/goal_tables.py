"""Tables of the goals: what is reached of them (docs/comparison.md), and what rounds of sweeps tried for the rest
(docs/results/sweeps.md)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import sweep_tables
from study_tables import CAPTURES, read_peers, rows_of, size_text

from turbogs_plugin.report.tables import table
from turbogs_plugin.study.statistics import Difference
from turbogs_plugin.study.summary import VariantRow


class Goal(NamedTuple):
    """What one variant of `sizes` should reach on one capture.

    Args:
        name: of the goal.
        psnr, ssim: in dB, and of 1: at least this; None: no goal.
        seconds, gaussians: at most this.
        times: seconds, at most as many times those of `turbogs`.
    """

    name: str
    capture: str
    variant: str
    psnr: float | None = None
    ssim: float | None = None
    seconds: float | None = None
    gaussians: float | None = None
    times: float | None = None


FIRST = "`turbogs`: half of the Gaussians of 12f5e04, at its errors and seconds"
STRUCTURE = "`turbogs-ssim`: .005 more SSIM than any other method here, in 1.6 times the seconds"

FIRST_GOALS = (
    Goal(FIRST, "fox", "turbogs", 32.20, 0.893, 4.1, 104_500),
    Goal(FIRST, "caliterra", "turbogs", 33.55, 0.928, 6.2, 332_000),
    Goal(FIRST, "snowmiku", "turbogs", 29.31, 0.891, 6.0, 94_500),
)

LITEGS = "a cap at LiteGS's number: .1 dB more, its SSIM, in an eighth of its seconds"
FASTGS = "a cap at FastGS's number: .3 dB more, its SSIM, in a twentieth of its seconds"

BY_PEERS = (
    (LITEGS, "LiteGS 004b952, 10,000 iterations, small", 0.1, 8, {"fox": "cap-94k", "caliterra": "cap-157k"}),
    (
        FASTGS,
        "FastGS 44e02a5, 30,000 iterations",
        0.3,
        20,
        {"fox": "cap-67k", "caliterra": "cap-157k", "snowmiku": "cap-57k"},
    ),
)
"""Name of a goal, method of peers.json, dB more than it, how many times sooner, capture -> variant."""


def all_goals() -> list[Goal]:
    """In the order of the table."""
    peers = {(row["method"], row["capture"]): row for row in read_peers()["rows"]}
    of_caps = []
    for name, method, more, sooner, variants in BY_PEERS:
        for capture, variant in variants.items():
            row = peers[method, capture]
            of_caps.append(Goal(name, capture, variant, row["psnr"] + more, row["ssim"], row["seconds"] / sooner))
    best = {capture: max(row["ssim"] or 0.0 for (_, of), row in peers.items() if of == capture) for capture in CAPTURES}
    structure = [Goal(STRUCTURE, capture, "ssim", ssim=ssim + 0.005, times=1.6) for capture, ssim in best.items()]
    return [*FIRST_GOALS, *of_caps, *structure]


class Tried(NamedTuple):
    """A change that a round of sweeps measured for what is missing.

    Args:
        what: the change.
        round, table, row: where its cells stand in docs/results/sweeps.
    """

    what: str
    round: str
    table: str
    row: str


HALF = "twice the batch, the same moments, half of the iterations"

MISSING = {
    ("fox", "psnr", "PSNR on fox at 94k"): (
        Tried("steps of untouched Gaussians, as LiteGS has them", "twenty-sixth", "dense_94k", "dense steps"),
        Tried("no bound on far sizes", "twenty-seventh", "bound_94k", "no bound"),
        Tried("31 epochs, not 28", "thirtieth", "small_94k", "31 epochs for 28"),
        Tried("34 epochs", "thirtieth", "small_94k", "34 epochs"),
        Tried("no final pruning", "thirtieth", "small_94k", "no final pruning"),
    ),
    ("caliterra", "ssim", "SSIM of `turbogs-ssim` on caliterra"): (
        Tried("photos blurred at first", "twenty-second", "screen", "blurred photos in the first fifth"),
        Tried("no turnover, no final pruning", "twenty-second", "screen", "no turnover, no final pruning"),
        Tried("higher bands of harmonics decay", "twenty-second", "screen", "higher bands decay"),
        Tried("points where photos have none", "twenty-fourth", "structure", "with 32 cells"),
        Tried("a narrower blur of splats", "twenty-fifth", "blur_structure", "a blur of 0.1"),
        Tried("refined training cameras", "twenty-fifth", "refined_structure", "training cameras refined"),
        Tried("75 epochs, not 60", "twenty-eighth", "structure", "75 epochs for 60"),
        Tried("moments that forget sooner", "twenty-ninth", "structure", "moments that forget twice as fast"),
        Tried("twice the batch", "twenty-ninth", "structure", HALF),
        Tried("58 epochs", "thirtieth", "structure", "58 epochs for 60"),
    ),
}
"""(capture, measure, what is missing) -> what was tried for it."""


def goals() -> str:
    """Each goal beside what is measured, errors with their standard error over seeds, and what is missing."""
    lines = []
    for goal in all_goals():
        row = rows_of("sizes")[goal.capture][goal.variant]
        limit = goal.times and goal.times * rows_of("sizes")[goal.capture]["turbogs"].spread("seconds").mean
        parts = [
            error("psnr", goal.psnr, row, 2, " dB"),
            error("ssim", goal.ssim, row, 4, ""),
            most(goal.seconds or limit, row.spread("seconds").mean, "{:.2f} s".format),
            most(goal.gaussians, row.spread("gaussians").mean, size_text),
        ]
        columns = ("<br>".join(filter(None, column)) for column in zip(*parts, strict=True))
        lines.append((goal.name, goal.capture, *columns))
    return table(("goal", "capture", "at least, or at most", "measured", "missing"), lines)


def error(measure: str, least: float | None, row: VariantRow, digits: int, unit: str) -> tuple[str, str, str]:
    """A goal, the measured mean with its standard error, and what is missing; of an error that should be high."""
    if least is None:
        return ("", "", "")
    over = Difference.of([getattr(cell.final, measure) for cell in row.cells])
    gap = least - over.mean
    return (
        f"{number(least, min(digits, 3))}{unit}",
        f"{number(over.mean, digits)} ± {number(over.standard_error, digits)}{unit}",
        f"{number(gap, digits)}{unit}" if gap > 0 else "",
    )


def most(limit: float | None, value: float, text: Callable[[float], str]) -> tuple[str, str, str]:
    """The same of a quantity that should be low."""
    if limit is None:
        return ("", "", "")
    return (text(limit), text(value), text(value - limit) if value > limit else "")


def number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}".removeprefix("0")


def tried() -> str:
    """What rounds changed for what is missing, with the difference by seed and its standard error."""
    lines = []
    for (capture, measure, missing), changes in MISSING.items():
        for change in changes:
            difference = sweep_tables.difference_of(change.round, change.table, change.row, capture, measure)
            digits, unit = (2, " dB") if measure == "psnr" else (4, "")
            spread = "" if math.isnan(difference.standard_error) else f" ± {number(difference.standard_error, digits)}"
            told = f"{difference.mean:+.{digits}f}".replace("0.", ".") + f"{spread}{unit} ({difference.count})"
            page = f"[{change.round}](sweeps/{change.round}.md)"
            lines.append((missing, change.what, told, page))
    return table(("what is missing", "what was tried", "what it gained", "round"), lines)
