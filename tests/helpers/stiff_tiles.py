"""Tiles that are hard for a structure term: photos and predictions, and the gradient that an engine makes of them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.engine import engine_of
from turbogs_plugin.engine.protocol import MapUpdate
from turbogs_plugin.engine.rules import LossTerms
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.scene.photos import Photos
from turbogs_plugin.strategies.losses import CharbonnierNccLoss
from turbogs_plugin.types import PixelSamples, Step

Made = Callable[[np.ndarray], np.ndarray]
"""From [n, 3] random numbers (of a photo), or [n, 3] the photo's colours 0 .. 1 (of a prediction)."""


def faint(size: float) -> Made:
    """Grey with a texture of this standard deviation, so its variance is the square of it."""
    return lambda truth: 0.5 + size * np.sin(np.arange(truth.size).reshape(truth.shape))


FLAT: Made = lambda noise: np.full_like(noise, 0.4)  # noqa: E731
TEXTURE: Made = lambda noise: noise  # noqa: E731
STEP_EDGE: Made = lambda noise: np.where(np.arange(len(noise))[:, None] % 2 == 0, np.zeros(3), 1.0)  # noqa: E731
SATURATED: Made = lambda noise: np.where(np.arange(len(noise))[:, None] == 0, noise, 1.0)  # noqa: E731

TILES: dict[str, tuple[int, Made, Made]] = {
    "flat, right": (256, FLAT, lambda y: y),
    "flat, of another level": (256, FLAT, lambda y: y + 0.3),
    "flat photo, texture": (256, FLAT, lambda y: y + 0.3 * np.sin(np.arange(y.size).reshape(y.shape))),
    "flat photo, variance 1e-12": (256, FLAT, faint(1e-6)),
    "texture, flat prediction": (256, TEXTURE, lambda y: np.full_like(y, 0.5)),
    "texture, variance 1e-12": (256, TEXTURE, faint(1e-6)),
    "texture, variance 1e-30": (256, TEXTURE, lambda y: 1e-15 * y),
    "inverted": (256, TEXTURE, lambda y: 1 - y),
    "inverted edge": (256, STEP_EDGE, lambda y: 1 - y),
    "saturated": (256, SATURATED, lambda y: np.ones_like(y)),
    "saturated, beyond white": (256, SATURATED, lambda y: np.full_like(y, 3.0)),
    "two samples, right": (2, STEP_EDGE, lambda y: y),
    "two samples, inverted": (2, STEP_EDGE, lambda y: 1 - y),
    "two samples, nearly equal": (2, STEP_EDGE, faint(1e-6)),
    "one sample": (1, TEXTURE, lambda y: 1 - y),
    "level of 1e4": (100, TEXTURE, lambda y: 1e4 + y),
    "contrast of 1e4": (100, TEXTURE, lambda y: 1e4 * y),
    "right": (256, TEXTURE, lambda y: y),
}
"""Name -> (samples, photo, prediction)."""


def stiff_tiles() -> tuple[Photos, Tensor, PixelSamples]:
    """The photo [16, 16 T] of all `TILES`, their predictions [P, 3] float32, and their samples, on the CPU."""
    rng, tiles = np.random.default_rng(0), len(TILES)
    photo = np.zeros((16, 16 * tiles, 3), dtype=np.uint8)
    ids, colors, counts = [], [], []
    for tile, (count, make_photo, predict) in enumerate(TILES.values()):
        number = np.arange(count)
        y, x = number // 16, number % 16 + 16 * tile
        photo[y, x] = (255 * make_photo(rng.random((count, 3)))).round().astype(np.uint8)
        colors.append(predict(photo[y, x].astype(np.float32) / np.float32(255.0)))
        ids.append(16 * tiles * y + x)
        counts.append(count)
    sizes = np.array([[16 * tiles, 16]])
    offsets = torch.tensor([0, *np.cumsum(counts)], dtype=torch.int32)
    pixel_ids = torch.from_numpy(np.concatenate(ids).astype(np.int32))
    samples = PixelSamples((0,), sizes, pixel_ids, torch.arange(tiles, dtype=torch.int32), offsets)
    return Photos(torch.from_numpy(photo.reshape(-1, 3)), sizes), torch.from_numpy(np.concatenate(colors)), samples


def structure_gradients(device: str, dtype: torch.dtype = torch.float32) -> list[Tensor]:
    """The gradient of the NCC term at weight 1 alone, [n, 3] float64 on the CPU, of each tile of `TILES`."""
    full = gradients(CharbonnierNccLoss().terms, device, dtype)
    alone = gradients(CharbonnierNccLoss(ncc_weight=0.0).terms, device, dtype)
    return [whole - l1 for whole, l1 in zip(full, alone, strict=True)]


def gradients(terms: LossTerms, device: str, dtype: torch.dtype = torch.float32) -> list[Tensor]:
    """The gradient [n, 3] of each tile, float64 on the CPU. float64 (CPU only): of the same predictions."""
    photos, colors, samples = stiff_tiles()
    moved = {name: getattr(samples, name).to(device) for name in ("pixel_ids", "tile_ids", "tile_offsets")}
    samples = PixelSamples(samples.view_ids, samples.sizes, **moved)
    colors = colors.float().to(device, dtype)
    engine, truth = engine_of(torch.device(device)), Photos(photos.colors.to(device), photos.sizes).at(samples)
    if dtype == torch.float64:
        output = engine.evaluate(terms, colors, truth.colors(), samples)
    else:
        zeros = torch.zeros(16, 16 * len(TILES), device=device)
        output = engine.supervise(terms, colors, truth, MapUpdate(ErrorMaps.from_images([zeros]), Step(0, 10, 10)))
    assert torch.isfinite(output.loss)
    result = output.color_gradients.double().cpu()
    return list(result.split(samples.tile_offsets.diff().tolist()))


def assert_structure_gradients_are_bounded(given: list[Tensor]) -> None:
    """A tile's entries sum up to at most ncc_weight / T, as the balance says; each is at most the formula's.

    The formula: |g| omega <= 1.5 sqrt(omega / f), f = c / 2, over 3 T. At c = 9e-4 and 256 samples that is 1.5 / T
    times 0.98, so the balance is the tighter one there. A difference of two gradients has the rounding of both.
    """
    rounding = 1e-6 / sum(len(part) for part in given)
    for name, part in zip(TILES, given, strict=True):
        limit = 1.5 * (1 / (len(part) * 0.5 * 0.03**2)) ** 0.5 / (3 * len(TILES))
        assert part.isfinite().all(), name
        assert part.abs().sum() <= 1.001 / len(TILES) + rounding, name
        assert part.abs().max() <= 1.001 * limit + rounding, name
        if name in ("flat, right", "flat, of another level", "one sample", "right", "two samples, right"):
            assert part.abs().max() <= rounding, name
    for name in ("inverted", "inverted edge", "two samples, inverted", "texture, flat prediction"):
        assert given[list(TILES).index(name)].abs().sum() > 5e-3 / len(TILES), f"{name}: no way out"


def toward_the_photo(given: list[Tensor], name: str) -> float:
    """The covariance of a tile's step, minus its gradient, with the photo: above 0 where the step raises the NCC."""
    photos, _, samples = stiff_tiles()
    tile = list(TILES).index(name)
    begin, end = samples.tile_offsets[tile : tile + 2].tolist()
    truth = photos.colors[samples.pixel_ids[begin:end].long()].double() / 255
    return float((-given[tile] * (truth - truth.mean(dim=0))).sum())
