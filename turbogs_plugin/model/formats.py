"""The formats that a model is written in and read from, in the capture's own coordinates."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from turbogs_plugin.model.ply import read_ply, save_ply
from turbogs_plugin.model.spz import read_spz, save_spz
from turbogs_plugin.model.torch_file import read_gsplat, read_plain, save_gsplat
from turbogs_plugin.scene.frame import Frame
from turbogs_plugin.types import Gaussians

Write = Callable[[Gaussians, Path, Frame, int, bool], None]
"""Writes a model to a file, whole or not at all, in the capture's own coordinates (`in_capture`, with its errors): of
the frame of the model's coordinates, the iterations of its training and whether it is drawn with antialiasing, what the
format has a place for."""
Read = Callable[[Path], tuple[Gaussians, bool]]
"""Reads a model in float64, in the file's own coordinates, and whether the file says that it is drawn with
antialiasing. Raises `InputError`."""
FORMATS: dict[str, tuple[Write, Read]] = {
    "ply": (save_ply, read_ply),
    "pt": (save_gsplat, lambda path: (read_gsplat(read_plain(path, f"'{path}'"), path), False)),
    "spz": (save_spz, read_spz),
}
"""Name, as on the command line and as the suffix of its files -> the format."""
