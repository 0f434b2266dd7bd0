"""``.splat`` and compressed ``.ply``, written by gsplat's exporter (Apache-2.0). It reads neither, so that is here."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch

from turbogs_plugin.errors import InputError
from turbogs_plugin.files import write_atomically
from turbogs_plugin.types import SH_C0, Gaussians

CHUNK = 256
"""Gaussians that share their bounds in a compressed .ply."""
SPLAT_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("quat", "u1", 4)])
BOUNDS = [
    f"{end}_{axis}" for kind in ("", "scale_") for end in ("min", "max") for axis in (f"{kind}{a}" for a in "xyz")
]
BOUNDS += [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
WORDS = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]


def save_by_gsplat(gaussians: Gaussians, path: Path, kind: str) -> None:
    """Write a model by gsplat's exporter, whole or not at all.

    Args:
        gaussians: finite, float32, on the CPU.
        path: its folder exists.
        kind: ``splat``, which keeps no harmonics above degree 0, or ``ply_compressed``. Both sort the Gaussians;
            the second leaves out those of an opacity of 1/255 or less.
    """
    from gsplat import export_splats

    content = export_splats(**dict(gaussians.items()), format=kind)
    write_atomically(path, lambda file: file.write(content))


def read_splat(path: Path) -> Gaussians:
    """The model of a ``.splat``; float64, on the CPU. Raises `InputError` where the file is no such one."""
    content = _content(path)
    if not content or len(content) % SPLAT_ROW.itemsize:
        raise InputError(f"{path} is not a .splat: its {len(content)} bytes are no rows of {SPLAT_ROW.itemsize}")
    rows = np.frombuffer(content, dtype=SPLAT_ROW)
    shares = rows["color"].astype(np.float64) / 255.0
    return _model(
        means=rows["mean"],
        quats=(rows["quat"].astype(np.float64) - 128.0) / 128.0,
        scales=np.log(np.maximum(rows["scale"], 1e-30)),
        shares=shares[:, 3],
        colors=shares[:, :3],
        harmonics=np.zeros((len(rows), 0, 3)),
    )


def read_compressed_ply(path: Path) -> Gaussians:
    """The model of a compressed ``.ply`` as gsplat writes it; float64, on the CPU.

    Raises:
        InputError: the file is no such one.
    """
    content = _content(path)
    header, separator, body = content.partition(b"end_header\n")
    elements: dict[str, tuple[int, list[str]]] = {}
    try:
        for line in header.decode("ascii").splitlines():
            words = line.split()
            if words[:1] == ["element"]:
                elements[words[1]] = (int(words[2]), [])
            elif words[:1] == ["property"]:
                elements[list(elements)[-1]][1].append(words[-1])
        (chunks, bounds), (count, words), (also, rest) = (elements[name] for name in ("chunk", "vertex", "sh"))
    except (ValueError, KeyError, IndexError, UnicodeDecodeError):
        raise InputError(f"{path} is not a compressed .ply of Gaussians: export it again") from None
    sizes = (4 * len(BOUNDS) * chunks, 4 * len(WORDS) * count, len(rest) * count)
    shaped = (sorted(bounds), words, also, chunks) == (sorted(BOUNDS), WORDS, count, -(-count // CHUNK))
    if not (separator and count and shaped and len(rest) in (0, 9, 24, 45) and len(body) == sum(sizes)):
        raise InputError(f"{path} is not a whole compressed .ply of Gaussians: export it again")
    limits = np.frombuffer(body[: sizes[0]], dtype="<f4").reshape(chunks, len(BOUNDS)).astype(np.float64)
    of_row = limits[np.arange(count) // CHUNK]  # [N, 18]
    column = {name: of_row[:, place] for place, name in enumerate(bounds)}
    position, rotation, scale, color = np.frombuffer(body[sizes[0] : sizes[0] + sizes[1]], dtype="<u4").reshape(-1, 4).T

    def spread(shares: list[np.ndarray], names: str, kind: str = "") -> np.ndarray:
        """[N, 3] between the bounds of the row's chunk."""
        lows, highs = ([column[f"{end}_{kind}{name}"] for name in names] for end in ("min", "max"))
        return np.stack([low + share * (high - low) for low, high, share in zip(lows, highs, shares, strict=True)], 1)

    colors = [(color >> shift & 255) / 255.0 for shift in (24, 16, 8, 0)]
    codes = np.frombuffer(body[sizes[0] + sizes[1] :], dtype=np.uint8).reshape(count, 3, len(rest) // 3)
    return _model(
        means=spread(_thirds(position), "xyz"),
        quats=_quaternions(rotation),
        scales=spread(_thirds(scale), "xyz", "scale_"),
        shares=colors[3],
        colors=spread(colors[:3], "rgb"),
        harmonics=((codes + 0.5) / 256.0 - 0.5).transpose(0, 2, 1) * 8.0,
    )


def _thirds(words: np.ndarray) -> list[np.ndarray]:
    """Three numbers 0 .. 1 of 11, 10 and 11 bits."""
    return [(words >> 21) / 2047.0, (words >> 11 & 1023) / 1023.0, (words & 2047) / 2047.0]


def _quaternions(words: np.ndarray) -> np.ndarray:
    """[N, 4] wxyz: the place of the largest component in 2 bits, the others in order in 10 bits each."""
    largest = (words >> 30).astype(np.int64)
    others = [((words >> shift & 1023) / 1023.0 - 0.5) * math.sqrt(2.0) for shift in (20, 10, 0)]
    found = np.zeros((len(words), 4))
    places = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]  # [N, 3]
    np.put_along_axis(found, places, np.stack(others, axis=1), axis=1)
    rest = np.sqrt(np.maximum(0.0, 1.0 - np.square(found).sum(axis=1)))
    np.put_along_axis(found, largest[:, None], rest[:, None], axis=1)
    return found


def _model(
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    shares: np.ndarray,
    colors: np.ndarray,
    harmonics: np.ndarray,
) -> Gaussians:
    """A model of opacities 0 .. 1 ([N] `shares`) and colours ([N, 3])."""
    inside = shares.clip(1e-4, 1 - 1e-4)
    arrays = (means, quats, scales, np.log(inside / (1 - inside)), ((colors - 0.5) / SH_C0)[:, None], harmonics)
    return Gaussians(*(torch.from_numpy(np.ascontiguousarray(array, dtype=np.float64)) for array in arrays))


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from None
