"""Reads the vertices of a .ply file by trimesh (MIT): plain numbers, binary or ASCII."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from turbogs_plugin.errors import InputError


class _AsciiLines(io.BufferedReader):
    """A file whose lines are ASCII: trimesh takes header lines for UTF-8, and comments may be in any encoding."""

    def readline(self, size: int | None = -1, /) -> bytes:
        return super().readline(size).decode("ascii", "replace").encode("ascii", "replace")


def read_vertices(path: str | Path) -> dict[str, np.ndarray]:
    """The ``vertex`` element of a .ply: property -> [N] values in the file's own type, in the file's order.

    trimesh allocates nothing before the file is known to be long enough for what its header announces. Raises
    `InputError` where there is no such file, its header or body is not as announced, or x, y and z lack."""
    from trimesh.exchange.ply import load_ply  # its import takes a second

    try:
        with _AsciiLines(io.FileIO(path)) as file, np.errstate(all="ignore"):
            vertices = load_ply(file, skip_materials=True)["metadata"]["_ply_raw"]["vertex"]
        count, types = vertices["length"], vertices["properties"]
        columns = {name: np.zeros(0, kind) for name, kind in types.items()}
        if count:  # [N] in a binary file, [N, 1] in ASCII
            columns = {name: vertices["data"][name].reshape(-1) for name in types}
        if any(column.shape != (count,) or column.dtype.kind not in "iuf" for column in columns.values()):
            raise ValueError("it is cut short, or a property is not a single number")
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    except Exception as error:  # of many kinds, for malformed files
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        if reason in ("no field of name x", "'x'"):
            reason = "it has no x, y, z: of a compressed model, take what  npx @playcanvas/splat-transform  makes of it"
        elif Path(path).read_bytes().startswith(b"version https://git-lfs"):
            reason = "it is a pointer of Git LFS: fetch it by 'git lfs pull'"
        raise InputError(f"{path} is not a whole .ply file of vertices ({reason}): copy or export it again") from None
    return columns


def read_colors(path: Path, vertices: dict[str, np.ndarray]) -> np.ndarray | None:
    """[N, 3] uint8 red, green and blue of the vertices; None where there are none. `InputError` unless finite.

    Numbers of 8 bits are taken as they are. The type of others does not say what white is. Of whole numbers it is
    65535 where one is above 255. Of floats it is 1, unless their mean is above that: a few may be a bit above white.
    Otherwise it is 255.
    """
    channels = ("red", "green", "blue")
    if not set(channels) <= set(vertices):
        return None
    given = np.stack([vertices[channel] for channel in channels], axis=1)
    if given.dtype.itemsize == 1 or not len(given):
        return given.astype(np.uint8)
    values = given.astype(np.float64)
    bad = ~np.isfinite(values).all(axis=1)
    if bad.any():
        raise InputError(f"{path}: the colours of {bad.sum()} of {len(values)} points are not finite: export it again")
    white = 65535.0 if values.max() > 255.0 else 255.0
    if given.dtype.kind == "f":
        white = 1.0 if values.mean() <= 1.0 else 255.0
    return np.rint((values / white * 255.0).clip(0.0, 255.0)).astype(np.uint8)
