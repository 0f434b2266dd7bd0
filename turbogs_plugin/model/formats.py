"""The formats that a model is written in and read from, in the capture's own coordinates."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from turbogs_plugin.model.gsplat_file import read_gsplat, save_gsplat
from turbogs_plugin.model.ply import read_ply, save_ply
from turbogs_plugin.model.spz import read_spz, save_spz
from turbogs_plugin.model.torch_file import read_plain
from turbogs_plugin.scene.frame import Frame
from turbogs_plugin.types import Gaussians


class Format(NamedTuple):
    """A format of files. `write` is given the model, the new file, the frame of the model's coordinates and the
    iterations of its training, and writes the file whole or not at all; `read` gives the model in float64, in the
    file's own coordinates."""

    write: Callable[[Gaussians, Path, Frame, int], None]
    read: Callable[[Path], Gaussians]


FORMATS = {
    "ply": Format(lambda model, path, frame, step: save_ply(model, path, frame), read_ply),
    "pt": Format(save_gsplat, lambda path: read_gsplat(read_plain(path, f"'{path}'"), path)),
    "spz": Format(save_spz, read_spz),
}
"""Name, as on the command line and as the suffix of its files -> the format."""
