"""Fills the tables of README.md and of pages in docs/ from the studies' results; `make pages` runs it.

A table stands between ``<!-- made: NAME -->`` and ``<!-- end -->``, where NAME is a key of `TABLES`; what is between
them is replaced. A second run changes nothing.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import statistics
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import machine_tables
import sweep_tables
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from turbogs_plugin.report.tables import table
from turbogs_plugin.study.folder import StudyFolder
from turbogs_plugin.study.pages import difference_text
from turbogs_plugin.study.plots import save_plot
from turbogs_plugin.study.results import Study
from turbogs_plugin.study.summary import VariantRow, summarise
from turbogs_plugin.study.verdict import verdict

ROOT = Path(__file__).resolve().parent.parent
PAGES = tuple(
    ROOT / name
    for name in (
        "README.md",
        "docs/budgets.md",
        "docs/drop-in.md",
        "docs/numerics.md",
        "docs/paper.md",
        "docs/plan.md",
        "docs/results/README.md",
        "docs/results/h200/README.md",
        "docs/results/h200/house.md",
        "docs/results/h200/masks.md",
        "docs/viewer.md",
        *(f"docs/results/sweeps/{name}.md" for name in sweep_tables.rounds()),
    )
)
PICTURE = ROOT / "docs/results/headline.png"
DRAWING = 2
"""Version of the way in which the picture is drawn: it is drawn anew where its data or this differ."""

PICTURE_COLORS = {
    "turbogs": "#d1495b",
    "turbogs-paper": "#17919e",
    "3dgs": "black",
    "3dgs-as-shipped": "0.6",
    "mcmc": "#7a4fa3",
    "fastgs": "#8c5a3c",
    "gsplat": "#5c6670",
    "FastGS": "#e08e0b",
    "LiteGS": "#1f5fa8",
    "Faster-GS": "#2e8b57",
}
PICTURE_LABELS = {"3dgs": "3DGS, ours", "mcmc": "MCMC, ours", "fastgs": "votes as FastGS's, ours"}
PICTURE_TICKS = (
    {"0.3": 0.3, "1": 1, "3": 3, "10": 10, "30": 30, "100": 100},
    {"50k": 5e4, "100k": 1e5, "200k": 2e5, "500k": 5e5, "1M": 1e6, "2M": 2e6},
)
CAPTURES = ("fox", "caliterra", "snowmiku")
BLOCK = re.compile(r"(<!-- made: ([\w ]+) -->\n).*?(<!-- end -->)", re.DOTALL)

OURS = (
    ("baselines", "3dgs", "3DGS by gsplat's strategy in our renderer, 30,000 iterations"),
    ("baselines", "3dgs-as-shipped", "the same with gsplat 1.5.3's reset of opacities, which never happens"),
    ("baselines", "mcmc", "MCMC by gsplat's strategy in our renderer, 30,000 iterations"),
    ("baselines", "fastgs", "density by votes of many views, after FastGS, in our renderer, 30,000 iterations"),
    ("paper_parts", "turbogs-paper", "turbogs-paper"),
    ("parts", "turbogs", "**turbogs**"),
)
"""Rows of the headline table that are ours, where they are measured: study, variant, what to call it."""


@cache
def read_study(folder: Path) -> Study:
    return StudyFolder(folder).read_study()


def rows_of(study: str) -> dict[str, dict[str, VariantRow]]:
    """Capture -> variant -> its row; none of a study that is not measured yet."""
    if not (ROOT / "docs/results" / study / "results.json").is_file():
        return {}
    summaries = summarise(read_study(ROOT / "docs/results" / study))
    return {summary.scene: {row.name: row for row in summary.rows} for summary in summaries}


def result(seconds: float, psnr: float, ssim: float | None, gaussians: float | None, wall: str | None = None) -> str:
    """``4.1 s, 32.20 dB, .893, 209k``; what was not recorded is left out. With `wall`, ``4.1 / 9.5 s``."""
    size = (
        gaussians if gaussians is None else f"{gaussians / 1e6:.2f}M" if gaussians >= 1e6 else f"{gaussians / 1e3:.0f}k"
    )
    clocks = duration(seconds) if wall is None else f"{duration(seconds)} / {wall}"
    parts = [f"{clocks} s", f"{psnr:.2f} dB"]
    parts += [] if ssim is None else [f"{ssim:.3f}".lstrip("0")]
    return ", ".join(parts if size is None else [*parts, size])


def duration(seconds: float) -> str:
    return "-" if math.isnan(seconds) else f"{seconds:.1f}" if seconds < 10 else f"{seconds:.0f}"


def headline() -> str:
    """Ours beside the others, on each capture: seconds of training, and on the wall where they were recorded."""
    peers = json.loads((ROOT / "docs/results/peers.json").read_text())
    lines: dict[str, dict[str, str]] = {}
    for entry in peers["rows"]:
        beyond = peers["beyond_training"].get(entry["method"].split()[0], ())
        wall = " to ".join(duration(entry["seconds"] + more) for more in sorted(set(beyond))) or "-"
        cell = result(entry["seconds"], entry["psnr"], entry["ssim"], entry["gaussians"], wall)
        lines.setdefault(entry["method"], {})[entry["capture"]] = cell
    for study, variant, name in OURS:
        for capture, rows in rows_of(study).items():
            if row := rows.get(variant):
                means = [row.spread(measure).mean for measure in ("seconds", "psnr", "ssim", "gaussians")]
                wall = duration(row.spread("cell_seconds").mean)
                lines.setdefault(name, {})[capture] = result(*means, wall)
    return table(
        ("", *CAPTURES), [[name, *(cells.get(capture, "") for capture in CAPTURES)] for name, cells in lines.items()]
    )


def changes(study: str) -> str:
    """Every variant of a study against its own baseline, over the same seeds."""
    found = rows_of(study)
    captures = [capture for capture in CAPTURES if capture in found]
    lines = []
    for variant in read_study(ROOT / "docs/results" / study).ablation.variants:
        cells = []
        for capture in captures:
            row = found[capture].get(variant)
            cells.append("" if row is None or row.cells == row.base else change(row))
        if any(cells):
            lines.append((variant, *cells))
    return table(("", *captures), lines)


def change(row: VariantRow) -> str:
    """Differences in PSNR and SSIM, ratios of time and Gaussians, and how many seeds."""
    sizes = row.ratio("gaussians")
    error, said, clear = difference_text(row.difference("psnr"), 2).partition(" (clear)")
    parts = [f"{error} dB{said}{clear}", difference_text(row.difference("ssim"), 4)]
    parts += [f"x {row.ratio('seconds'):.2f} s", "" if math.isnan(sizes) else f"x {sizes:.2f} N"]
    return f"{', '.join(filter(None, parts))} ({row.difference('psnr').count})"


def picture_data() -> dict[str, Any]:
    """Capture -> our curves (seconds, PSNR) and end points, and the others' points: what `draw` shows."""
    data: dict[str, Any] = {capture: {"curves": {}, "points": []} for capture in CAPTURES}
    for study, variant, _ in OURS:
        for capture, rows in rows_of(study).items():
            if row := rows.get(variant):
                curve = row.curve("psnr")
                data[capture]["curves"][variant] = [curve.seconds.round(4).tolist(), curve.mean.round(4).tolist()]
                means = [row.spread(measure).mean for measure in ("seconds", "psnr", "gaussians")]
                data[capture]["points"].append([variant, *(round(value, 4) for value in means)])
    for entry in json.loads((ROOT / "docs/results/peers.json").read_text())["rows"]:
        name = entry["method"].split()[0].rstrip(",")
        data[entry["capture"]]["points"].append([name, entry["seconds"], entry["psnr"], entry["gaussians"]])
    return data


