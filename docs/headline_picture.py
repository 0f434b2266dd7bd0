"""The picture of README.md: test errors of three captures against seconds and against Gaussians, ours and others'."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from study_tables import CAPS, CAPTURES, OURS, ROOT, read_peers, rows_of

PICTURE = ROOT / "docs/results/headline.png"
DRAWING = 4
"""Version of the way in which the picture is drawn: it is drawn anew where its data or this differ."""

PICTURE_COLORS = {
    "turbogs": "#d1495b",
    "turbogs-small with a cap": "#e8a0a8",
    "turbogs-ssim": "#8a1c3a",
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
PICTURE_NAMES = {"ssim": "turbogs-ssim", **dict.fromkeys(CAPS, "turbogs-small with a cap")}
PICTURE_TICKS = (
    {"0.3": 0.3, "1": 1, "3": 3, "10": 10, "30": 30, "100": 100},
    *({"50k": 5e4, "100k": 1e5, "200k": 2e5, "500k": 5e5, "1M": 1e6, "2M": 2e6},) * 2,
)


def picture_data() -> dict[str, Any]:
    """Capture -> our curves (seconds, PSNR) and all end points (name, seconds, PSNR, Gaussians, SSIM): what `draw`
    shows."""
    data: dict[str, Any] = {capture: {"curves": {}, "points": []} for capture in CAPTURES}
    for study, variant, _ in OURS:
        name = PICTURE_NAMES.get(variant, variant)
        for capture, rows in rows_of(study).items():
            if row := rows.get(variant):
                if CAPS.get(variant, capture) == capture:
                    curve = row.curve("psnr")
                    data[capture]["curves"][name] = [curve.seconds.round(4).tolist(), curve.mean.round(4).tolist()]
                means = [row.spread(measure).mean for measure in ("seconds", "psnr", "gaussians", "ssim")]
                data[capture]["points"].append([name, *(round(value, 4) for value in means)])
    for entry in read_peers()["rows"]:
        name = entry["method"].split()[0].rstrip(",")
        point = [entry.get(measure) for measure in ("seconds", "psnr", "gaussians", "ssim")]
        data[entry["capture"]]["points"].append([name, *point])
    return data


def draw(data: dict[str, Any]) -> Figure:
    """PSNR against seconds above, then PSNR and SSIM against the number of Gaussians; a column a capture."""
    figure = Figure(figsize=(13.0, 10.6), layout="constrained")
    axes = figure.subplots(3, len(data))
    for column, (capture, shown) in enumerate(data.items()):
        for name, (seconds, psnr) in shown["curves"].items():
            axes[0, column].plot(seconds, psnr, color=PICTURE_COLORS[name], linewidth=1.8, label=name)
        for name, seconds, psnr, gaussians, ssim in shown["points"]:
            style = {"color": PICTURE_COLORS[name], "marker": "*" if name == "turbogs" else "o", "linestyle": ""}
            size = 13 if name == "turbogs" else 6
            axes[0, column].plot(seconds, psnr, markersize=size, label=name, **style)
            for axis, error in zip(axes[1:, column], (psnr, ssim), strict=True):
                if gaussians is not None and error is not None:
                    axis.plot(gaussians, error, markersize=size, label=name, **style)
        best, worst = (pick(point[2] for point in shown["points"]) for pick in (max, min))
        longest = max(250.0, *(1.2 * point[1] for point in shown["points"]))
        axes[0, column].set(title=capture, xlabel="training seconds", xlim=(0.3, longest))
        axes[0, column].set_ylim(best - 5.0, best + 0.4)
        axes[1, column].set(xlabel="Gaussians", xlim=(4e4, 2.5e6), ylim=(max(best - 5.0, worst - 0.3), best + 0.4))
        axes[2, column].set(xlabel="Gaussians", xlim=(4e4, 2.5e6))
        for axis, ticks in zip(axes[:, column], PICTURE_TICKS, strict=True):
            axis.set_xscale("log")
            axis.set_xticks(list(ticks.values()), list(ticks))
            axis.xaxis.set_minor_locator(NullLocator())
    for row, label in zip(axes, ("test PSNR in dB", "test PSNR in dB", "test SSIM"), strict=True):
        row[0].set_ylabel(label)
    handles = {
        label: handle for axis in axes.flat for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    labels = [PICTURE_LABELS.get(name, name) for name in handles]
    figure.legend(handles.values(), labels, loc="outside lower center", ncols=min(len(handles), 6), frameon=False)
    return figure


def picture_digest() -> str:
    """Of what the plot shows."""
    return hashlib.sha256(json.dumps([DRAWING, picture_data()]).encode()).hexdigest()[:16]
