"""``.spz``, the compressed format of Niantic (https://github.com/nianticlabs/spz, MIT), in its version 3.

A gzip stream of a header of 16 bytes and of one array after the other: positions, opacities, colours, scales,
rotations, harmonics. Axes are x right, y up, z backward, where a capture's are x right, y down, z forward: so y and z
change their sign, in everything that depends on a direction. Version 4 needs another compressor; all its readers read
version 3, too. Version 2 has coarser rotations and is not read.
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
from turbogs_plugin.model.similarity import in_capture
from turbogs_plugin.scene.frame import Frame
from turbogs_plugin.scene.host_arrays import too_large
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
"""Largest code of each of a quaternion's three stored components: 9 bits and a sign, for 0 .. 1 / sqrt(2)."""
GZIP_LEVEL = 6


def save_spz(gaussians: Gaussians, path: Path, frame: Frame, step: int = 0) -> None:
    """Write a model, whole or not at all, in the capture's own coordinates. Arguments and errors as of `in_capture`;
    `step` has no place in this format. `InputError`, too, where positions are too large for it."""
    gaussians = in_capture(gaussians, frame, path)
    values = {name: value.double().numpy() for name, value in gaussians.items()}
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
        _packed_rotations(values["quats"][:, [1, 2, 3, 0]] * [1.0, -1.0, -1.0, 1.0]).tobytes(),
        _bytes(harmonics * SH_SCALE + 128.0),
    ]
    content = gzip.compress(b"".join(parts), GZIP_LEVEL, mtime=0)
    write_atomically(path, lambda file: file.write(content))


def read_spz(path: Path) -> Gaussians:
    """A model in x right, y down, z forward; float64, on the CPU.

    Raises:
        InputError: the file is not a whole one of this format, in version 3.
    """
    try:
        unpacker, content = zlib.decompressobj(wbits=31), path.read_bytes()
        header = unpacker.decompress(content, HEADER.size).ljust(HEADER.size, b"\0")
        magic, version, count, degree, bits, _, _ = HEADER.unpack(header)
        if (magic, version) != (MAGIC, VERSION) or degree > 3 or not count:
            raise InputError(f"{path} is no .spz of version 3 with Gaussians of degree 3 or less: export it again")
        bands = (degree + 1) ** 2 - 1
        widths = (9, 1, 3, 3, 4, 3 * bands)
        size = count * sum(widths)
        if too_large(size):
            raise InputError(f"{path} announces {count} Gaussians, more than fit in the free memory: export it again")
        body = unpacker.decompress(unpacker.unconsumed_tail, size + 1)
    except (OSError, zlib.error) as error:
        raise InputError(f"cannot read {path} as .spz: {error}; export it again") from None
    if len(body) != size or not unpacker.eof:
        raise InputError(f"{path} does not hold the {count} Gaussians that it announces: export it again")
    ends = count * np.cumsum((0, *widths))
    means, opacities, colors, scales, rotations, harmonics = (
        np.frombuffer(body[start:end], dtype=np.uint8).reshape(count, width)
        for start, end, width in zip(ends, ends[1:], widths, strict=False)
    )
    words = np.ascontiguousarray(rotations).view("<u4")[:, 0]
    wide = np.zeros((count, 3, 4), dtype=np.uint8)
    wide[:, :, 1:] = means.reshape(count, 3, 3)  # in the upper bytes, so that the sign is theirs
    shares = (opacities[:, 0] / 255.0).clip(1e-4, 1.0 - 1e-4)
    values = {
        "means": (wide.view("<i4")[:, :, 0] >> 8) / 2.0**bits * [1.0, -1.0, -1.0],
        "quats": (_unpacked_rotations(words) * [1.0, -1.0, -1.0, 1.0])[:, [3, 0, 1, 2]],
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
    """[N] uint32 of [N, 4] quaternions of any norm, xyzw: the place of the largest component in 2 bits, then the others
    in their order, a sign and 9 bits each."""
    unit = quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-30)
    largest = np.abs(unit).argmax(axis=1)
    unit = np.where(np.take_along_axis(unit, largest[:, None], axis=1) < 0, -unit, unit)
    sizes = np.floor(LARGEST_COMPONENT * np.abs(unit) * math.sqrt(2.0) + 0.5).clip(0, LARGEST_COMPONENT)
    codes = np.where(unit < 0, sizes + LARGEST_COMPONENT + 1, sizes).astype(np.uint32)  # sign and size
    words = largest.astype(np.uint32)
    for place in range(4):
        words = np.where(largest == place, words, words << np.uint32(10) | codes[:, place])
    return words.astype("<u4")


def _unpacked_rotations(words: np.ndarray) -> np.ndarray:
    """[N, 4] unit quaternions, xyzw, of what `_packed_rotations` gives."""
    largest = words >> 30
    found = np.zeros((len(words), 4))
    for place in (3, 2, 1, 0):
        stored, size = largest != place, (words & LARGEST_COMPONENT) / (LARGEST_COMPONENT * math.sqrt(2.0))
        found[:, place] = np.where(stored, np.where(words & (LARGEST_COMPONENT + 1), -size, size), 0.0)
        words = np.where(stored, words >> 10, words)
    rest = np.sqrt(np.maximum(0.0, 1.0 - np.square(found).sum(axis=1)))
    np.put_along_axis(found, largest[:, None].astype(np.int64), rest[:, None], axis=1)
    return found


def _bytes(values: np.ndarray) -> bytes:
    return np.rint(values).clip(0, 255).astype(np.uint8).tobytes()
