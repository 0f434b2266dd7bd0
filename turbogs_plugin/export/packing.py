"""A model as the page's viewer takes it: a few bytes for each Gaussian, the same bytes of all side by side, compressed.

A Gaussian has 32 bytes, and 16 for every 16 coefficients of the higher bands:

==========  ====================================================================================
bytes       what
==========  ====================================================================================
0 .. 11     mean, three float32
12 .. 17    logarithms of the standard deviations, three float16
18 .. 19    opacity 0 .. 1, float16
20 .. 25    colour of degree 0, three float16; two zeros follow
28 .. 31    rotation: place of the largest component in 2 bits, the others in 10 bits each
32 ..       coefficients, band by band, in signed bytes: sign and root of the share of the degree's largest
==========  ====================================================================================
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass

import numpy as np
import torch

from turbogs_plugin.types import SH_C0, Gaussians

BASE_BYTES = 32
TEXEL_BYTES = 16
LEVEL = 6
"""Of the compression."""


@dataclass(frozen=True)
class PackedModel:
    """A model for the page.

    Args:
        planes: zlib's bytes; unpacked, [stride, N] uint8.
        count: N.
        stride: bytes of a Gaussian.
        bands: of the harmonics above degree 0.
        ranges: the largest coefficient of degrees 1, 2 and 3.
    """

    planes: bytes
    count: int
    stride: int
    bands: int
    ranges: tuple[float, float, float]


def pack(gaussians: Gaussians) -> PackedModel:
    """Pack a model; rows keep their order. Neighbours in space should be near, so that the bytes compress well.

    Args:
        gaussians: finite, near the origin; on any device.
    """
    values = {name: value.detach().cpu().double().numpy() for name, value in gaussians.items()}
    count, bands = len(gaussians), gaussians.shN.shape[1]
    ranges = [float(np.abs(values["shN"][:, d**2 - 1 : (d + 1) ** 2 - 1]).max(initial=0.0)) for d in (1, 2, 3)]
    texels = -(-3 * bands // TEXEL_BYTES)
    rows = np.zeros((count, BASE_BYTES + TEXEL_BYTES * texels), dtype=np.uint8)
    rows[:, :12] = values["means"].astype("<f4").view(np.uint8)
    opacities = 1.0 / (1.0 + np.exp(-values["opacities"]))
    halves = [values["scales"], opacities[:, None], SH_C0 * values["sh0"][:, 0] + 0.5]
    rows[:, 12:26] = np.concatenate(halves, axis=1).clip(-60000.0, 60000.0).astype("<f2").view(np.uint8)
    rows[:, 28:32] = _packed_rotations(values["quats"])[:, None].view(np.uint8)
    limits = np.array([max(ranges[_degree(band) - 1], 1e-30) for band in range(bands)]).reshape(bands, 1)
    shares = values["shN"] / limits  # [N, B, 3]
    codes = np.rint(127.0 * np.sign(shares) * np.sqrt(np.abs(shares))).astype(np.int8)
    rows[:, BASE_BYTES : BASE_BYTES + 3 * bands] = codes.reshape(count, 3 * bands).view(np.uint8)
    return PackedModel(zlib.compress(rows.T.tobytes(), LEVEL), count, rows.shape[1], bands, tuple(ranges))


def unpack(model: PackedModel) -> Gaussians:
    """What the viewer makes of it; float32, on the CPU."""
    planes = np.frombuffer(zlib.decompress(model.planes), dtype=np.uint8).reshape(model.stride, model.count)
    rows = np.ascontiguousarray(planes.T)
    halves = np.ascontiguousarray(rows[:, 12:26]).view("<f2").astype(np.float64)  # [N, 7]
    opacities = halves[:, 3].clip(1e-7, 1.0 - 1e-7)
    codes = rows[:, BASE_BYTES : BASE_BYTES + 3 * model.bands].view(np.int8) / 127.0
    limits = np.array([model.ranges[_degree(band) - 1] for band in range(model.bands)]).reshape(model.bands, 1)
    arrays = (
        np.ascontiguousarray(rows[:, :12]).view("<f4"),
        _rotations(np.ascontiguousarray(rows[:, 28:32]).view("<u4")[:, 0]),
        halves[:, :3],
        np.log(opacities / (1.0 - opacities)),
        ((halves[:, 4:] - 0.5) / SH_C0)[:, None],
        (codes * np.abs(codes)).reshape(model.count, model.bands, 3) * limits,
    )
    return Gaussians(*(torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32)) for array in arrays))


def _degree(band: int) -> int:
    return math.isqrt(band + 1)


def _packed_rotations(quats: np.ndarray) -> np.ndarray:
    """[N] uint32 of [N, 4] wxyz of any norm."""
    unit = quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-30)
    largest = np.abs(unit).argmax(axis=1)
    unit = np.where(np.take_along_axis(unit, largest[:, None], axis=1) < 0, -unit, unit)
    words = largest.astype(np.uint32)
    for place in range(4):
        code = np.rint((unit[:, place] / math.sqrt(2.0) + 0.5) * 1023.0).clip(0, 1023).astype(np.uint32)
        words = np.where(largest == place, words, words << np.uint32(10) | code)
    return words.astype("<u4")


def _rotations(words: np.ndarray) -> np.ndarray:
    """[N, 4] wxyz of `_packed_rotations`."""
    largest = words >> 30
    found = np.zeros((len(words), 4))
    for place in (3, 2, 1, 0):
        stored = largest != place
        found[:, place] = np.where(stored, ((words & 1023) / 1023.0 - 0.5) * math.sqrt(2.0), 0.0)
        words = np.where(stored, words >> 10, words)
    rest = np.sqrt(np.maximum(0.0, 1.0 - np.square(found).sum(axis=1)))
    np.put_along_axis(found, largest[:, None].astype(np.int64), rest[:, None], axis=1)
    return found
