"""``.spz``, the compressed format of Niantic (https://github.com/nianticlabs/spz, MIT), in its version 3.

A gzip stream of a header of 16 bytes and of one array after the other: positions, opacities, colours, scales,
rotations, harmonics. Axes are x right, y up, z backward, where a capture's are x right, y down, z forward: so y and z
change their sign, in everything that depends on a direction. Version 4 needs another compressor; all readers of it read
version 3, too.
"""

from __future__ import annotations

import gzip
import math
import struct
import zlib
from pathlib import Path

import numpy as np
import torch

from turbogs_plugin.engine.reference.spherical_harmonics import basis
from turbogs_plugin.errors import InputError
from turbogs_plugin.files import write_atomically
from turbogs_plugin.types import Gaussians

MAGIC = 0x5053474E
VERSION = 3
HEADER = struct.Struct("<IIIBBBB")
"""Magic, version, number of Gaussians, degree, fractional bits of positions, flags, zero."""
MOST_FRACTIONAL_BITS = 20
COLOR_SCALE = 0.15
SH_SCALE = 128.0
"""A coefficient of the harmonics in steps of 1 / 128. Niantic's own writer drops three and four of the eight bits of
degree 1 and of those above, which a reader does not notice: the small coefficients of a capture whose cameras look one
way all became 0."""
LARGEST_COMPONENT = 511
"""Of a quaternion's three stored components: 9 bits and a sign, for 0 .. 1 / sqrt(2)."""
GZIP_LEVEL = 6
MOST_BYTES = 1 << 34
"""A file that unpacks to more is refused."""


def save_spz(gaussians: Gaussians, path: Path) -> None:
    """Write a model, whole or not at all.

    Args:
        gaussians: finite, in x right, y down, z forward; on the CPU.
        path: its folder exists.
    """
    write_atomically(path, lambda file: file.write(packed(gaussians)))


def packed(gaussians: Gaussians) -> bytes:
    """The file's bytes."""
    values = {name: value.detach().double().numpy() for name, value in gaussians.items()}
    largest = float(np.abs(values["means"]).max())
    bits = min(MOST_FRACTIONAL_BITS, 22 - max(0, math.ceil(math.log2(max(largest, 1e-9)))))
    if bits < 0:
        raise InputError(f"positions of {largest:.3g} units do not fit into a .spz: export with --format ply")
    fixed = np.rint(values["means"] * [1.0, -1.0, -1.0] * 2.0**bits).astype("<i4")  # [N, 3]
    opacities = 1.0 / (1.0 + np.exp(-values["opacities"]))
    harmonics = values["shN"] * _flips(gaussians.sh_degree)[:, None]  # [N, B, 3]
    parts = [
        HEADER.pack(MAGIC, VERSION, len(gaussians), gaussians.sh_degree, bits, 0, 0),
        fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3].tobytes(),
        _bytes(opacities * 255.0),
        _bytes(values["sh0"][:, 0] * (COLOR_SCALE * 255.0) + 127.5),
        _bytes((values["scales"] + 10.0) * 16.0),
        _packed_rotations(values["quats"]).tobytes(),
        _bytes(harmonics * SH_SCALE + 128.0),
    ]
    return gzip.compress(b"".join(parts), GZIP_LEVEL, mtime=0)


