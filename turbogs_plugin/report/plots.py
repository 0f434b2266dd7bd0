"""Plots of a report: error against seconds. Importing this loads matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

STYLE = {
    "figure.dpi": 120,
    "font.size": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "lines.linewidth": 1.8,
    "lines.markersize": 5,
    "text.parse_math": False,  # a capture's name may hold dollars
}

MARGINS = {"left": 0.14, "right": 0.97, "bottom": 0.13, "top": 0.92}
"""Of the axes, as shares of the figure: matplotlib's own layout draws everything once more to find them."""

SECONDS_LABEL = "training time in seconds (evaluation excluded)"


def plot_against_seconds(path: Path, seconds: Sequence[float], values: Sequence[float], label: str, title: str) -> None:
    """One measure of a history against seconds of training, as a PNG.

    Args:
        path: the file.
        seconds, values: of the evaluations of one run, in order.
        label: of the vertical axis, with the unit.
        title: of the plot.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 4.0))
        axes = figure.add_subplot()
        figure.subplots_adjust(**MARGINS)
        axes.plot(seconds, values, marker="o", color="#1f5fa8")
        axes.annotate(
            label_of(values[-1]), (seconds[-1], values[-1]), xytext=(0, 8), textcoords="offset points", ha="right"
        )
        axes.set(xlabel=SECONDS_LABEL, ylabel=label, title=title)
        axes.set_xlim(left=0)
        axes.margins(y=0.12)
        figure.savefig(path)


def label_of(value: float) -> str:
    """A value as a plot names it: PSNR as 32.31, an error as 0.0123, a number of Gaussians as 325123."""
    digits = 0 if abs(value) >= 1000 else 2 if abs(value) >= 1 else 4
    return f"{value:.{digits}f}"
