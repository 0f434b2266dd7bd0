"""What formats of a few bytes share: rotations of which the largest component is left out, and logits from shares."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from turbogs_plugin.types import Gaussians

Code = Callable[[np.ndarray], np.ndarray]


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
