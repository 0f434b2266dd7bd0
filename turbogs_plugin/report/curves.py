"""Plots of error against seconds. Importing this module loads matplotlib: import it where a plot is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from turbogs_plugin.files import new_file

STYLE: dict[Any, Any] = {
    "figure.dpi": 120,
    "font.size": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "lines.linewidth": 1.8,
    "lines.markersize": 5,
    "text.parse_math": False,  # a capture's name may hold dollars
    "text.usetex": False,  # a matplotlibrc in the current folder may ask for LaTeX, a program
}
"""matplotlib's settings for every plot of the project."""

SECONDS_LABEL = "training time in seconds (evaluation excluded)"


def plot_against_seconds(path: Path, seconds: Sequence[float], values: Sequence[float], label: str, title: str) -> None:
    """Draw one measure of a run's evaluations against seconds of training, as a PNG. `label`: of the vertical axis."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 4.0), layout="constrained")
        axes = figure.add_subplot()
        axes.plot(seconds, values, marker="o", color="#1f5fa8")
        last = f"{values[-1]:.2f}" if abs(values[-1]) >= 1 else f"{values[-1]:.4f}"
        axes.annotate(last, (seconds[-1], values[-1]), xytext=(0, 8), textcoords="offset points", ha="right")
        axes.set(xlabel=SECONDS_LABEL, ylabel=label, title=title)
        axes.set_xlim(left=0)
        axes.margins(y=0.12)
        with new_file(path) as file:
            figure.savefig(file, format="png")
