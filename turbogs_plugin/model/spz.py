"""``.spz``, the compressed format of Niantic (https://github.com/nianticlabs/spz, MIT): versions 2 and 3 are written,
1 .. 4 read.

A gzip stream of a header of 16 bytes and of one array after the other: positions, opacities, colours, scales,
rotations, harmonics. Axes are x right, y up, z backward (`upright`). Version 2 has coarser rotations, version 1
positions in half precision, too. Version 4 has a plain header of 32 bytes, a table of sizes, and a zstd stream for each
array that is not empty; all its readers read version 3, too.
"""

from __future__ import annotations

import gzip
import math
import struct
import warnings
import zlib
from pathlib import Path

import numpy as np
import torch

from turbogs_plugin.captures.capture import bytes_of
from turbogs_plugin.errors import InputError
from turbogs_plugin.files import write_atomically
from turbogs_plugin.model.similarity import in_capture, upright
from turbogs_plugin.scene.frame import Frame
from turbogs_plugin.scene.host_arrays import too_large
from turbogs_plugin.types import Gaussians

MAGIC, VERSION = 0x5053474E, 3
HEADER, STREAM = struct.Struct("<IIIBBBB"), struct.Struct("<QQ")
"""Magic, version, number of Gaussians, degree, fractional bits of positions, flags, zero (in version 4 the number of
streams, after which 4 bytes say where their table begins); a stream's bytes in the file, and unpacked."""
ANTIALIASED, EXTENDED = 1, 2
"""Flags: drawn with antialiasing; records of other makers follow (in version 4, before the table)."""
MOST_FRACTIONAL_BITS = 20
COLOR_SCALE, SH_SCALE = 0.15, 128.0
"""Bytes are colours times 255 * 0.15, and harmonics times 128. Niantic's writer drops three or four of the latter's
bits, by which the small coefficients of a capture whose cameras look one way all became 0."""
SIZE, SIGN, UNIT = 511, 512, 511 * math.sqrt(2.0)
"""Bits of a quaternion's stored component, its sign's, and its code where it were 1; it is at most 1 / sqrt(2)."""
MOST_UNPACKED, ALWAYS_UNPACKED = 16, 2**20
"""Most bytes that a byte of the file may unpack to, and bytes that any file may: positions alone, nine of a Gaussian's
20 to 65 bytes, hardly pack."""
READING = 2 * 8 * 59
"""Bytes that a Gaussian takes while it is read: two copies of its numbers in float64."""


def save_spz(
    gaussians: Gaussians, path: Path, frame: Frame, step: int = 0, antialiased: bool = False, version: int = VERSION
) -> None:
    """Write a model (`formats.Write`) in version 2 or 3. `InputError` where positions are too large for it."""
    values = {name: value.double().numpy() for name, value in upright(in_capture(gaussians, frame, path)).items()}
    largest = float(np.abs(values["means"]).max())
    bits = min(MOST_FRACTIONAL_BITS, 22 - max(0, math.ceil(math.log2(max(largest, 1e-9)))))
    if bits < 0:
        raise InputError(f"positions of {largest:.3g} units do not fit into a .spz: export with --format ply")
    fixed = np.rint(values["means"] * 2.0**bits).astype("<i4")  # [N, 3]
    quats = values["quats"][:, [1, 2, 3, 0]]
    quats = quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-30)
    parts = [
        HEADER.pack(MAGIC, version, len(fixed), gaussians.sh_degree, bits, ANTIALIASED * antialiased, 0),
        fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3].tobytes(),
        _bytes(255.0 / (1.0 + np.exp(-values["opacities"]))),
        _bytes(values["sh0"][:, 0] * (COLOR_SCALE * 255.0) + 127.5),
        _bytes((values["scales"] + 10.0) * 16.0),
        _packed_rotations(quats).tobytes() if version > 2 else _bytes(127.5 * _positive(quats, 3)[:, :3] + 127.5),
        _bytes(values["shN"] * SH_SCALE + 128.0),
    ]
    content = gzip.compress(b"".join(parts), 6, mtime=0)
    write_atomically(path, lambda file: file.write(content))


def read_spz(path: Path) -> tuple[Gaussians, bool]:
    """A model (`formats.Read`) in x right, y down, z forward, on the CPU. Raises `InputError` where the file is not a
    whole one of this format, needs zstandard (version 4), or unpacks to more than `MOST_UNPACKED` times its bytes, or
    than the memory takes."""
    version, bits, flags, (means, opacities, colors, scales, rotations, harmonics) = _unpacked(path)
    if version == 1:
        warnings.warn(f"{path} is of version 1, which has positions in half precision: export it again", stacklevel=2)
        places = means.view("<f2").astype(np.float64)
    else:
        wide = np.zeros((len(means), 3, 4), dtype=np.uint8)
        wide[:, :, 1:] = means.reshape(-1, 3, 3)  # in the upper bytes, so that the sign is theirs
        places = (wide.view("<i4")[:, :, 0] >> 8) / 2.0**bits
    if version > 2:
        words = rotations.view("<u4")
        codes = words >> np.array([20, 10, 0], dtype=np.uint32)  # [N, 3]
        quats = _with_rest(np.where(codes & SIGN, -1.0, 1.0) * (codes & SIZE) / UNIT, words >> 30)
    else:
        quats = _with_rest(rotations / 127.5 - 1.0, np.full((len(means), 1), 3))
    shares = (opacities[:, 0] / 255.0).clip(1e-4, 1.0 - 1e-4)
    sh0, shN = (colors / 255.0 - 0.5) / COLOR_SCALE, (harmonics - 128.0) / SH_SCALE
    values = [places, quats[:, [3, 0, 1, 2]], scales / 16.0 - 10.0, np.log(shares / (1.0 - shares)), sh0[:, None]]
    model = upright(Gaussians(*map(torch.from_numpy, [*values, shN.reshape(len(means), -1, 3)])))
    return model, bool(flags & ANTIALIASED)


