"""Pictures of a study: error against seconds of every variant in one plot, and the Pareto front."""

from __future__ import annotations

import hashlib
import io
import itertools
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.transforms import Bbox
from PIL import Image, PngImagePlugin

from turbogs_plugin.files import write_atomically
from turbogs_plugin.report.curves import SECONDS_LABEL, STYLE
from turbogs_plugin.study.statistics import pareto_front
from turbogs_plugin.study.summary import SceneSummary, VariantRow

COLORS = ("#1f5fa8", "#d1495b", "#2e8b57", "#e08e0b", "#7a4fa3", "#17919e", "#8c5a3c", "#5c6670")
DASHES = ("-", "--", ":", "-.")
BASELINE_COLOR = "black"
OTHER_COLOR = "0.75"
LABEL_SIZE = 8
TOLD_APART_UP_TO = 10
"""Where there are more variants, only the baseline and the Pareto front have a colour and a shaded spread."""

SHOWN_BELOW = 4.0
"""The PSNR plot ends this many dB below the worst final result: trainings pass what is below in a moment."""
SHOWN_ABOVE = 1.6
"""The plot of errors ends at the worst final error times this, which is 4 dB as well."""
FAILED_BELOW = 8.0
"""A variant has failed that ends this many dB below the best one: it is not drawn, but named below the plot."""

COSTS = {
    "seconds": (SECONDS_LABEL, "error against time"),
    "gaussians": ("Gaussians of the final model", "error against size"),
}
"""What a Pareto plot may have below it -> its label, and the plot's title."""

DRAWING = 2
"""Version of the way in which plots are drawn. Raise it with every change of that: a plot is only drawn again where its
data or this number differ."""
DATA_KEY = "data"
"""Name of the text in a plot's PNG that holds the digest of what it shows."""
PALETTE = 128
"""Colours of a plot's PNG: a third of the bytes, and no difference that can be seen."""


@dataclass(frozen=True)
class Plot:
    """One kind of plot.

    Args:
        name: end of its file's name.
        text: what it shows.
        draw: makes it.
    """

    name: str
    text: str
    draw: Callable[[SceneSummary], Figure]


def write_plots(folder: Path, summary: SceneSummary) -> None:
    """Draw what is not there yet, or is there of other data: ``SCENE-NAME.png`` for each of `PLOTS`."""
    for plot in PLOTS:
        save_plot(folder / f"{summary.scene}-{plot.name}.png", partial(plot.draw, summary), plot_digest(summary))


