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

Code = Callable[[np.ndarray], np.ndarray]
CHUNK = 256
"""Gaussians that share their bounds in a compressed .ply."""
LEAST_OPACITY = 1.0 / 255.0
"""gsplat's exporter leaves out of a compressed .ply what is not above it."""
SPLAT_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("quat", "u1", 4)])
BOUNDS = [
    f"{end}_{axis}" for kind in ("", "scale_") for end in ("min", "max") for axis in (f"{kind}{a}" for a in "xyz")
]
COLOR_BOUNDS = [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
"""Older files lack these: their colours lie between 0 and 1."""
WORDS = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]


def save_by_gsplat(kind: str, gaussians: Gaussians, path: Path, frame: Frame, step: int = 0) -> None:
    """Write a model by gsplat's exporter, whole or not at all, in the capture's own coordinates.

    Args:
        kind: ``splat``, which keeps no harmonics above degree 0, or ``ply_compressed``. Both sort the Gaussians;
            the second leaves out those of an opacity of 1/255 or less.
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
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from None
    if not content or len(content) % SPLAT_ROW.itemsize:
        said = f"{path} is not a .splat: its {len(content)} bytes are no rows of {SPLAT_ROW.itemsize}"
        raise InputError(f"{said}; export it again, or name another file")
    rows = np.frombuffer(content, dtype=SPLAT_ROW)
    shares = rows["color"].astype(np.float64) / 255.0
    return unpacked_model(
        means=rows["mean"],
        quats=(rows["quat"].astype(np.float64) - 128.0) / 128.0,
        scales=np.log(np.maximum(rows["scale"], 1e-30)),
        shares=shares[:, 3],
        sh0=(shares[:, :3] - 0.5) / SH_C0,
        shN=np.zeros((len(rows), 0, 3)),
    )


def read_compressed_ply(path: Path) -> Gaussians:
    """The model of a compressed ``.ply`` as gsplat or SuperSplat writes it; float64, on the CPU.

    Raises:
        InputError: the file is no such one.
    """
    header, offset = read_header(path)
    body = path.read_bytes()[offset:]
    elements: dict[str, tuple[int, list[str]]] = {}
    try:
        for line in header:
            words = line.split()
            if words[:1] == ["element"]:
                elements[words[1]] = (int(words[2]), [])
            elif words[:1] == ["property"]:
                elements[list(elements)[-1]][1].append(words[-1])
        (chunks, bounds), (count, words) = elements["chunk"], elements["vertex"]
        if sorted(bounds) not in (sorted(BOUNDS), sorted(BOUNDS + COLOR_BOUNDS)) or words != WORDS:
            raise ValueError
    except (ValueError, KeyError, IndexError):
        raise InputError(f"{path} is not a compressed .ply of Gaussians: export it again") from None
    also, rest = elements.get("sh", (count, []))  # SuperSplat leaves it out where there are no harmonics
    sizes = (4 * len(bounds) * chunks, 4 * len(WORDS) * count, len(rest) * count)
    shaped = (also, chunks) == (count, -(-count // CHUNK))
    if not (count and shaped and len(rest) in (0, 9, 24, 45) and len(body) == sum(sizes)):
        raise InputError(f"{path} is not a whole compressed .ply of Gaussians: export it again")
    limits = np.frombuffer(body[: sizes[0]], dtype="<f4").reshape(chunks, len(bounds)).astype(np.float64)
    of_row = limits[np.arange(count) // CHUNK]  # [N, 18], or [N, 12] without those of colours
    column = {name: np.full(count, float(name.startswith("max"))) for name in COLOR_BOUNDS}
    column |= {name: of_row[:, place] for place, name in enumerate(bounds)}
    position, rotation, scale, color = np.frombuffer(body[sizes[0] : sizes[0] + sizes[1]], dtype="<u4").reshape(-1, 4).T

    def spread(shares: list[np.ndarray], names: str, kind: str = "") -> np.ndarray:
        """[N, 3] between the bounds of the row's chunk."""
        lows, highs = ([column[f"{end}_{kind}{name}"] for name in names] for end in ("min", "max"))
        return np.stack([low + share * (high - low) for low, high, share in zip(lows, highs, shares, strict=True)], 1)

    colors = [(color >> shift & 255) / 255.0 for shift in (24, 16, 8, 0)]
    codes = np.frombuffer(body[sizes[0] + sizes[1] :], dtype=np.uint8).reshape(count, 3, len(rest) // 3)
    return unpacked_model(
        means=spread(_thirds(position), "xyz"),
        quats=unpacked_rotations(rotation, even_component),
        scales=spread(_thirds(scale), "xyz", "scale_"),
        shares=colors[3],
        sh0=(spread(colors[:3], "rgb") - 0.5) / SH_C0,
        shN=((codes + 0.5) / 256.0 - 0.5).transpose(0, 2, 1) * 8.0,
    )


def _thirds(words: np.ndarray) -> list[np.ndarray]:
    """Three numbers 0 .. 1 of 11, 10 and 11 bits."""
    return [(words >> 21) / 2047.0, (words >> 11 & 1023) / 1023.0, (words & 2047) / 2047.0]


def packed_rotations(quats: np.ndarray, encode: Code) -> np.ndarray:
    """[N] uint32 of [N, 4] quaternions of any norm: the place of the largest component in 2 bits, then the others in
    order in 10 bits each.

    Args:
        encode: 0 .. 1023 for components within +-1 / sqrt(2).
    """
    unit = quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-30)
    largest = np.abs(unit).argmax(axis=1)
    unit = np.where(np.take_along_axis(unit, largest[:, None], axis=1) < 0, -unit, unit)
    words = largest.astype(np.uint32)
    for place in range(4):
        code = encode(unit[:, place]).astype(np.uint32)
        words = np.where(largest == place, words, words << np.uint32(10) | code)
    return words.astype("<u4")


def unpacked_rotations(words: np.ndarray, decode: Code) -> np.ndarray:
    """[N, 4] of `packed_rotations`, with the inverse of its `encode`."""
    largest = words >> 30
    found = np.zeros((len(words), 4))
    for place in (3, 2, 1, 0):
        stored = largest != place
        found[:, place] = np.where(stored, decode(words & 1023), 0.0)
        words = np.where(stored, words >> 10, words)
    rest = np.sqrt(np.maximum(0.0, 1.0 - np.square(found).sum(axis=1)))
    np.put_along_axis(found, largest[:, None].astype(np.int64), rest[:, None], axis=1)
    return found


def even_code(components: np.ndarray) -> np.ndarray:
    """Components in even steps from -1 / sqrt(2) to 1 / sqrt(2)."""
    return np.rint((components / np.sqrt(2.0) + 0.5) * 1023.0).clip(0, 1023)


def even_component(codes: np.ndarray) -> np.ndarray:
    """The component of an `even_code`."""
    return (codes / 1023.0 - 0.5) * np.sqrt(2.0)


def unpacked_model(
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    shares: np.ndarray,
    sh0: np.ndarray,
    shN: np.ndarray,
    least: float = 1e-4,
) -> Gaussians:
    """A model in float64. Arguments as in `Gaussians`, but for `sh0` [N, 3] and the opacities: `shares` [N] of 0 .. 1,
    which are brought to within `least` .. 1 - `least`."""
    inside = shares.clip(least, 1.0 - least)
    arrays = (means, quats, scales, np.log(inside / (1.0 - inside)), sh0[:, None], shN)
    return Gaussians(*(torch.from_numpy(np.ascontiguousarray(array, dtype=np.float64)) for array in arrays))
