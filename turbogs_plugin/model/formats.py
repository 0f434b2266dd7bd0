"""The formats that a model is written in and read from, in the capture's own coordinates."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from turbogs_plugin.model.ply import is_antialiased_ply, read_ply, save_ply
from turbogs_plugin.model.spz import is_antialiased_spz, read_spz, save_spz
from turbogs_plugin.model.torch_file import read_gsplat, read_plain, save_gsplat
from turbogs_plugin.scene.frame import Frame
from turbogs_plugin.types import Gaussians

Write = Callable[[Gaussians, Path, Frame, int, bool], None]
"""Writes a model to a file, whole or not at all, in the capture's own coordinates (`in_capture`, with its errors): of
the frame of the model's coordinates, the iterations of its training and whether it is drawn with antialiasing, what the
format has a place for."""
Read = Callable[[Path], Gaussians]
"""Reads a model in float64, in the file's own coordinates. Raises `InputError`."""


class Format(NamedTuple):
    """A format of files. `is_antialiased` is what a file that was read says of it."""

    write: Write
    read: Read
    is_antialiased: Callable[[Path], bool] = lambda path: False


FORMATS = {
    "ply": Format(save_ply, read_ply, is_antialiased_ply),
    "pt": Format(save_gsplat, lambda path: read_gsplat(read_plain(path, f"'{path}'"), path)),
    "spz": Format(save_spz, read_spz, is_antialiased_spz),
}
"""Name, as on the command line and as the suffix of its files -> the format."""
