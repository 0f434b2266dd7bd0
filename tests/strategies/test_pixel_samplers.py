"""Pixel samplers: the documented bits, the layout, and the extremes."""

import numpy as np
import pytest
import torch
from helpers.refusals import assert_refused
from helpers.sampling_cases import SIGMAS, SIZES, UNITS, pixels_by_tile, random_maps, step

from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.strategies.pixel_sampling import DensePixelSampler, ErrorGuidedPixelSampler, RandomPixelSampler
from turbogs_plugin.strategies.returned import require_samples
from turbogs_plugin.types import TILE_SIZE, Cameras, sample_order


@pytest.mark.parametrize("rate", [1e-6, 0.1, 1 / 3, 1.0])
@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("sampler", [ErrorGuidedPixelSampler, RandomPixelSampler])
def test_layout(sampler, unit, rate):
    maps, views = random_maps(), (3, 0, 4, 2)
    samples = sampler(unit=unit).sample(maps, views, rate, step(100))
    assert samples.view_ids == views
    assert samples.sizes.tolist() == SIZES[list(views)].tolist()
    offsets, grid = samples.tile_offsets, samples.grid
    assert samples.weights is None and (offsets[0], offsets[-1]) == (0, len(samples))
    assert (samples.tile_ids[1:] > samples.tile_ids[:-1]).all()
    assert [t.dtype for t in (samples.pixel_ids, samples.tile_ids, offsets)] == [torch.int32] * 3

    filled, coordinates = samples.filled, samples.coordinates()
    view_of_slot, tile_of_slot = samples.view_of_slot(), samples.tile_of_slot()
    places = torch.stack([view_of_slot, samples.pixel_ids.long()], dim=1)[filled]
    assert len(torch.unique(places, dim=0)) == len(places), "a pixel was drawn twice"
    width, height = torch.as_tensor(samples.sizes)[view_of_slot].unbind(dim=1)
    assert (samples.pixel_ids < width * height).all()
    x, y = coordinates.unbind(dim=1)
    assert grid.origin == samples.origin == ((7, 15) if unit == "tile" else (0, 0))
    x, y = x + samples.origin[0], y + samples.origin[1]  # in the grid
    columns = torch.as_tensor(grid.shapes[:, 0])[view_of_slot]
    tiles = torch.as_tensor(grid.starts[:-1])[view_of_slot] + (y // TILE_SIZE) * columns + x // TILE_SIZE
    assert (tiles == samples.tile_ids[tile_of_slot])[filled].all()
    ranks = torch.where(filled, sample_order(x % TILE_SIZE, y % TILE_SIZE), TILE_SIZE**2)  # empty slots come last
    same_tile = tile_of_slot[1:] == tile_of_slot[:-1]
    rising = (ranks[1:] > ranks[:-1]) | ~filled[1:]
    assert (rising & (filled[:-1] | ~filled[1:]) | ~same_tile).all()


SAMPLERS = [ErrorGuidedPixelSampler(), RandomPixelSampler(), DensePixelSampler()]


@pytest.mark.parametrize("sampler", SAMPLERS, ids=lambda sampler: type(sampler).__name__)
@pytest.mark.parametrize("views", [[2, 0], torch.tensor([2, 0]), np.array([2, 0]), (np.int64(2), np.int64(0))])
def test_views_may_come_in_any_form(sampler, views):
    expected = sampler.sample(random_maps(), (2, 0), 0.1, step(4))
    samples = sampler.sample(random_maps(), views, 0.1, step(4))
    assert samples.view_ids == (2, 0) and all(type(view) is int for view in samples.view_ids)
    assert torch.equal(samples.pixel_ids, expected.pixel_ids)
    for one in (2, torch.tensor(2), np.int64(2)):
        assert sampler.sample(random_maps(), one, 0.1, step(4)).view_ids == (2,)


@pytest.mark.parametrize("sampler", SAMPLERS, ids=lambda sampler: type(sampler).__name__)
@pytest.mark.parametrize("views", [(5,), (0, -1), (), (0.5,), None, [[0, 1]], (2, 2)])
def test_views_that_are_none_or_come_twice_are_refused(sampler, views):
    """A view's changes would be counted twice by `ErrorMaps.update`."""
    assert_refused(r"view_ids = .* (from 0 to 4|each view once)", sampler.sample, random_maps(), views, 0.1, step(4))


@pytest.mark.parametrize("sampler", [ErrorGuidedPixelSampler, RandomPixelSampler])
@pytest.mark.parametrize(
    ("multiple", "counts"),
    [(1, {1e-6: 1, 0.1: 25, 1 / 3: 85, 1.0: 256}), (32, {1e-6: 32, 0.18: 32, 0.19: 64, 1 / 3: 96, 1.0: 256})],
)
def test_counts_of_pixels(sampler, multiple, counts):
    extents = [256, 256, 5 * 16, 16 * 5, 16 * 5, 5 * 5, 1]  # 37x21, then 1x1
    for rate, wanted in counts.items():
        samples = sampler(multiple=multiple).sample(random_maps(), (0, 2), rate, step(1))
        assert [len(pixels) for pixels in pixels_by_tile(samples).values()] == [min(wanted, n) for n in extents]


@pytest.mark.parametrize(("rate", "tiles"), [(1e-6, (1, 1)), (0.34, (4, 2)), (1.0, (12, 6))])
def test_counts_of_tiles(rate, tiles):
    samples = ErrorGuidedPixelSampler(unit="tile").sample(random_maps(), (4, 0), rate, step(0))
    ids = samples.tile_ids
    assert ((ids < 12).sum(), (ids >= 12).sum()) == tiles
    extents = [256] * 12 + [256, 256, 80, 80, 80, 25]
    assert all(len(pixels) == extents[tile] for tile, pixels in pixels_by_tile(samples).items())
    assert len(samples) == 256 * len(ids)


def test_whole_tiles_begin_elsewhere_in_each_iteration():
    """Tiles of another grid hold all their pixels, and at a rate of 1 every pixel of the views."""
    maps, views = random_maps(), (4, 0, 2)
    sampler, origins = ErrorGuidedPixelSampler(unit="tile"), []
    for t in range(256):
        origins.append(sampler.sample(maps, (1,), 1.0, step(t)).origin)
        if t % 15:
            continue
        samples = sampler.sample(maps, views, 1.0, step(t))
        assert samples.filled.sum() == sum(int(np.prod(SIZES[view])) for view in views)
        widths = [min(16 * n + 16 - samples.origin[0], 64) - max(16 * n - samples.origin[0], 0) for n in range(4)]
        heights = [min(16 * n + 16 - samples.origin[1], 48) - max(16 * n - samples.origin[1], 0) for n in range(3)]
        assert [len(pixels) for pixels in pixels_by_tile(samples).values()][:4] == [w * heights[0] for w in widths]
        assert len(pixels_by_tile(samples)[samples.grid.shapes[0, 0]]) == widths[0] * heights[1]
    assert origins[0] == (0, 0) and min(map(min, origins)) == 0 and max(map(max, origins)) == 15
    by_column = np.bincount([x for x, _ in origins])
    assert by_column.min() >= 15 and by_column.max() <= 17 and len(set(origins)) > 200  # evenly spread
    assert sampler.sample(maps, views, 0.1, step(70)).origin == sampler.sample(maps, (1,), 0.9, step(70, 5)).origin


def test_dense_is_every_pixel_as_the_rasterizer_orders_them():
    from turbogs_plugin.engine.render import dense_samples

    maps, views = random_maps(), (4, 0, 2)
    samples = DensePixelSampler().sample(maps, views, 0.01, step(3))
    cameras = Cameras(torch.eye(4).repeat(5, 1, 1), torch.eye(3).repeat(5, 1, 1), SIZES)
    expected = dense_samples(cameras, views)
    for name in ("pixel_ids", "tile_ids", "tile_offsets"):
        assert torch.equal(getattr(samples, name), getattr(expected, name))
    full = ErrorGuidedPixelSampler().sample(maps, views, 1.0, step(3))
    assert torch.equal(full.pixel_ids, samples.pixel_ids)


@pytest.mark.parametrize("unit", UNITS)
def test_a_view_gets_the_same_pixels_in_any_batch(unit):
    maps, sampler = random_maps(), ErrorGuidedPixelSampler(unit=unit)
    together = sampler.sample(maps, (4, 1, 0), 0.2, step(8))
    alone = sampler.sample(maps, (0,), 0.2, step(8))
    assert torch.equal(together.pixel_ids[together.view_of_slot() == 2], alone.pixel_ids)


@pytest.mark.parametrize("unit", UNITS)
def test_draws_depend_on_seed_and_iteration_alone(unit):
    maps, sampler = random_maps(), ErrorGuidedPixelSampler(unit=unit)
    draws = [sampler.sample(maps, (4, 0), 0.2, step(*at)) for at in [(8, 1), (8, 1), (9, 1), (8, 2), (8, 1 + 2**32)]]
    keys = [(tuple(draw.pixel_ids.tolist()), tuple(draw.tile_ids.tolist())) for draw in draws]
    assert keys[0] == keys[1]
    assert len(set(keys)) == 4


def many_tiles(errors, iteration=0):
    """How often each place of a tile is drawn, [256] in row order, over 400 equal tiles."""
    image = torch.as_tensor(errors).reshape(16, 16).repeat(20, 20)
    maps = ErrorMaps.from_images([image])
    samples = ErrorGuidedPixelSampler().sample(maps, (0,), 0.1, step(iteration))
    x, y = (samples.coordinates() % 16).unbind(dim=1)
    return torch.bincount(y * 16 + x, minlength=256).numpy(), samples


@pytest.mark.parametrize("iteration", [0, 70_000])
@pytest.mark.parametrize("value", [0.0, 65504.0, 6e-8])
def test_tiles_of_one_error_are_drawn_uniformly(value, iteration):
    """All-zero, saturated, denormal; all ages equal or saturated: no stripe, no pixel left out."""
    counts, samples = many_tiles(torch.full((256,), value), iteration)
    assert counts.sum() == 400 * 25
    p = 25 / 256
    assert (np.abs(counts - 400 * p) < SIGMAS * np.sqrt(400 * p * (1 - p))).all()
    assert samples.filled.all()


@pytest.mark.parametrize(("hot", "error"), [(slice(77, 78), 1e-3), (slice(100, 110), 6e-8)])
def test_hot_pixels_are_always_drawn_and_the_others_uniformly(hot, error):
    errors = torch.zeros(256)
    errors[hot] = error
    counts, _ = many_tiles(errors)
    assert (counts[hot] == 400).all()
    others = np.delete(counts, hot)
    p = (25 - 256 + len(others)) / len(others)
    assert (np.abs(others - 400 * p) < SIGMAS * np.sqrt(400 * p * (1 - p))).all()


def test_ages_past_sixteen_bits_still_rank():
    maps = ErrorMaps.from_images(torch.rand(1, 16, 16))
    sampler, visited = ErrorGuidedPixelSampler(hard_ratio=0.0, stable_ratio=1.0), 60_000
    first = sampler.sample(maps, (0,), 0.5, step(visited))
    maps.update(first, torch.rand(len(first)), step(visited))
    second = sampler.sample(maps, (0,), 0.5, step(visited + 32_766))  # one iteration before the visited saturate
    assert not set(first.pixel_ids.tolist()) & set(second.pixel_ids.tolist())
    third = sampler.sample(maps, (0,), 0.5, step(visited + 140_000))  # all saturated: at random
    assert 40 < len(set(first.pixel_ids.tolist()) & set(third.pixel_ids.tolist())) < 88


@pytest.mark.parametrize("unit", UNITS)
def test_every_pixel_is_revisited(unit):
    """The stable share alone reaches every unit within ceil(units / stable) iterations, whatever the errors. Of whole
    tiles, whose grid moves, a view of 4x4 has up to 5x5."""
    maps = ErrorMaps(np.array([[64, 64]]))
    errors = torch.zeros(64 * 64)
    errors[:300] = 3.0
    maps.initialise(0, errors)
    rate, iterations = {"pixel": (0.1, 256 // 8), "tile": (0.2, 25)}[unit]  # 25 of 256, or 3 of 16: stable 8, or 1
    for t in range(iterations):
        samples = ErrorGuidedPixelSampler(unit=unit).sample(maps, (0,), rate, step(t))
        maps.update(samples, maps.errors[samples.flat_pixels(maps.offsets)], step(t))
    assert maps.ages(0, step(iterations)).max() <= iterations


@pytest.mark.parametrize("sampler", SAMPLERS[:2], ids=lambda sampler: type(sampler).__name__)
def test_invalid_rates_and_steps_are_named(sampler):
    wrong = [(rate, step(0), f"rate = {rate}") for rate in (0.0, 25, float("nan"), float("inf"))]
    for rate, at, named in [*wrong, (0.1, 7, "step = 7.*a Step")]:
        assert_refused(named, sampler.sample, random_maps(), (0,), rate, at)


def test_a_pixel_beyond_its_own_view_is_refused():
    sizes, sampler = np.array([[8, 8], [16, 16]]), RandomPixelSampler()
    samples = sampler.sample(ErrorMaps(sizes), (0, 1), 1.0, step(0))
    samples.pixel_ids[3] = 100
    assert_refused("pixel 100 beyond a view", require_samples, samples, (0, 1), sizes, sampler)
