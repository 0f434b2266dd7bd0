"""Masks: the live tiles against plain numpy, and what every sampler makes of them."""

import numpy as np
import pytest
import torch
from helpers.refusals import assert_refused
from helpers.sampling_cases import SIZES, UNITS, Foreign, pixels_by_tile, random_maps, step

from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.masks import PixelMasks
from turbogs_plugin.strategies.pixel_sampling import DensePixelSampler, ErrorGuidedPixelSampler, RandomPixelSampler
from turbogs_plugin.tiles import pixel_table
from turbogs_plugin.types import TILE_SIZE, PixelSamples

ONE_PIXEL, WHOLE, NOTHING = 0, 1, 2


def images(seed=0):
    """A mask a view of SIZES: one pixel is left, none is masked, all are, noise with a whole tile, a half plane."""
    random = np.random.default_rng(seed)
    keep = [np.zeros((height, width), dtype=bool) for width, height in SIZES]
    keep[ONE_PIXEL][18, 35] = True
    keep[WHOLE][:] = True
    keep[3][:] = random.random((3, 50)) < 0.1
    keep[4][:, 24:] = True
    keep[4][32:, :16] = random.random((16, 16)) < 0.3
    return [torch.from_numpy(mask) for mask in keep]


def masked_maps(keep, seed=0):
    maps = random_maps(seed=seed)
    masked = ErrorMaps(SIZES, masks=PixelMasks.from_images(keep))
    for view in range(len(SIZES)):
        place = slice(int(maps.offsets[view]), int(maps.offsets[view + 1]))
        masked.initialise(view, maps.errors[place].float())
    masked.stamps.copy_(maps.stamps)
    return masked


def live_tiles(keep):
    """Per view the numbers of the tiles that have a pixel, and their pixels."""
    found = []
    for mask in keep:
        width, (y, x) = mask.shape[1], np.nonzero(mask.numpy())
        tiles = y // TILE_SIZE * -(-width // TILE_SIZE) + x // TILE_SIZE
        found.append({tile: set((y * width + x)[tiles == tile].tolist()) for tile in np.unique(tiles).tolist()})
    return found


def test_live_tiles_are_those_with_a_pixel():
    keep = images()
    masks, expected = PixelMasks.from_images(keep), live_tiles(keep)
    assert masks.live_counts(range(5)) == [len(tiles) for tiles in expected] == [1, 1, 0, 4, 10]
    assert masks.pixel_counts.tolist() == [int(mask.sum()) for mask in keep]
    for view, mask in enumerate(keep):
        assert torch.equal(masks.image(view), mask)
        tiles, live = masks.live_tiles([view])
        table = pixel_table(SIZES[[view]], "cpu")[tiles]
        kept = [set(row[bits & (row >= 0)].tolist()) for row, bits in zip(table, live, strict=True)]
        assert dict(zip(tiles.tolist(), kept, strict=True)) == expected[view]
    found, expected = PixelMasks.from_images([keep[4]]).pixels([0]), PixelSamples.from_mask(keep[4])
    for name in ("pixel_ids", "tile_ids", "tile_offsets", "view_ids"):
        assert np.array_equal(getattr(found, name), getattr(expected, name)), name
    assert len(masks.bits) == 1 + 1 + 4 + 4  # whole tiles share a row; the half plane cuts three tiles, noise one more
    assert masks.rows[masks.offsets[WHOLE]] == 0


SAMPLERS = [
    *(ErrorGuidedPixelSampler(unit=unit) for unit in UNITS),
    ErrorGuidedPixelSampler(importance=1.0),
    *(RandomPixelSampler(unit=unit) for unit in UNITS),
    DensePixelSampler(),
    Foreign(),
]


