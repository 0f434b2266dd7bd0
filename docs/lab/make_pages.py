"""Fills the tables of README.md and docs/ from the files in docs/lab/, and draws README's plot: `make pages`.

A table stands between ``<!-- made: NAME -->`` and ``<!-- end -->``, where NAME is a key of `TABLES`. A second run
changes nothing. The blocks `BY_OTHERS` are written by docs/lab/numerics.py.
"""

from __future__ import annotations

import hashlib
import json
import re
import statistics
import textwrap
from collections.abc import Callable
from functools import partial
from typing import Any

import paper_tables
import studies
import timings
from matplotlib.figure import Figure
from PIL import Image
from studies import CAPTURES, LAB, OURS, mean, read_json

ROOT = LAB.parents[1]
PICTURE = LAB / "headline.png"
BLOCK = re.compile(r"(<!-- made: ([\w -]+) -->\n).*?(<!-- end -->)", re.DOTALL)


def render_caption() -> str:
    """Below README's first picture."""
    record = read_json("pictures.json")
    machine = record["provenance"]["machine"].partition(" (")[0]
    text = (
        f"*{record['scene']}, a capture by a drone (CC0), rendered from the camera of one of its "
        f"{record['training_views']} training views: {record['gaussians']:,} Gaussians, {record['iteration']} "
        f"iterations, {record['train_seconds']:.1f} s of training on one {machine}; {record['psnr']:.2f} dB on the "
        f"test views.*"
    )
    return textwrap.fill(text, 120, break_on_hyphens=False)


TABLES: dict[str, Callable[[], str]] = {
    "headline": studies.headline,
    "sooner": studies.sooner,
    "sources": studies.sources,
    **{f"study {name}": partial(studies.study_table, name) for name in studies.STUDIES},
    **{f"refined {name}": partial(studies.study_table, name, "refined_") for name in ("sizes", "cameras")},
    "paper parts": paper_tables.paper_parts,
    "paper whole": paper_tables.paper_whole,
    "render caption": render_caption,
    "wall": timings.wall,
    "steps h200": partial(timings.steps, "step-h200.json"),
    "steps h100": partial(timings.steps, "step-h100.json"),
    "raster": timings.raster,
    "ranks": timings.ranks,
    "rank runs": timings.rank_runs,
    "dropin": timings.dropin,
    "pixels on an mlp": timings.pixels_on_an_mlp,
}


BY_OTHERS = ("solvers", "density_sums")


def filled(page: str) -> str:
    """A page with its tables made anew."""

    def made(block: re.Match[str]) -> str:
        return block[0] if block[2] in BY_OTHERS else f"{block[1]}\n{TABLES[block[2]]()}\n\n{block[3]}"

    return BLOCK.sub(made, page)


COLORS = {
    "turbogs": "#d1495b",
    "turbogs-small": "#e8a0a8",
    "turbogs-ssim": "#8a1c3a",
    "turbogs-paper": "#17919e",
    "gsplat": "#5c6670",
    "FastGS": "#e08e0b",
    "LiteGS": "#1f5fa8",
    "Faster-GS": "#2e8b57",
}
"""Method -> its colour; rows of other names are not drawn."""


def picture_data() -> dict[str, Any]:
    """Capture -> our curves (name, seconds, PSNR), and all ends (name, seconds, PSNR, SSIM, Gaussians)."""
    data: dict[str, Any] = {capture: {"curves": [], "ends": []} for capture in CAPTURES}
    for row in OURS:
        name = row.name.strip("*").partition(",")[0]
        for capture, cells in row.cells().items() if name in COLORS else ():
            columns = ([cell["curve"][key] for cell in cells] for key in ("seconds", "psnr"))
            means = [[round(statistics.fmean(mark), 4) for mark in zip(*column, strict=True)] for column in columns]
            data[capture]["curves"].append([name, *means])
            ends = (round(mean(cells, measure), 4) for measure in ("seconds", "psnr", "ssim", "gaussians"))
            data[capture]["ends"].append([name, *ends])
    for entry in read_json("peers.json")["rows"]:
        end = [entry[measure] for measure in ("seconds", "psnr", "ssim", "gaussians")]
        data[entry["capture"]]["ends"].append([entry["method"].split()[0].rstrip(","), *end])
    return data


def draw(data: dict[str, Any]) -> Figure:
    """PSNR against seconds of training above, SSIM against the number of Gaussians below; a column a capture."""
    figure = Figure(figsize=(13.0, 7.4), layout="constrained")
    axes = figure.subplots(2, len(data), squeeze=False)
    for (upper, lower), (capture, shown) in zip(axes.T, data.items(), strict=True):
        for name, seconds, psnr in shown["curves"]:
            upper.plot(seconds, psnr, color=COLORS[name], label=name)
        for name, seconds, psnr, ssim, gaussians in shown["ends"]:
            style = {"color": COLORS[name], "marker": "*" if name == "turbogs" else "o", "linestyle": "", "label": name}
            upper.plot(seconds, psnr, **style)
            if gaussians is not None and ssim is not None:
                lower.plot(gaussians, ssim, **style)
        top = max(psnr for _, _, psnr, *_ in shown["ends"])
        upper.set(title=capture, xlabel="seconds of training", xscale="log", xlim=(0.3, 250), ylim=(top - 5, top + 0.4))
        lower.set(xlabel="Gaussians", xscale="log", xlim=(4e4, 2.5e6))
    axes[0, 0].set_ylabel("test PSNR in dB")
    axes[1, 0].set_ylabel("test SSIM")
    pairs = (zip(*axis.get_legend_handles_labels(), strict=True) for axis in axes.flat)
    handles = {label: handle for found in pairs for handle, label in found}
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=len(handles), frameon=False)
    return figure


def draw_picture() -> None:
    """Draw README's plot where the file was drawn of other data."""
    data = picture_data()
    digest = hashlib.sha256(json.dumps(data).encode()).hexdigest()[:16]
    if not PICTURE.is_file() or Image.open(PICTURE).info.get("Comment") != digest:
        draw(data).savefig(PICTURE, dpi=75, metadata={"Comment": digest})


if __name__ == "__main__":
    for path in (ROOT / "README.md", *sorted(LAB.parent.rglob("*.md"))):
        path.write_text(filled(path.read_text(encoding="utf-8")), encoding="utf-8")
    draw_picture()
