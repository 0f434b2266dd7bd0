"""Plots of a study: error over run time, and error over the number of Gaussians, of every variant and capture."""

from __future__ import annotations

import io
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from turbogs_plugin.files import write_atomically
from turbogs_plugin.report.curves import SECONDS_LABEL, STYLE
from turbogs_plugin.study.statistics import SceneSummary, VariantRow, mean_curve, pareto_front

COLORS = ("#1f5fa8", "#d1495b", "#2e8b57", "#e08e0b", "#7a4fa3", "#17919e", "#8c5a3c", "#5c6670")
DASHES, MARKERS = ("-", "--", ":", "-."), ("o", "s", "^", "D")
BASELINE_COLOR = "black"
LABELS = {"psnr": "test PSNR in dB", "ssim": "test SSIM"}
"""Column of a cell's curve -> label of its axis."""
SHOWN_BELOW = {"psnr": 4.0, "ssim": 0.06}
"""An axis begins this far below the worst final result: trainings pass what is below in a moment."""
FAILED_BELOW = 8.0
"""A variant that ends this many dB below the best one has failed: it does not set the axes' scale."""
PALETTE = 128
"""Colours of a plot's PNG: a third of the bytes, and no difference that can be seen."""


def write_plots(folder: Path, summaries: Sequence[SceneSummary]) -> None:
    """Draw each of `PLOTS` into a folder."""
    for name, (_, draw) in PLOTS.items():
        with matplotlib.rc_context(dict[Any, Any](STYLE)):  # also while it is saved, where ticks get their labels
            save_plot(folder / name, draw(summaries))


def save_plot(path: Path, figure: Figure) -> None:
    """Write a figure as a PNG of few colours."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png")
    picture = Image.open(drawn).convert("RGB").quantize(PALETTE, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    write_atomically(path, lambda file: picture.save(file, "PNG", optimize=True))


def _styles(summaries: Sequence[SceneSummary]) -> dict[str, tuple[str, str, str]]:
    """Variant -> (colour, dash, marker), one in all captures; black for the baseline."""
    names = dict.fromkeys(row.name for summary in summaries for row in summary.rows)
    baselines = {summary.baseline for summary in summaries}
    combinations = itertools.cycle((color, *line) for line in zip(DASHES, MARKERS, strict=True) for color in COLORS)
    return {name: (BASELINE_COLOR, "-", "o") if name in baselines else next(combinations) for name in names}


def shown_rows(summary: SceneSummary) -> list[VariantRow]:
    """Variants that did not fail, which set the scale of a capture's axes."""
    best = max(row.spread("psnr").mean for row in summary.rows)
    return [row for row in summary.rows if not row.spread("psnr").mean < best - FAILED_BELOW]  # NaN is shown


def draw_over_time(summaries: Sequence[SceneSummary]) -> Figure:
    """PSNR and SSIM against seconds: a row a capture; mean over seeds, the standard error shaded."""
    styles = _styles(summaries)
    figure = Figure(figsize=(12.0, 0.6 + 4.2 * len(summaries)), layout="constrained")
    for summary, pair in zip(summaries, figure.subplots(len(summaries), 2, squeeze=False), strict=True):
        for axes, measure in zip(pair, LABELS, strict=True):
            for row in shown_rows(summary):
                (seconds, values), (_, errors) = mean_curve([cell.curve for cell in row.cells], measure)
                color, dash, marker = styles[row.name]
                axes.plot(seconds, values, dash, marker=marker, markersize=3.5, color=color, label=row.name)
                axes.fill_between(seconds, values - errors, values + errors, color=color, alpha=0.15, linewidth=0)
            ends = [row.spread(measure).mean for row in shown_rows(summary)]
            floor = np.nanmin([*ends, np.inf]) - SHOWN_BELOW[measure]
            axes.set(xlabel=SECONDS_LABEL, ylabel=LABELS[measure], title=summary.scene)
            axes.set_xlim(left=0)
            if np.isfinite(floor):
                axes.set_ylim(bottom=max(floor, axes.get_ylim()[0]))
    return _with_legend(figure)


def draw_over_size(summaries: Sequence[SceneSummary]) -> Figure:
    """Final PSNR against the number of Gaussians: a panel a capture; standard errors; the front as a line."""
    styles = _styles(summaries)
    figure = Figure(figsize=(2.4 + 4.8 * len(summaries), 4.6), layout="constrained")
    for summary, axes in zip(summaries, figure.subplots(1, len(summaries), squeeze=False)[0], strict=True):
        points = []
        for row in shown_rows(summary):
            size, psnr = row.spread("gaussians"), row.spread("psnr")
            points.append((size.mean, psnr.mean))
            color, _, marker = styles[row.name]
            errors = np.nan_to_num([[size.standard_error], [psnr.standard_error]])
            axes.errorbar(*points[-1], errors[1], errors[0], fmt=marker, color=color, label=row.name, elinewidth=1.0)
        _draw_front(axes, points)
        axes.set(xlabel="Gaussians of the final model", ylabel=LABELS["psnr"], title=summary.scene)
        axes.margins(x=0.15, y=0.12)
    return _with_legend(figure)


def _draw_front(axes: Axes, points: list[tuple[float, float]]) -> None:
    front = sorted(point for point, on_front in zip(points, pareto_front(points), strict=True) if on_front)
    steps = np.reshape(front, (-1, 2)).T  # [2, variants], also of none
    axes.step(*steps, where="post", color="grey", linewidth=1.2, zorder=0)


def _with_legend(figure: Figure) -> Figure:
    """The figure with one legend of all variants beside it."""
    named: dict[str, Any] = {}
    for axes in figure.axes:
        handles, labels = axes.get_legend_handles_labels()
        named |= dict(zip(labels, handles, strict=True))
    figure.legend(list(named.values()), list(named), loc="outside right upper", frameon=False, fontsize=9)
    return figure


PLOTS = {
    "error-over-time.png": ("Error over run time: PSNR and SSIM against seconds of training", draw_over_time),
    "error-over-size.png": ("Error over size: final PSNR against the number of Gaussians", draw_over_size),
}
"""File of a plot -> what it shows, and the function that draws it."""