def read_spz(path: Path) -> Gaussians:
    """A model in x right, y down, z forward; float64, on the CPU.

    Raises:
        InputError: the file is not a whole one of this format, in version 2 or 3.
    """
    try:
        unpacker = zlib.decompressobj(wbits=31)
        content = unpacker.decompress(path.read_bytes(), MOST_BYTES)
    except (OSError, zlib.error) as error:
        raise InputError(f"cannot read {path} as .spz: {error}; export it again") from None
    if not unpacker.eof or len(content) < HEADER.size:
        raise InputError(f"{path} is not a whole .spz: export it again")
    magic, version, count, degree, bits, _, _ = HEADER.unpack_from(content)
    if magic != MAGIC or version not in (2, 3) or degree > 3:
        raise InputError(f"{path} is not a .spz of version 2 or 3 with harmonics up to degree 3: export it again")
    bands, turning = (degree + 1) ** 2 - 1, 4 if version == 3 else 3
    widths = (9, 1, 3, 3, turning, 3 * bands)
    if len(content) != HEADER.size + count * sum(widths):
        raise InputError(f"{path} does not hold the {count} Gaussians that it announces: export it again")
    ends = HEADER.size + count * np.cumsum((0, *widths))
    means, opacities, colors, scales, rotations, harmonics = (
        np.frombuffer(content[start:end], dtype=np.uint8).reshape(count, width)
        for start, end, width in zip(ends, ends[1:], widths, strict=False)
    )
    wide = np.zeros((count, 3, 4), dtype=np.uint8)
    wide[:, :, 1:] = means.reshape(count, 3, 3)  # in the upper bytes, so that the sign is theirs
    positions = (wide.view("<i4")[:, :, 0] >> 8) / 2.0**bits * [1.0, -1.0, -1.0]
    shares = (opacities[:, 0] / 255.0).clip(1e-4, 1 - 1e-4)
    values = {
        "means": positions,
        "quats": (_rotations_of_words if version == 3 else _rotations_of_bytes)(rotations),
        "scales": scales / 16.0 - 10.0,
        "opacities": np.log(shares / (1.0 - shares)),
        "sh0": ((colors / 255.0 - 0.5) / COLOR_SCALE)[:, None],
        "shN": (harmonics.reshape(count, bands, 3) - 128.0) / SH_SCALE * _flips(degree)[:, None],
    }
    return Gaussians(**{name: torch.from_numpy(np.ascontiguousarray(value)) for name, value in values.items()})


def _flips(degree: int) -> np.ndarray:
    """[B] signs of the harmonics where y and z change theirs: each function is even or odd in them together."""
    direction = torch.tensor([[0.3, 0.5, 0.8124038404635961]], dtype=torch.float64)
    mirrored = direction * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    return torch.sign(basis(direction, degree) * basis(mirrored, degree))[0].numpy()


def _packed_rotations(quats: np.ndarray) -> np.ndarray:
    """[N] uint32: the place of the largest of (x, y, z, w), then the others in order, each by sign and size."""
    ordered = quats[:, [1, 2, 3, 0]] * [1.0, -1.0, -1.0, 1.0]
    ordered = ordered / np.maximum(np.linalg.norm(ordered, axis=1, keepdims=True), 1e-30)
    largest = np.abs(ordered).argmax(axis=1)  # [N]
    ordered = np.where(np.take_along_axis(ordered, largest[:, None], axis=1) < 0, -ordered, ordered)
    words = largest.astype(np.uint32)
    for place in range(4):
        value = ordered[:, place]
        size = np.floor(LARGEST_COMPONENT * np.abs(value) * math.sqrt(2.0) + 0.5).clip(0, LARGEST_COMPONENT)
        component = (value < 0).astype(np.uint32) << np.uint32(9) | size.astype(np.uint32)
        words = np.where(largest == place, words, words << np.uint32(10) | component)
    return words.astype("<u4")


def _rotations_of_words(rotations: np.ndarray) -> np.ndarray:
    """[N, 4] wxyz of `_packed_rotations`, [N, 4] bytes."""
    words = np.ascontiguousarray(rotations).view("<u4")[:, 0]
    largest = words >> 30
    found = np.zeros((len(words), 4))
    for place in (3, 2, 1, 0):
        stored = largest != place
        size = (words & LARGEST_COMPONENT) / (LARGEST_COMPONENT * math.sqrt(2.0))
        found[:, place] = np.where(stored, np.where(words >> 9 & 1, -size, size), 0.0)
        words = np.where(stored, words >> 10, words)
    rest = np.sqrt(np.maximum(0.0, 1.0 - np.square(found).sum(axis=1)))
    np.put_along_axis(found, largest[:, None].astype(np.int64), rest[:, None], axis=1)
    return (found * [1.0, -1.0, -1.0, 1.0])[:, [3, 0, 1, 2]]


def _rotations_of_bytes(rotations: np.ndarray) -> np.ndarray:
    """[N, 4] wxyz of version 2: x, y and z in a byte each."""
    xyz = (rotations / 127.5 - 1.0) * [1.0, -1.0, -1.0]
    w = np.sqrt(np.maximum(0.0, 1.0 - np.square(xyz).sum(axis=1)))
    return np.concatenate([w[:, None], xyz], axis=1)


def _bytes(values: np.ndarray) -> bytes:
    return np.rint(values).clip(0, 255).astype(np.uint8).tobytes()
