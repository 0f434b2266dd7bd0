"""The formats that a model is written in and read from, in the capture's own coordinates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from turbogs_plugin.model.gsplat_file import read_gsplat, save_gsplat
from turbogs_plugin.model.packed import read_compressed_ply, read_splat, save_by_gsplat
from turbogs_plugin.model.ply import read_ply, save_ply
from turbogs_plugin.model.spz import read_spz, save_spz
from turbogs_plugin.model.torch_file import load_plain
from turbogs_plugin.scene.frame import Frame
from turbogs_plugin.types import Gaussians


@dataclass(frozen=True)
class Format:
    """A format of files.

    Args:
        suffix: of its files.
        write: is given the model, the new file, the frame of the model's coordinates, and the iterations of its
            training. The file is written whole or not at all.
        read: the model in float64, in the file's own coordinates.
    """

    suffix: str
    write: Callable[[Gaussians, Path, Frame, int], None]
    read: Callable[[Path], Gaussians]


FORMATS = {
    "ply": Format(".ply", lambda model, path, frame, step: save_ply(model, path, frame), read_ply),
    "pt": Format(".pt", save_gsplat, lambda path: read_gsplat(load_plain(path), path)),
    "compressed-ply": Format(".compressed.ply", partial(save_by_gsplat, "ply_compressed"), read_compressed_ply),
    "splat": Format(".splat", partial(save_by_gsplat, "splat"), read_splat),
    "spz": Format(".spz", save_spz, read_spz),
}
"""Name, as on the command line -> the format. A file is read by the format whose name its suffix is; a compressed .ply
is told from others by its header."""
