"""Formats of a few bytes a number: ``.splat`` and compressed ``.ply``, written by gsplat's exporter (Apache-2.0), which
reads neither; and what they share with .spz: rotations without their largest component, and logits from shares."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from turbogs_plugin.errors import InputError
from turbogs_plugin.files import write_atomically
from turbogs_plugin.model.similarity import in_capture
from turbogs_plugin.scene.frame import Frame
from turbogs_plugin.scene.ply import read_header
from turbogs_plugin.types import SH_C0, Gaussians

CHUNK = 256
"""Gaussians that share their bounds in a compressed .ply."""
LEAST_OPACITY = 1.0 / 255.0
"""gsplat's exporter leaves out of a compressed .ply what is not above it."""
SPLAT_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("quat", "u1", 4)])
PLY_TYPES = {"float": "<f4", "uint": "<u4", "uchar": "u1"}
"""Type of a property in a compressed .ply -> numpy's."""


def save_by_gsplat(kind: str, gaussians: Gaussians, path: Path, frame: Frame, step: int = 0) -> None:
    """Write a model by gsplat's exporter, whole or not at all, in the capture's own coordinates.

    Args:
        kind: ``splat``, which keeps no harmonics above degree 0, or ``ply_compressed``. Both sort the Gaussians;
            the second leaves out Gaussians of an opacity of 1/255 or less.
        gaussians, path, frame: as for `in_capture`.
        step: has no place in these formats.

    Raises:
        InputError: there is nothing to write, or the capture lies too far from its origin for float32.
    """
    from gsplat import export_splats

    rows = in_capture(gaussians, frame, path)
    if kind == "ply_compressed" and not (torch.sigmoid(rows.opacities) > LEAST_OPACITY).any():
        raise InputError(f"no Gaussian has an opacity above 1/255, {path} would be empty: export with --format ply")
    content = export_splats(**dict(rows.items()), format=kind)
    write_atomically(path, lambda file: file.write(content))


def read_splat(path: Path) -> Gaussians:
    """The model of a ``.splat``; float64, on the CPU. Raises `InputError` where the file is no such one."""
    try:
        rows = np.frombuffer(path.read_bytes(), dtype=SPLAT_ROW)
        shares = rows["color"].astype(np.float64) / 255.0
        return unpacked_model(
            means=rows["mean"],
            quats=(rows["quat"].astype(np.float64) - 128.0) / 128.0,
            scales=np.log(np.maximum(rows["scale"], 1e-30)),
            shares=shares[:, 3],
            sh0=(shares[:, :3] - 0.5) / SH_C0,
            shN=np.zeros((len(rows), 0, 3)),
        )
    except (OSError, ValueError):
        said = f"{path} cannot be read as a .splat, which is rows of {SPLAT_ROW.itemsize}"
        raise InputError(f"{said}; export it again, or name another file") from None


def read_compressed_ply(path: Path) -> Gaussians:
    """The model of a compressed ``.ply`` as gsplat or SuperSplat writes it; float64, on the CPU.

    Raises:
        InputError: the file is no such one.
    """
    header, start = read_header(path)
    content = path.read_bytes()
    elements: dict[str, tuple[int, list[tuple[str, str]]]] = {}
    tables: dict[str, np.ndarray] = {}
    try:
        for line in header:
            match line.split():
                case ["element", name, count]:
                    fields: list[tuple[str, str]] = []
                    elements[name] = (int(count), fields)
                case ["property", kind, name]:
                    fields.append((name, PLY_TYPES[kind]))
        for name, (length, fields) in elements.items():
            tables[name] = np.frombuffer(content, np.dtype(fields), length, start)
            start += tables[name].nbytes
        return _uncompressed(tables)
    except (ValueError, KeyError, IndexError, UnboundLocalError):
        raise InputError(f"{path} is not a compressed .ply of Gaussians, or not whole: export it again") from None


def _uncompressed(tables: dict[str, np.ndarray]) -> Gaussians:
    """The model of a compressed .ply's elements. Raises ValueError, KeyError or IndexError where they are others."""
    rows = tables["vertex"]
    bounds = tables["chunk"][np.arange(len(rows)) // CHUNK]  # [N]
    harmonics = tables.get("sh", np.zeros((len(rows), 0), dtype=np.uint8))  # SuperSplat leaves out what is empty
    codes = harmonics.view(np.uint8).reshape(len(rows), 3, -1)  # [N, 3, B]

    def spread(shares: list[np.ndarray], *names: str) -> np.ndarray:
        """[N, 3] between the bounds of the row's chunk."""
        limits = ((bounds[f"min_{name}"].astype(np.float64), bounds[f"max_{name}"]) for name in names)
        return np.stack([low + share * (high - low) for (low, high), share in zip(limits, shares, strict=True)], 1)

    colors = [(rows["packed_color"] >> shift & 255) / 255.0 for shift in (24, 16, 8, 0)]
    return unpacked_model(
        means=spread(_thirds(rows["packed_position"]), "x", "y", "z"),
        quats=unpacked_rotations(rows["packed_rotation"], lambda codes: (codes / 1023.0 - 0.5) * np.sqrt(2.0)),
        scales=spread(_thirds(rows["packed_scale"]), "scale_x", "scale_y", "scale_z"),
        shares=colors[3],
        sh0=(spread(colors[:3], "r", "g", "b") - 0.5) / SH_C0,
        shN=((codes + 0.5) / 256.0 - 0.5).transpose(0, 2, 1) * 8.0,
    )


def _thirds(words: np.ndarray) -> list[np.ndarray]:
    """Three numbers 0 .. 1 of 11, 10 and 11 bits."""
    return [(words >> 21) / 2047.0, (words >> 11 & 1023) / 1023.0, (words & 2047) / 2047.0]


def unpacked_rotations(words: np.ndarray, decode: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """[N, 4] unit quaternions of [N] uint32: the place of the largest component in 2 bits, then the other components in
    their order in 10 bits each.

    Args:
        decode: a component within +-1 / sqrt(2) of 10 bits.
    """
    largest = words >> 30
    found = np.zeros((len(words), 4))
    for place in (3, 2, 1, 0):
        stored = largest != place
        found[:, place] = np.where(stored, decode(words & 1023), 0.0)
        words = np.where(stored, words >> 10, words)
    rest = np.sqrt(np.maximum(0.0, 1.0 - np.square(found).sum(axis=1)))
    np.put_along_axis(found, largest[:, None].astype(np.int64), rest[:, None], axis=1)
    return found


def unpacked_model(
    means: np.ndarray, quats: np.ndarray, scales: np.ndarray, shares: np.ndarray, sh0: np.ndarray, shN: np.ndarray
) -> Gaussians:
    """A model in float64. Arguments as in `Gaussians`, but for `sh0` [N, 3] and the opacities: `shares` [N] of 0 .. 1,
    which are brought to within 1e-4 .. 1 - 1e-4.

    Raises:
        ValueError: no Gaussian, or harmonics of no degree 0 .. 3.
    """
    if not len(means) or shN.shape[1] not in (0, 3, 8, 15):
        raise ValueError("no Gaussians, or harmonics of an unknown degree")
    inside = shares.clip(1e-4, 1.0 - 1e-4)
    arrays = (means, quats, scales, np.log(inside / (1.0 - inside)), sh0[:, None], shN)
    return Gaussians(*(torch.from_numpy(np.ascontiguousarray(array, dtype=np.float64)) for array in arrays))
