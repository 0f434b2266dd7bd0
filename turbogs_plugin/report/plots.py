"""Pictures of a report: error against seconds, and strips of ground truth, render and error."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from PIL import Image
from torch import Tensor

from turbogs_plugin.train.history import Evaluation

STYLE = {
    "figure.dpi": 120,
    "font.size": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "lines.linewidth": 1.8,
    "lines.markersize": 5,
}

SECONDS_LABEL = "training time in seconds (evaluation excluded)"

ERROR_FULL_SCALE = 0.25
"""Mean absolute error over RGB at which an error map has its brightest colour."""

FAINTEST = 0.1
"""Place of the farthest depth on the scale of colours, 0 .. 1: it can be told from black."""

GAP = 6
"""White pixels between the pictures of a strip."""


def plot_against_seconds(path: Path, history: list[Evaluation], name: str, label: str, title: str) -> None:
    """One measure of a history against seconds of training, as a PNG.

    Args:
        path: the file.
        history: of one run.
        name: field of `Evaluation`.
        label: of the vertical axis, with the unit.
        title: of the plot.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 4.0), layout="constrained")
        axes = figure.add_subplot()
        seconds = [evaluation.train_seconds for evaluation in history]
        values = [getattr(evaluation, name) for evaluation in history]
        axes.plot(seconds, values, marker="o", color="#1f5fa8")
        axes.annotate(
            f"{values[-1]:.2f}" if abs(values[-1]) >= 1 else f"{values[-1]:.4f}",
            (seconds[-1], values[-1]),
            xytext=(0, 8),
            textcoords="offset points",
            ha="right",
        )
        axes.set(xlabel=SECONDS_LABEL, ylabel=label, title=title)
        axes.set_xlim(left=0)
        axes.margins(y=0.12)
        figure.savefig(path)


def save_strip(path: Path, photo: Tensor, image: Tensor) -> None:
    """Ground truth, render and error map side by side, as a PNG.

    Args:
        path: the file; its folder exists.
        photo, image: [H, W, 3] float, 0 .. 1.
    """
    pictures = [to_uint8(photo), to_uint8(image), error_picture(photo, image)]
    white = np.full((photo.shape[0], GAP, 3), 255, dtype=np.uint8)
    Image.fromarray(np.concatenate([pictures[0], white, pictures[1], white, pictures[2]], axis=1)).save(path)


def error_picture(photo: Tensor, image: Tensor) -> np.ndarray:
    """[H, W, 3] uint8: mean absolute error over RGB, black (none) to bright yellow (`ERROR_FULL_SCALE` and more)."""
    errors = (photo - image).abs().mean(dim=-1).cpu().numpy() / ERROR_FULL_SCALE  # [H, W]
    return _colored(errors.clip(0.0, 1.0))


def depth_picture(depths: np.ndarray) -> np.ndarray:
    """[H, W, 3] uint8 of depths [H, W]: near is bright, far is dark, and what has no depth (0) is black.

    The scale of colours is even in 1 / depth, so that near depths have most of it, and goes from the 1st to the 99th
    percentile of 1 / depth in this image.
    """
    seen = depths > 0
    if not seen.any():
        return np.zeros((*depths.shape, 3), dtype=np.uint8)
    nearness = 1.0 / np.where(seen, depths, 1.0)
    far, near = np.percentile(nearness[seen], [1, 99])
    share = ((nearness - far) / max(near - far, np.finfo(np.float32).tiny)).clip(0.0, 1.0)
    return _colored(FAINTEST + (1.0 - FAINTEST) * share) * seen[..., None]


def _colored(share: np.ndarray) -> np.ndarray:
    """[H, W, 3] uint8: black (0) to bright yellow (1)."""
    colors = matplotlib.colormaps["inferno"](share)[..., :3]
    return (colors * 255.0).round().astype(np.uint8)


def to_uint8(image: Tensor) -> np.ndarray:
    """[H, W, 3] uint8 of an image of floats 0 .. 1."""
    return (image.clamp(0.0, 1.0) * 255.0).round().byte().cpu().numpy()
