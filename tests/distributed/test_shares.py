"""Samples are shared out in runs of tiles with equally many of them, and every sample has one owner."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from turbogs_plugin.distributed.shares import NEARLY, Share, shares_of
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.masks import PixelMasks
from turbogs_plugin.strategies.pixel_sampling import ErrorGuidedPixelSampler
from turbogs_plugin.types import PixelSamples, Step

EQUAL = [(160, 96)] * 6
MIXED = [(160, 96), (40, 50), (33, 17), (200, 180), (16, 16), (90, 20)]


def half_masked(sizes: list[tuple[int, int]]) -> PixelMasks:
    """The left half of each view counts, but of the second view nothing."""
    keep = [np.zeros((height, width), dtype=bool) for width, height in sizes]
    for view, (width, _) in enumerate(sizes):
        keep[view][:, : width // 2] = view != 1
    return PixelMasks.from_images(keep)


def samples_of(
    sizes: list[tuple[int, int]], views: int, unit: str = "pixel", rate: float = 0.1, masks: PixelMasks | None = None
) -> PixelSamples:
    maps = ErrorMaps(np.array(sizes), masks=masks)
    maps.errors.uniform_(0, 1, generator=torch.Generator().manual_seed(0))
    return ErrorGuidedPixelSampler(unit=unit).sample(maps, tuple(range(views)), rate, Step(3, 10, 8))


def seen_views(shares: list[Share], views: int) -> list[int]:
    """Views of all shares in their order; a share may go on with the last view of the share before."""
    seen: list[int] = []
    for share in shares:
        own = list(range(views)[share.views])
        seen += own[1:] if seen[-1:] == own[:1] else own
    return seen


@pytest.mark.parametrize("unit", ["pixel", "tile"])
@pytest.mark.parametrize(("count", "rate"), [(2, 0.1), (3, 0.004), (8, 1.0)])
@pytest.mark.parametrize(("sizes", "views"), [(EQUAL, 1), (EQUAL, 6), (MIXED, 3), (MIXED, 6)])
@pytest.mark.parametrize("masked", [False, True])
def test_shares_are_the_samples_in_their_order(sizes, views, count, rate, unit, masked):
    """Draws know their ends, where masks leave some tiles alone, too: no process waits for its device."""
    samples, again = (samples_of(sizes, views, unit, rate, half_masked(sizes) if masked else None) for _ in range(2))
    for given, asked in zip(samples.host_ends(), replace(samples, host_ends=None).ends(), strict=True):
        np.testing.assert_array_equal(given, asked)
    assert samples.host_ends == again.host_ends, "shares are kept by them"
    shares = shares_of(samples, count)
    assert len(shares) == count
    parts = [samples.of_tiles(share.tiles, share.views, share.slots) for share in shares if len(share)]
    assert torch.equal(torch.cat([part.pixel_ids for part in parts]), samples.pixel_ids)
    assert seen_views(shares, views) == list(range(views))
    of_slots = samples.view_of_slot()
    for share, part in zip([share for share in shares if len(share)], parts, strict=True):
        assert torch.equal(part.view_of_slot() + share.views.start, of_slots[share.slots])
        assert torch.equal(part.coordinates(), samples.coordinates()[share.slots])
        assert torch.equal(part.tile_ids + samples.grid.starts[share.views.start], samples.tile_ids[share.tiles])
        seen = [view for view in range(len(share)) if view + share.views.start != 1 or not masked]
        assert set(part.view_of_slot().tolist()) == set(seen)
        assert len(part.tile_ids) == len(part.tile_offsets) - 1 and int(part.tile_offsets[-1]) == len(part)


@pytest.mark.parametrize("count", [2, 3, 4, 7])
@pytest.mark.parametrize("views", [1, 3, 5])
def test_shares_are_nearly_even(views, count):
    samples = samples_of(EQUAL, views)
    sizes = [share.num_slots for share in shares_of(samples, count)]
    even, tile = len(samples) / count, 256 * 0.1
    assert max(abs(size - even) for size in sizes) <= 2 * max(NEARLY * even, 0.5 * tile)  # at either end


@pytest.mark.parametrize("empty", [(), (0,), (1,), (2,), (0, 1), (1, 2), (0, 2), (0, 1, 2)])
@pytest.mark.parametrize("count", [2, 4])
def test_a_view_without_samples_is_begun_once(empty, count):
    """Somebody has to say that nothing of it is on screen."""
    masks = PixelMasks.from_images([np.full((96, 160), view not in empty) for view in range(6)])
    samples = samples_of(EQUAL, 3, masks=masks)
    shares = shares_of(samples, count)
    assert seen_views(shares, 3) == [0, 1, 2]
    assert sum(share.num_slots for share in shares) == len(samples)
