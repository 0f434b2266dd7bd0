"""What the pages say of pictures, exports and the viewer: tables and captions, from JSON files in docs/results."""

from __future__ import annotations

import json
import statistics
import textwrap
from pathlib import Path
from typing import Any

from machine_tables import ABSENT, H200, where

from turbogs_plugin.bench.viewer import summarised
from turbogs_plugin.report.tables import table

PICTURES = H200.parent / "pictures.json"
"""What docs/make_pictures.py wrote."""
EXPORTS = H200 / "exports.json"
"""What docs/measure_exports.py wrote."""
CAPTURES = {"caliterra": "a capture by a drone (CC0)"}
"""What README says of the capture that its pictures are of."""


def viewer(folder: Path = H200) -> str:
    """What a viewer costs a training: each ``viewer-CAPTURE.json`` is what `turbogs bench viewer --out` wrote."""
    lines, places = [], []
    for file in sorted(folder.glob("viewer-*.json")):
        measured = json.loads(file.read_text())
        ways = {row.way: row for row in summarised(measured)}
        alone, client = ways["without"], ways["client"]
        runs = measured["runs"]
        gaussians, iterations = (statistics.median(run[key] for run in runs) for key in ("gaussians", "iterations"))
        lines.append(
            (
                measured["scene"],
                f"{iterations:.0f}",
                f"{gaussians / 1e3:.0f}k",
                f"{statistics.median(alone.rates):.0f}",
                ways["nobody looks"].change_text(),
                client.change_text(),
                f"{client.frame_rate:.1f}",
                f"{client.width:.0f}",
            )
        )
        places.append(where(measured))
    if not lines:
        return ABSENT
    header = ("capture", "iterations", "Gaussians", "iterations a second, without", "nobody looks")
    header += ("a client that moves", "its frames a second", "pixels wide")
    return f"{'; '.join(dict.fromkeys(places))}.\n\n{table(header, lines)}"


def exports(file: Path = EXPORTS) -> str:
    """Every format of a run's model: its bytes, and what was lost."""
    if not file.exists():
        return ABSENT
    record = json.loads(file.read_text())
    lines = [(name, *_export(entry, record)) for name, entry in record["exports"].items()]
    film = record["film"]
    said = (
        f"{where(record)}; the model of `turbogs train {record['scene']}`, {record['gaussians']:,} Gaussians, "
        f"{record['held_bytes'] / 1e6:.1f} MB in float32. A film along its {film['path']}, {film['frames']} frames, "
        f"took {film['seconds']:.1f} s and has {film['bytes'] / 1e6:.1f} MB."
    )
    header = ("format", "MB", "Gaussians", "PSNR in dB before", "lost", "in the worst view", "s")
    return f"{wrapped(said)}\n\n{table(header, lines)}"


def _export(entry: dict[str, Any], record: dict[str, Any]) -> tuple[str, ...]:
    change = entry["change"]
    kept = "all" if entry["gaussians"] == record["gaussians"] else f"{entry['gaussians']:,}"
    losses = (change["before"] - change["after"], change["worst_loss"])
    lost = (f"{round(value, 3) + 0.0:.3f}" for value in losses)  # no -0.000
    size, seconds = f"{entry['bytes'] / 1e6:.1f}", f"{entry['seconds']:.1f}"
    return size, kept, f"{change['before']:.2f}", *lost, seconds


def render_caption(file: Path = PICTURES) -> str | None:
    """Below README's first picture; None where that was made without a record."""
    if not file.exists():
        return None
    record = json.loads(file.read_text())
    machine, scene = record["provenance"]["machine"].partition(" (")[0], record["scene"]
    named = f"{scene}, {CAPTURES[scene]}," if scene in CAPTURES else scene
    factor = f" --factor {record['factor']}" if record["factor"] > 1 else ""
    return wrapped(
        f"*A render of {named} from the camera of one of its {record['training_views']} training views: "
        f"{record['gaussians']:,} Gaussians, {record['iteration']} iterations, {record['train_seconds']:.1f} s of "
        f"training on one {machine}; {record['psnr']:.2f} dB on the test views. "
        f"`turbogs train {scene} --out RUN{factor}`; `python docs/make_pictures.py RUN {record['view']}` makes both "
        "pictures.*"
    )


def overlays_caption(file: Path = PICTURES) -> str | None:
    """Below README's second picture; None where that was made without a record."""
    early = json.loads(file.read_text()).get("early") if file.exists() else None
    if early is None:
        return None
    width, height = early["part"]
    return wrapped(
        f"*The {width}x{height} pixels in the middle of that view, after {early['iteration']} iterations. Left: its "
        f"error map. Right: the {100 * early['share']:.0f} % of the view's pixels that this iteration samples, over "
        "the render: the same number in each 16x16 tile, and in a tile mostly those with large errors, or that were "
        "not sampled for a long time.*"
    )


def wrapped(text: str) -> str:
    """A paragraph of a page."""
    return textwrap.fill(text, 120, break_on_hyphens=False, break_long_words=False)