def _unpacked(path: Path) -> tuple[int, int, int, list[np.ndarray]]:
    """Version, fractional bits, flags, and the bytes [N, ...] uint8 of the six arrays."""
    version = VERSION
    try:
        content = bytes_of(path)
        # Version 4 has a plain header.
        unpacker = None if content.startswith(MAGIC.to_bytes(4, "little")) else zlib.decompressobj(wbits=31)
        head = unpacker.decompress(content, HEADER.size) if unpacker else content[: HEADER.size]
        magic, version, count, degree, bits, flags, streams = HEADER.unpack(head.ljust(HEADER.size, b"\0"))
        if magic != MAGIC or version not in ((1, 2, 3) if unpacker else (4,)) or degree > 3 or not count:
            raise InputError(f"{path} is no .spz of version 1 .. 4 and degree 0 .. 3: convert what it was made of")
        widths = (6 if version == 1 else 9, 1, 3, 3, 3 if version < 3 else 4, 3 * ((degree + 1) ** 2 - 1))
        size = count * sum(widths)
        announced = f"{path} of version {version} announces {count} Gaussians"
        if size > max(ALWAYS_UNPACKED, MOST_UNPACKED * len(content)):
            raise InputError(f"{announced} in {len(content)} bytes: it is damaged, export it again")
        if too_large(READING * count):
            raise InputError(f"{announced}, more than fit in the free memory: export it again")
        if unpacker:
            body = unpacker.decompress(unpacker.unconsumed_tail, size + 1)
            whole = unpacker.eof if len(body) == size else len(body) > size and flags & EXTENDED
        else:
            body = _of_streams(content, streams, [count * width for width in widths if width])
            whole = len(body) == size
    except ImportError:
        raise InputError(f"{path} is of version 4, which needs zstandard: pip install zstandard") from None
    except (OSError, zlib.error, struct.error) as error:
        raise InputError(f"cannot read {path} as .spz of version {version}: {error}; export it again") from None
    if not whole:
        raise InputError(f"{announced} and lacks some of them: export it again")
    arrays = np.split(np.frombuffer(body, dtype=np.uint8, count=size), count * np.cumsum(widths[:-1]))
    return version, bits, flags, [array.reshape(count, width) for array, width in zip(arrays, widths, strict=True)]


def _of_streams(content: bytes, streams: int, sizes: list[int]) -> bytes:
    """What the streams of version 4 hold, which must have `sizes`; less where one is damaged."""
    import zstandard

    (table,) = struct.unpack_from("<I", content, HEADER.size)
    start, parts = table + streams * STREAM.size, []
    for number, size in enumerate(sizes if streams == len(sizes) else ()):
        length, _ = STREAM.unpack_from(content, table + number * STREAM.size)
        try:
            parts.append(zstandard.ZstdDecompressor().stream_reader(content[start : start + length]).read(size))
        except zstandard.ZstdError as error:
            raise zlib.error(str(error)) from None
        start += length
    return b"".join(parts)


def _packed_rotations(unit: np.ndarray) -> np.ndarray:
    """[N] uint32 of [N, 4] unit quaternions, xyzw: the place of the largest component in 2 bits, then the others in
    their order, a sign and 9 bits each."""
    largest = np.abs(unit).argmax(axis=1, keepdims=True)  # [N, 1]
    others = _positive(unit, largest)[np.arange(4) != largest].reshape(-1, 3)
    codes = np.rint(UNIT * np.abs(others)).clip(0, SIZE).astype("<u4") | np.where(others < 0, SIGN, 0).astype("<u4")
    return largest[:, 0].astype("<u4") << 30 | codes[:, 0] << 20 | codes[:, 1] << 10 | codes[:, 2]


def _with_rest(others: np.ndarray, place: np.ndarray) -> np.ndarray:
    """[N, 4] unit quaternions of three of their components [N, 3], and the place [N, 1] of the positive fourth."""
    found, is_rest = np.empty((len(others), 4)), np.arange(4) == place
    found[~is_rest] = others.ravel()
    found[is_rest] = np.sqrt(np.maximum(0.0, 1.0 - np.square(others).sum(axis=1)))
    return found


def _positive(quats: np.ndarray, place: np.ndarray | int) -> np.ndarray:
    """[N, 4] quaternions of the same rotations whose component at `place` is not negative."""
    return np.where(np.take_along_axis(quats, np.broadcast_to(place, (len(quats), 1)), axis=1) < 0, -quats, quats)


def _bytes(values: np.ndarray) -> bytes:
    return np.rint(values).clip(0, 255).astype(np.uint8).tobytes()
