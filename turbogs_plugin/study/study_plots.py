"""Plot of a study: error over run time, of every variant and capture."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from turbogs_plugin.files import write_atomically
from turbogs_plugin.report.curves import SECONDS_LABEL, STYLE
from turbogs_plugin.study.statistics import SceneSummary, VariantRow, mean_curve

PLOT = "error-over-time.png"
DASHES = ("-", "--", ":", "-.")
BASELINE_COLOR = "black"
LABELS = {"psnr": "test PSNR in dB", "ssim": "test SSIM"}
"""Column of a cell's curve -> label of its axis."""
SHOWN_BELOW = {"psnr": 4.0, "ssim": 0.06}
"""An axis begins this far below the worst final result: trainings pass what is below in a moment."""
MOST_CAPTURES = 24
"""Captures that are drawn; tables have all."""
FAILED_BELOW = 8.0
"""A variant that ends this many dB below the best one has failed: it does not set the axes' scale."""


def write_plot(folder: Path, summaries: Sequence[SceneSummary]) -> None:
    """Draw `PLOT` into a folder."""
    with matplotlib.rc_context(STYLE):  # also while it is saved, where ticks get their labels
        figure = draw_over_time(summaries)
        write_atomically(folder / PLOT, lambda file: figure.savefig(file, format="png"))


def _styles(summaries: Sequence[SceneSummary]) -> dict[str, tuple[str, str]]:
    """Variant -> (colour, dash), one in all captures; black for the baseline."""
    names = dict.fromkeys(row.name for summary in summaries for row in summary.rows)
    baselines = {summary.baseline for summary in summaries}
    combinations = itertools.cycle((f"C{color}", dash) for dash in DASHES for color in range(10))
    return {name: (BASELINE_COLOR, "-") if name in baselines else next(combinations) for name in names}


def shown_rows(summary: SceneSummary) -> list[VariantRow]:
    """Variants that did not fail, which set the scale of a capture's axes."""
    best = max(row.spread("psnr").mean for row in summary.rows)
    return [row for row in summary.rows if not row.spread("psnr").mean < best - FAILED_BELOW]  # NaN is shown


def draw_over_time(summaries: Sequence[SceneSummary]) -> Figure:
    """PSNR and SSIM against seconds: a row a capture; mean over seeds, the standard error shaded."""
    summaries = summaries[:MOST_CAPTURES]
    styles = _styles(summaries)
    figure = Figure(figsize=(12.0, 0.6 + 4.2 * len(summaries)), layout="constrained")
    for summary, pair in zip(summaries, figure.subplots(len(summaries), 2, squeeze=False), strict=True):
        for axes, measure in zip(pair, LABELS, strict=True):
            for row in shown_rows(summary):
                (seconds, values), (_, errors) = mean_curve([cell.curve for cell in row.cells], measure)
                color, dash = styles[row.name]
                axes.plot(seconds, values, dash, marker="o", markersize=3.5, color=color, label=row.name)
                axes.fill_between(seconds, values - errors, values + errors, color=color, alpha=0.15, linewidth=0)
            ends = [row.spread(measure).mean for row in shown_rows(summary)]
            floor = np.nanmin([*ends, np.inf]) - SHOWN_BELOW[measure]
            axes.set(xlabel=SECONDS_LABEL, ylabel=LABELS[measure], title=summary.scene)
            axes.set_xlim(left=0)
            if np.isfinite(floor):
                axes.set_ylim(bottom=max(floor, axes.get_ylim()[0]))
    named: dict[str, Any] = {}
    for axes in figure.axes:
        handles, labels = axes.get_legend_handles_labels()
        named |= dict(zip(labels, handles, strict=True))
    figure.legend(list(named.values()), list(named), loc="outside right upper", frameon=False, fontsize=9)
    return figure