@pytest.mark.parametrize("sampler", SAMPLERS, ids=str)
@pytest.mark.parametrize("rate", [1e-6, 0.1, 1.0])
@pytest.mark.parametrize("views", [(3, 0, 4, 2, 1), (4,), (2,), (2, 0)])
def test_no_sampler_draws_a_masked_pixel_or_a_tile_without_another(sampler, rate, views):
    keep = images()
    maps, expected = masked_maps(keep), live_tiles(keep)
    samples = sampler.sample(maps, views, rate, step(100))
    if not getattr(sampler, "heeds_masks", False):
        samples = maps.masks.strip(samples)
    firsts = samples.grid.starts
    live = {int(firsts[k]) + tile: kept for k, view in enumerate(views) for tile, kept in expected[view].items()}
    drawn = pixels_by_tile(samples)
    for tile, pixels in drawn.items():
        assert pixels and set(pixels) <= live[tile] and len(set(pixels)) == len(pixels)
    if getattr(sampler, "unit", "pixel") == "pixel" and not isinstance(sampler, Foreign):
        wanted = 256 if isinstance(sampler, DensePixelSampler) else max(1, int(256 * rate))
        counts = {tile: min(wanted, len(kept)) for tile, kept in live.items()}
        assert {tile: len(pixels) for tile, pixels in drawn.items()} == counts
    if rate == 1.0 and not isinstance(sampler, Foreign):
        assert {tile: set(pixels) for tile, pixels in drawn.items()} == live
    if samples.weights is not None and drawn:
        assert samples.weights[samples.filled].mean() == pytest.approx(1.0, abs=1e-5)
        assert (samples.weights[~samples.filled] == 0).all()


def test_a_sampler_that_knows_no_masks_keeps_the_rest_of_its_samples():
    maps = masked_maps(images())
    before = Foreign().sample(maps, (4, 3), 0.1, step(0))
    after = maps.masks.strip(before)
    keep = torch.cat([maps.masks.image(4).reshape(-1), maps.masks.image(3).reshape(-1)])
    flat = before.view_of_slot() * 64 * 48 + before.pixel_ids.clamp(min=0)
    kept = before.filled & keep[flat]
    assert torch.equal(after.pixel_ids, before.pixel_ids[kept]) and kept.any() and not kept.all()
    assert torch.equal(after.view_of_slot(), before.view_of_slot()[kept])
    torch.testing.assert_close(after.weights / after.weights[0], before.weights[kept] / before.weights[kept][0])
    shifted = ErrorGuidedPixelSampler(unit="tile").sample(random_maps(), (4, 3), 0.1, step(7))
    assert maps.masks.strip(shifted).origin == shifted.origin != (0, 0)


@pytest.mark.parametrize("unit", UNITS)
def test_masks_that_mask_nothing_change_no_draw(unit):
    whole = [torch.ones(height, width, dtype=torch.bool) for width, height in SIZES]
    sampler, now = ErrorGuidedPixelSampler(unit=unit), step(0 if unit == "tile" else 7)  # their grids differ later
    for views in ((4, 0), (3, 1, 2)):
        found = sampler.sample(masked_maps(whole), views, 0.2, now)
        expected = sampler.sample(random_maps(), views, 0.2, now)
        assert found.origin == expected.origin == (0, 0)
        assert pixels_by_tile(found) == pixels_by_tile(expected)


@pytest.mark.parametrize("unit", UNITS)
def test_what_is_masked_decides_nothing(unit):
    """Errors and ages of masked pixels, however large, leave the draw as it is."""
    keep = images()
    maps, again = masked_maps(keep), masked_maps(keep)
    masked = ~torch.cat([mask.reshape(-1) for mask in keep])
    again.errors[masked], again.stamps[masked] = 60_000.0, -32_000
    sampler = ErrorGuidedPixelSampler(unit=unit)
    draws = [sampler.sample(each, (4, 3), 0.1, step(9)) for each in (maps, again)]
    assert torch.equal(draws[0].pixel_ids, draws[1].pixel_ids)


def test_masked_pixels_have_no_part_in_means():
    keep = images()
    maps = ErrorMaps.from_images([torch.where(mask, 0.5, 3.0) for mask in keep], masks=keep)
    assert maps.view_means().tolist() == [0.5, 0.5, 0.0, 0.5, 0.5]
    maps.update(maps.masks.pixels((4, 0)), torch.ones(int(keep[4].sum()) + 1), step(0))
    np.testing.assert_allclose(maps.view_means(), [0.7, 0.5, 0.0, 0.5, 0.7], rtol=1e-3)
    assert (maps.errors[maps.offsets[4] :][~keep[4].reshape(-1)] == 0).all()


@pytest.mark.parametrize(
    ("masks", "named"),
    [
        ([torch.ones(4, 4)], "number of their views or in the views' sizes"),
        ([torch.ones(4, 4), torch.ones(5, 4)], "number of their views or in the views' sizes"),
        ([torch.ones(4, 4), torch.ones(4)], r"masks have shapes \[\(4, 4\), \(4,\)\]"),
        ([], "masks have shapes"),
    ],
)
def test_masks_of_other_views_are_refused(masks, named):
    assert_refused(named, ErrorMaps.from_images, torch.ones(2, 4, 4), masks=masks)