def save_plot(path: Path, draw: Callable[[], Figure], digest: str) -> None:
    """Write a plot as a PNG that holds the digest of what it shows, unless the file there shows the same."""
    if shown_digest(path) == digest:
        return
    text = PngImagePlugin.PngInfo()
    text.add_text(DATA_KEY, digest)
    drawn = io.BytesIO()
    with matplotlib.rc_context(STYLE):  # also at the end, where ticks get their labels
        draw().savefig(drawn, format="png")
    picture = Image.open(drawn).convert("RGB").quantize(PALETTE, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    write_atomically(path, lambda file: picture.save(file, "PNG", optimize=True, pnginfo=text))


def plot_digest(summary: SceneSummary) -> str:
    """A digest of everything that the plots show, and of how they are drawn."""
    rows = []
    for row in summary.rows:
        shown = (row.seconds, row.psnr, row.spread("gaussians"), row.curve("psnr"), row.curve("l1"))
        rows.append((row.name, row.on_front, *map(asdict, shown)))
    text = json.dumps([DRAWING, summary.scene, summary.baseline, rows], default=np.ndarray.tolist)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def shown_digest(path: Path) -> str:
    """The `plot_digest` of what a PNG shows; "" where it does not say, or is no picture."""
    try:
        with Image.open(path) as picture:
            return picture.info.get(DATA_KEY, "")
    except OSError:
        return ""


def _styles(summary: SceneSummary) -> dict[str, tuple[str, str]]:
    """Variant -> (colour, dash): black for the baseline, else one of each combination."""
    combinations = itertools.cycle((color, dash) for dash in DASHES for color in COLORS)
    styles = {row.name: style for row, style in zip(summary.rows, combinations, strict=False)}
    return styles | {summary.baseline: (BASELINE_COLOR, "-")}


def told_apart(summary: SceneSummary) -> tuple[list[VariantRow], str]:
    """The variants that set a plot's scale, and a line that names those that failed ("" for none)."""
    floor = max(row.psnr.mean for row in summary.rows) - FAILED_BELOW
    failed = [row for row in summary.rows if row.psnr.mean < floor]  # NaN is shown
    words = ", ".join(f"{row.name} ({row.psnr.mean:.1f} dB in {row.seconds.mean:.1f} s)" for row in failed)
    return [row for row in summary.rows if row not in failed], f"Not in the plot: {words}" if failed else ""


def draw_curves(summary: SceneSummary) -> Figure:
    """PSNR and mean absolute error against seconds: mean over seeds, their spread shaded.

    If there are more variants than can be told apart, those that are neither the baseline nor on the Pareto front are
    drawn thin and grey behind the others; the front's plot has their names.
    """
    styles, (rows, failed) = _styles(summary), told_apart(summary)
    named, others = rows, []
    if len(rows) > TOLD_APART_UP_TO:
        named = [row for row in rows if row.on_front or row.name == summary.baseline]
        others = [row for row in rows if row not in named]
    figure = Figure(figsize=(12.0, 5.2), layout="constrained")
    for axes, name in zip(figure.subplots(1, 2), ("psnr", "l1"), strict=True):
        for row in others:
            curve, label = row.curve(name), f"{len(others)} others" if row is others[0] else None
            axes.plot(curve.seconds, curve.mean, color=OTHER_COLOR, linewidth=0.8, label=label)
        for row in named:
            curve, (color, dash) = row.curve(name), styles[row.name]
            axes.plot(curve.seconds, curve.mean, dash, marker="o", markersize=3.5, color=color, label=row.name)
            if row.psnr.count > 1:
                axes.fill_between(curve.seconds, curve.low, curve.high, color=color, alpha=0.15, linewidth=0)
        axes.set_xlabel(SECONDS_LABEL)
        axes.set_xlim(left=0)
    psnr_axes, l1_axes = figure.axes
    floor = min(row.psnr.mean for row in rows) - SHOWN_BELOW
    psnr_axes.set(ylabel="test PSNR in dB", title=f"{summary.scene}: PSNR")
    psnr_axes.set_ylim(bottom=max(floor, psnr_axes.get_ylim()[0]))
    l1_axes.set(ylabel="mean absolute error on test views (0 .. 1)", title="mean absolute error")
    errors = [row.curve("l1").mean for row in rows]
    ceiling = SHOWN_ABOVE * max(error[-1] for error in errors)
    l1_axes.set_ylim(bottom=0.9 * min(map(min, errors)), top=min(ceiling, l1_axes.get_ylim()[1]))
    handles, labels = psnr_axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", frameon=False, fontsize=9)
    figure.supxlabel(failed, fontsize=9)
    return figure


def draw_front(summary: SceneSummary, cost: str = "seconds") -> Figure:
    """Final PSNR against what it cost: a point a variant with the seeds' spreads, the Pareto front marked.

    Args:
        cost: a key of `COSTS`.
    """
    of_cost, title = COSTS[cost]
    styles, (rows, failed) = _styles(summary), told_apart(summary)
    points = [(row.spread(cost).mean, row.psnr.mean) for row in rows]
    front = [point for point, on_front in zip(points, pareto_front(points), strict=True) if on_front]
    figure = Figure(figsize=(8.6, 5.2), layout="constrained")
    axes = figure.add_subplot()
    for row, point in zip(rows, points, strict=True):
        errors = [[[of.mean - of.low], [of.high - of.mean]] for of in (row.psnr, row.spread(cost))]
        marker, size = ("*", 13) if point in front else ("o", 6)
        style = {"fmt": marker, "markersize": size, "color": styles[row.name][0], "elinewidth": 1.0, "alpha": 0.9}
        axes.errorbar(*point, *errors, **style)
    steps = np.reshape(sorted(front), (-1, 2)).T  # [2, variants], also of none
    label = "Pareto front (stars)" if len(front) > 1 else None  # of one variant there is no line
    axes.step(*steps, where="post", color="grey", linewidth=1.2, zorder=0, label=label)
    axes.set(xlabel=of_cost, ylabel="final test PSNR in dB", title=f"{summary.scene}: {title}")
    axes.margins(x=0.18, y=0.12)
    if label:
        axes.legend(loc="lower right", frameon=False, fontsize=9)
    figure.supxlabel(failed, fontsize=9)
    _label_points(axes, rows, points)
    return figure


PLOTS = (
    Plot("curves", "error against seconds of training", draw_curves),
    Plot("pareto", "final PSNR against training time", draw_front),
    Plot("gaussians", "final PSNR against the number of Gaussians", partial(draw_front, cost="gaussians")),
)


def _label_points(axes: Axes, rows: list[VariantRow], values: list[tuple[float, float]]) -> None:
    """Names beside their points, each where it meets no other name and no other point, if there is such a place."""
    axes.figure.draw_without_rendering()  # so that places in pixels are those of the picture
    points = axes.transData.transform(values)
    pixels = axes.figure.dpi / 72.0
    height = 1.3 * LABEL_SIZE * pixels
    taken = [Bbox.from_bounds(x - 7, y - 7, 14, 14) for x, y in points]
    for row, (x, y) in zip(rows, points, strict=True):
        width = 0.62 * LABEL_SIZE * pixels * len(row.name)
        places = [
            Bbox.from_bounds(x + right, y + up - height / 2, width, height)
            for up in (0.0, height, -height, 2 * height, -2 * height, 3 * height, -3 * height)
            for right in (12.0, -12.0 - width)
        ]
        place = min(places, key=lambda box: sum(box.overlaps(other) for other in taken))
        taken.append(place)
        axes.annotate(
            row.name,
            (x, y),
            xycoords="figure pixels",
            xytext=(place.x0, (place.y0 + place.y1) / 2),
            textcoords="figure pixels",
            va="center",
            fontsize=LABEL_SIZE,
            path_effects=[withStroke(linewidth=2.5, foreground="white")],  # error bars and the front pass behind
            arrowprops={"arrowstyle": "-", "color": "0.7", "linewidth": 0.6, "shrinkA": 0, "shrinkB": 3},
            annotation_clip=False,
        )
