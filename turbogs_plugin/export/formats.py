"""The formats that a model is written in: how each is written, in the capture's own coordinates, and read back."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from turbogs_plugin.errors import InputError
from turbogs_plugin.export.gsplat_formats import read_compressed_ply, read_splat, save_by_gsplat
from turbogs_plugin.export.spz import read_spz, save_spz
from turbogs_plugin.model.gsplat_file import LARGEST_ROUNDING, read_gsplat, save_gsplat
from turbogs_plugin.model.ply import read_ply, save_ply
from turbogs_plugin.model.similarity import Similarity, finite_rows
from turbogs_plugin.model.torch_file import load_plain
from turbogs_plugin.scene.frame import Frame
from turbogs_plugin.types import Gaussians

Writer = Callable[[Gaussians, Path, Frame, int], None]
"""Given the model, the new file, the frame of the model's coordinates, and the iterations of its training."""


@dataclass(frozen=True)
class Format:
    """A format of files.

    Args:
        suffix: of its files.
        write: the file is written whole or not at all.
        read: the model in float64, in the file's own coordinates.
    """

    suffix: str
    write: Writer
    read: Callable[[Path], Gaussians]


def in_capture(gaussians: Gaussians, frame: Frame, kind: str) -> Gaussians:
    """The finite Gaussians of a model in the capture's own coordinates, float32 on the CPU.

    Raises:
        InputError: none is left, or the capture lies too far from its origin for float32.
    """
    rows = gaussians.map(lambda value: value.detach().cpu())
    finite = finite_rows(rows)
    rows = rows.map(lambda value: value[finite])
    if not len(rows):
        raise InputError("there are no Gaussians to write")
    if np.abs(frame.center).max() * np.finfo(np.float32).eps / 2 > LARGEST_ROUNDING * frame.scale:
        raise InputError(
            f"the capture lies {np.abs(frame.center).max():.3g} units from its origin, too far for the single "
            f"precision of {kind}: export with --format ply"
        )
    rows.means = torch.from_numpy(frame.restore_points(rows.means.numpy())).float()
    rows.scales = rows.scales + math.log(frame.scale)
    return rows.map(torch.Tensor.contiguous)


def _by_gsplat(gaussians: Gaussians, path: Path, frame: Frame, step: int, kind: str) -> None:
    save_by_gsplat(in_capture(gaussians, frame, "splat" if kind == "splat" else "compressed-ply"), path, kind)


FORMATS = {
    "ply": Format(".ply", lambda model, path, frame, step: save_ply(model, path, frame), read_ply),
    "pt": Format(".pt", save_gsplat, lambda path: read_gsplat(load_plain(path), path)),
    "compressed-ply": Format(".compressed.ply", partial(_by_gsplat, kind="ply_compressed"), read_compressed_ply),
    "splat": Format(".splat", partial(_by_gsplat, kind="splat"), read_splat),
    "spz": Format(".spz", lambda model, path, frame, step: save_spz(in_capture(model, frame, "spz"), path), read_spz),
}
"""Name, as on the command line -> the format."""

PAGE = "html"
"""The name of the page with everything in it, which is no format of models."""


def require_format(name: str) -> None:
    """Raise `InputError` unless there is such a format."""
    if name not in (*FORMATS, PAGE):
        raise InputError(f"--format {name}: there is no such format; choose one of {', '.join((*FORMATS, PAGE))}")


def written_and_read(name: str, gaussians: Gaussians, path: Path, frame: Frame, step: int) -> Gaussians:
    """Write a model and read the file again.

    Returns:
        What the file holds, in the model's own coordinates: float32, on the CPU.
    """
    FORMATS[name].write(gaussians, path, frame, step)
    return Similarity.into(frame).apply(FORMATS[name].read(path)).map(lambda value: value.float().contiguous())
