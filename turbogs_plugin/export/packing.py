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

from turbogs_plugin.model.packed import (
    even_code,
    even_component,
    packed_rotations,
    unpacked_model,
    unpacked_rotations,
)
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
    rows[:, 28:32] = packed_rotations(values["quats"], even_code)[:, None].view(np.uint8)
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
    codes = rows[:, BASE_BYTES : BASE_BYTES + 3 * model.bands].view(np.int8) / 127.0
    limits = np.array([model.ranges[_degree(band) - 1] for band in range(model.bands)]).reshape(model.bands, 1)
    unpacked = unpacked_model(
        means=np.ascontiguousarray(rows[:, :12]).view("<f4"),
        quats=unpacked_rotations(np.ascontiguousarray(rows[:, 28:32]).view("<u4")[:, 0], even_component),
        scales=halves[:, :3],
        shares=halves[:, 3],
        sh0=(halves[:, 4:] - 0.5) / SH_C0,
        shN=(codes * np.abs(codes)).reshape(model.count, model.bands, 3) * limits,
        least=1e-7,
    )
    return unpacked.map(torch.Tensor.float)


def _degree(band: int) -> int:
    return math.isqrt(band + 1)
