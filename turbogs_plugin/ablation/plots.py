"""Pictures of a study: error against seconds of every variant in one plot, and the Pareto front."""

from __future__ import annotations

import itertools
from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from turbogs_plugin.ablation.summary import SceneSummary, VariantRow
from turbogs_plugin.report.plots import STYLE

COLORS = ("#1f5fa8", "#d1495b", "#2e8b57", "#e08e0b", "#7a4fa3", "#17919e", "#8c5a3c", "#5c6670")
DASHES = ("-", "--", ":", "-.")
BASELINE_COLOR = "black"
SHOWN_BELOW = 4.0
"""dB below the worst final result at which the PSNR plot ends: what comes before is over in a moment."""


def _styles(summary: SceneSummary) -> dict[str, tuple[str, str]]:
    """Variant -> (colour, dash): black for the baseline, else one of each combination."""
    combinations = ((color, dash) for dash, color in itertools.product(DASHES, COLORS))
    return {
        row.name: (BASELINE_COLOR, "-") if row.name == summary.baseline else style
        for row, style in zip(summary.rows, itertools.cycle(combinations), strict=False)
    }


def plot_curves(path: Path, summary: SceneSummary) -> None:
    """PSNR and mean absolute error against seconds: mean over seeds, their spread shaded."""
    styles = _styles(summary)
    with matplotlib.rc_context({**STYLE, "lines.markersize": 3.5}):
        figure = Figure(figsize=(12.0, 5.2 + 0.16 * max(0, len(summary.rows) - 8)), layout="constrained")
        for axes, name in zip(figure.subplots(1, 2), ("psnr", "l1"), strict=True):
            for row in summary.rows:
                curve = getattr(row, f"{name}_curve")
                color, dash = styles[row.name]
                axes.plot(curve.seconds, curve.mean, dash, marker="o", color=color, label=row.name)
                if row.psnr.count > 1:
                    axes.fill_between(curve.seconds, curve.low, curve.high, color=color, alpha=0.15, linewidth=0)
            axes.set_xlabel("training time in seconds (evaluation excluded)")
            axes.set_xlim(left=0)
        psnr_axes, l1_axes = figure.axes
        floor = min(row.psnr.mean for row in summary.rows) - SHOWN_BELOW
        psnr_axes.set(ylabel="test PSNR in dB", title=f"{summary.scene}: PSNR")
        psnr_axes.set_ylim(bottom=max(floor, psnr_axes.get_ylim()[0]))
        l1_axes.set(ylabel="mean absolute error on test views (0 .. 1)", title="mean absolute error", yscale="log")
        l1_axes.yaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%.3f"))
        l1_axes.yaxis.set_minor_formatter(matplotlib.ticker.FormatStrFormatter("%.3f"))
        handles, labels = psnr_axes.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside right center", frameon=False, fontsize=9)
        figure.savefig(path)


def plot_front(path: Path, summary: SceneSummary) -> None:
    """Final PSNR against training time: a point a variant with the seeds' spreads, the Pareto front marked."""
    styles = _styles(summary)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(8.6, 5.2), layout="constrained")
        axes = figure.add_subplot()
        for row in summary.rows:
            axes.errorbar(
                row.seconds.mean,
                row.psnr.mean,
                xerr=[[row.seconds.mean - row.seconds.low], [row.seconds.high - row.seconds.mean]],
                yerr=[[row.psnr.mean - row.psnr.low], [row.psnr.high - row.psnr.mean]],
                fmt="*" if row.on_front else "o",
                markersize=13 if row.on_front else 6,
                color=styles[row.name][0],
                elinewidth=1.0,
                alpha=0.9,
            )
        front = sorted((row for row in summary.rows if row.on_front), key=lambda row: row.seconds.mean)
        axes.step(
            [row.seconds.mean for row in front],
            [row.psnr.mean for row in front],
            where="post",
            color="grey",
            linewidth=1.2,
            zorder=0,
            label="Pareto front (stars)",
        )
        _label_points(axes, summary.rows)
        axes.set(
            xlabel="training time in seconds (evaluation excluded)",
            ylabel="final test PSNR in dB",
            title=f"{summary.scene}: error against time",
        )
        axes.margins(x=0.18, y=0.12)
        axes.legend(loc="lower right", frameon=False, fontsize=9)
        figure.savefig(path)


def _label_points(axes: Axes, rows: list[VariantRow]) -> None:
    """Names beside points, alternately above and below in the order of time so that neighbours do not meet."""
    for number, row in enumerate(sorted(rows, key=lambda row: (row.seconds.mean, row.psnr.mean))):
        above = number % 2 == 0
        axes.annotate(
            row.name,
            (row.seconds.mean, row.psnr.mean),
            xytext=(6, 6 if above else -6),
            textcoords="offset points",
            va="bottom" if above else "top",
            fontsize=8,
        )