def draw(data: dict[str, Any]) -> Figure:
    """PSNR against seconds above, and against the number of Gaussians below; a column a capture."""
    figure = Figure(figsize=(13.0, 7.6), layout="constrained")
    axes = figure.subplots(2, len(data))
    for column, (capture, shown) in enumerate(data.items()):
        for name, (seconds, psnr) in shown["curves"].items():
            axes[0, column].plot(seconds, psnr, color=PICTURE_COLORS[name], linewidth=1.8, label=name)
        for name, seconds, psnr, gaussians in shown["points"]:
            style = {"color": PICTURE_COLORS[name], "marker": "*" if name == "turbogs" else "o", "linestyle": ""}
            size = 13 if name == "turbogs" else 6
            axes[0, column].plot(seconds, psnr, markersize=size, label=name, **style)
            if gaussians is not None:
                axes[1, column].plot(gaussians, psnr, markersize=size, label=name, **style)
        best, worst = (pick(point[2] for point in shown["points"]) for pick in (max, min))
        longest = max(250.0, *(1.2 * point[1] for point in shown["points"]))
        axes[0, column].set(title=capture, xlabel="training seconds", xlim=(0.3, longest))
        axes[0, column].set_ylim(best - 5.0, best + 0.4)
        axes[1, column].set(xlabel="Gaussians", xlim=(4e4, 2.5e6), ylim=(max(best - 5.0, worst - 0.3), best + 0.4))
        for axis, ticks in zip(axes[:, column], PICTURE_TICKS, strict=True):
            axis.set_xscale("log")
            axis.set_xticks(list(ticks.values()), list(ticks))
            axis.xaxis.set_minor_locator(NullLocator())
    for row in axes:
        row[0].set_ylabel("test PSNR in dB")
    handles = {
        label: handle for axis in axes.flat for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    labels = [PICTURE_LABELS.get(name, name) for name in handles]
    figure.legend(handles.values(), labels, loc="outside lower center", ncols=min(len(handles), 6), frameon=False)
    return figure


def picture_digest() -> str:
    """Of what the plot shows."""
    return hashlib.sha256(json.dumps([DRAWING, picture_data()]).encode()).hexdigest()[:16]


def house_runs() -> str:
    """Whole runs before, as measured then, and `turbogs` of the study `parts`: mean and range of five seeds."""
    found, lines = rows_of("parts"), []
    for capture, base in machine_tables.house()["base_runs"].items():
        row = found[capture]["turbogs"]
        spreads = [row.spread(measure) for measure in ("seconds", "psnr", "ssim")]
        after = [[spread.mean, spread.low, spread.high] for spread in spreads]
        for build, values, size in (
            ("base", [base[measure] for measure in ("seconds", "psnr", "ssim")], base["gaussians"]),
            ("new", after, row.spread("gaussians").mean),
        ):
            texts = [
                f"{mean:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"
                for (mean, low, high), digits in zip(values, (1, 2, 4), strict=True)
            ]
            lines.append((capture, build, *texts, f"{size:.0f}"))
    return table(("capture", "build", "s", "PSNR", "SSIM", "Gaussians"), lines)


# docs/paper.md

BOUND = 0.3
"""dB by which `turbogs-paper` may be worse than 3DGS at its full length."""


class Part(NamedTuple):
    """A part of the paper.

    Args:
        name: what it is; in brackets what the full method loses without it in the paper's table of components.
        ours: the variants of `parts` with it and without it; either is `turbogs`, or the row has no default.
        papers: the same of `paper_parts`, or None where it has none.
    """

    name: str
    ours: tuple[str, str]
    papers: tuple[str, str] | None = None

    @property
    def default(self) -> str:
        """Whose way today's `turbogs` has."""
        with_it, without = self.ours
        return "the paper's" if with_it == "turbogs" else "ours" if without == "turbogs" else ""


PARTS = (
    Part(
        "geometry-aware views, not random ones (+0.31 dB)",
        ("geometry-views", "turbogs"),
        ("turbogs-paper", "random-views"),
    ),
    Part(
        "error-guided pixels, not random ones (+0.47 dB)",
        ("turbogs", "random-pixels"),
        ("turbogs-paper", "random-pixels"),
    ),
    Part("Moment-LM, not sparse Adam", ("turbogs", "sparse-adam"), ("turbogs-paper", "sparse-adam")),
    Part("the error-driven score, not the gradient alone", ("turbogs", "no-score"), ("turbogs-paper", "no-score")),
    Part("the same without our decay and long-axis splits", ("plain-splits", "plain-splits-no-score")),
    Part("error-driven density, not gsplat's", ("turbogs", "density-gsplat")),
    Part("error-driven density, not votes as FastGS's (+0.02 dB)", ("turbogs", "density-fastgs")),
    Part("final pruning", ("final-pruning", "turbogs"), ("turbogs-paper", "no-final-pruning")),
    Part("pruning by score at every event", ("prune-by-score", "turbogs")),
    Part("the raw sum as the score", ("score-raw", "turbogs")),
    Part("NCC (+0.48 dB)", ("turbogs", "no-ncc"), ("turbogs-paper", "no-ncc")),
    Part("NCC, not SSIM of a tile's samples (+0.36 dB)", ("turbogs", "sparse-ssim")),
    Part("NCC at the weight of 1, not 0.4", ("ncc-1", "turbogs")),
    Part("the printed NCC: a flat tile scores 0", ("printed-ncc", "turbogs")),
    Part("3DGS's learning rates", ("rates-3dgs", "turbogs"), ("turbogs-paper", "rates-turbogs")),
    Part("3DGS's splits, no opacity decay", ("plain-splits", "turbogs")),
    Part("3DGS's splits alone", ("split-sample", "turbogs")),
    Part("no opacity decay, alone", ("no-decay", "turbogs")),
    Part("3DGS's percent_dense, .01", ("percent-dense-0.01", "turbogs")),
    Part("pruning by the scene's extent, as 3DGS", ("prune-by-extent", "turbogs")),
    Part("a band of harmonics every 1000 iterations, as 3DGS", ("sh-interval-1000", "turbogs")),
    Part("no backdrop", ("no-backdrop", "turbogs")),
    Part("no bound on far sizes", ("distant-unbounded", "turbogs")),
)


def comparisons(study: str, variants: tuple[str, str] | None) -> dict[str, VariantRow]:
    """Capture -> the first variant against the second, where both have a seed in common."""
    if variants is None:
        return {}
    found = {}
    for capture, rows in rows_of(study).items():
        if all(name in rows for name in variants):
            with_it, without = (rows[name].cells for name in variants)
            row = VariantRow(variants[0], with_it, without)
            if row.difference("psnr").count:
                found[capture] = row
    return {capture: found[capture] for capture in CAPTURES if capture in found}


def effects(rows: Mapping[str, VariantRow]) -> str:
    return "<br>".join(f"{capture}: {change(row)}" for capture, row in rows.items()) or "-"


def paper_parts() -> str:
    """Each part of the paper: what it adds to ours and to the paper's configuration, the verdict, and the default."""
    lines = []
    for part in PARTS:
        ours, papers = comparisons("parts", part.ours), comparisons("paper_parts", part.papers)
        said, said_there = verdict(ours, CAPTURES), verdict(papers, CAPTURES)
        told = f"{said.text}<br>in the paper's: {said_there.text}" if part.papers else said.text
        default = part.default or "-"
        if part.default and said.decides not in ("", part.default):
            default = f"{part.default}; **should be {said.decides}**"
        lines.append((part.name, effects(ours), effects(papers), told, default))
    header = ("the paper's part", "in our default", "in the paper's configuration", "verdict", "default")
    return table(header, lines)


def paper_whole() -> str:
    """The paper's configuration with and without its repair, beside full-length 3DGS and ours."""
    found = {study: rows_of(study) for study in ("baselines", "paper_parts", "parts")}
    entries = {
        "3DGS, 30,000 iterations": ("baselines", "3dgs"),
        "`turbogs-paper`": ("paper_parts", "turbogs-paper"),
        "`paper-literal`, without the repair": ("paper_parts", "paper-literal"),
        "`turbogs`": ("parts", "turbogs"),
    }
    rows = {
        name: {capture: found[study].get(capture, {}).get(variant) for capture in CAPTURES}
        for name, (study, variant) in entries.items()
    }
    lines = [(name, *(whole_run(row) for row in by_capture.values())) for name, by_capture in rows.items()]
    full, paper, *_ = rows.values()
    for name, end in (("end", True), ("best on the way", False)):
        cells = [within_bound(full[capture], paper[capture], end) for capture in CAPTURES]
        lines.append((f"`turbogs-paper`, its end, minus 3DGS, its {name}", *cells))
    return table(("", *CAPTURES), lines)


def best_psnr(row: VariantRow) -> float:
    """dB: the highest that a run had on its way, mean over seeds."""
    return statistics.fmean(max(entry.psnr for entry in cell.history) for cell in row.cells)


def whole_run(row: VariantRow | None) -> str:
    if row is None:
        return "not measured yet"
    means = [row.spread(measure).mean for measure in ("seconds", "psnr", "ssim", "gaussians")]
    return f"{result(*means)}; best on the way {best_psnr(row):.2f} dB ({len(row.cells)})"


def within_bound(full: VariantRow | None, paper: VariantRow | None, end: bool) -> str:
    """The difference of means over all seeds of either, and whether the bound is kept."""
    if full is None or paper is None:
        return "not measured yet"
    difference = paper.psnr.mean - (full.psnr.mean if end else best_psnr(full))
    return f"{difference:+.2f} dB, {'within' if difference >= -BOUND else 'beyond'} the bound"


@cache
def round_tables(name: str) -> dict[str, str]:
    return sweep_tables.tables_of(name)


def round_table(name: str, table_name: str) -> str:
    return round_tables(name)[table_name]


TABLES: dict[str, Callable[[], str]] = {
    "dropin": machine_tables.dropin,
    "exposures": machine_tables.exposures,
    "headline": headline,
    "house_iterations": lambda: machine_tables.iterations(machine_tables.house()),
    "house_runs": house_runs,
    "leave_out": lambda: changes("leave_out"),
    "masks_iterations": lambda: machine_tables.iterations(machine_tables.masks()),
    "paper_parts": paper_parts,
    "paper_whole": paper_whole,
    "parts": lambda: changes("parts"),
    "viewer": machine_tables.viewer,
    "memory": lambda: machine_tables.on("bench-step.json", machine_tables.memory),
    "offload": lambda: machine_tables.on("bench-4k.json", machine_tables.offload),
    "precision": lambda: machine_tables.on("bench-raster.json", machine_tables.precision),
    "raster": lambda: machine_tables.on("bench-raster.json", machine_tables.raster),
    "solvers": machine_tables.solvers,
    "steps": lambda: machine_tables.on("bench-step.json", machine_tables.steps),
    "wall": machine_tables.wall,
}
TABLES |= {name: lambda name=name: round_table(*name.split()) for name in sweep_tables.names()}


def filled(text: str) -> str:
    """A page with its tables made anew."""
    return BLOCK.sub(lambda block: f"{block[1]}\n{TABLES[block[2]]()}\n\n{block[3]}", text)


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(filled(page.read_text()))
    save_plot(PICTURE, lambda: draw(picture_data()), picture_digest())
