"""Pixel samplers: the documented bits, the layout, and the extremes."""

import numpy as np
import pytest
import torch
from helpers.sampling_cases import SIGMAS, SIZES, UNITS, pixels_by_tile, random_maps, step

from turbogs_plugin.engine.reference.philox import PURPOSE_PIXELS, exponentials, random_words
from turbogs_plugin.engine.rules import DrawRule
from turbogs_plugin.error_maps import AGE_MAX, ErrorMaps
from turbogs_plugin.errors import InputError
from turbogs_plugin.strategies.pixel_sampling import DensePixelSampler, ErrorGuidedPixelSampler, RandomPixelSampler
from turbogs_plugin.types import TILE_SIZE, Cameras, sample_order

# --- layout ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", [1e-6, 0.1, 1 / 3, 1.0, 7.0])
@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("sampler", [ErrorGuidedPixelSampler, RandomPixelSampler])
def test_layout(sampler, unit, rate):
    maps, views = random_maps(), (3, 0, 4, 2)
    samples = sampler(unit=unit).sample(maps, views, rate, step(100))
    assert samples.view_ids == views
    assert samples.sizes.tolist() == SIZES[list(views)].tolist()
    assert samples.weights is None
    offsets, grid = samples.tile_offsets, samples.grid
    assert offsets[0] == 0
    assert offsets[-1] == len(samples)
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
    tiles = torch.as_tensor(grid.offsets[:-1])[view_of_slot] + (y // TILE_SIZE) * columns + x // TILE_SIZE
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
    with pytest.raises(InputError, match=r"view_ids = .* (from 0 to 4|each view once)"):
        sampler.sample(random_maps(), views, 0.1, step(4))


@pytest.mark.parametrize("sampler", [ErrorGuidedPixelSampler, RandomPixelSampler])
@pytest.mark.parametrize(
    ("multiple", "rate", "wanted"),
    [
        *((1, rate, wanted) for rate, wanted in ((1e-6, 1), (0.1, 25), (1 / 3, 85), (3.0, 256))),
        *((32, rate, wanted) for rate, wanted in ((1e-6, 32), (0.18, 32), (0.19, 64), (1 / 3, 96), (1.0, 256))),
    ],
)
def test_counts_of_pixels(sampler, multiple, rate, wanted):
    samples = sampler(multiple=multiple).sample(random_maps(), (0, 2), rate, step(1))
    extents = [256, 256, 5 * 16, 16 * 5, 16 * 5, 5 * 5, 1]  # 37x21, then 1x1
    assert [len(pixels) for pixels in pixels_by_tile(samples).values()] == [min(wanted, n) for n in extents]


def test_multiples_are_of_single_pixels_and_fill_a_tile():
    plain, whole = (ErrorGuidedPixelSampler(unit="tile", multiple=multiple).rule for multiple in (1, 32))
    assert plain.wanted(0.3, 16) == whole.wanted(0.3, 16)
    for multiple in (0, 24, 512):
        with pytest.raises(InputError, match=r"multiple = .* a divisor of 256"):
            RandomPixelSampler(multiple=multiple)


@pytest.mark.parametrize(("rate", "tiles"), [(1e-6, (1, 1)), (0.34, (4, 2)), (1.0, (12, 6))])
def test_counts_of_tiles(rate, tiles):
    samples = ErrorGuidedPixelSampler(unit="tile").sample(random_maps(), (4, 0), rate, step(0))
    ids = samples.tile_ids
    assert ((ids < 12).sum(), (ids >= 12).sum()) == tiles
    extents = [256] * 12 + [256, 256, 80, 80, 80, 25]
    assert {tile: len(pixels) for tile, pixels in pixels_by_tile(samples).items()} == {
        tile: extents[tile] for tile in ids.tolist()
    }
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


# --- the definition, bit by bit -------------------------------------------------------------------------------------


def documented_draw(errors, ages, place, view, rule, wanted, seed, iteration):
    """The module's text for one tile in plain Python: the set of ranks drawn. Arrays are in `sample_order`."""
    f32, floor = np.float32, np.float32(2.0**-100)
    x = [w.numpy() for w in random_words(torch.as_tensor(place), view, PURPOSE_PIXELS, seed, iteration)]
    races = [exponentials(torch.as_tensor(word)).numpy() for word in x]
    total_error, total_age = f32(errors.astype(np.float64).sum()), f32(ages.sum())
    hard, stable, mixed = rule.stages(wanted)
    drawn = set()

    def take(count, key):
        left = [rank for rank in range(len(errors)) if rank not in drawn]
        drawn.update(sorted(left, key=lambda rank: (-key(rank), rank))[:count])

    def mixture(rank):
        by_error = f32(errors[rank]) / total_error if total_error > 0 else f32(0)
        by_age = f32(ages[rank]) / total_age if total_age > 0 else f32(0)
        return f32(1) if rule.mixed_uniform else by_error + by_age

    take(hard, lambda rank: max(f32(errors[rank]), floor) / races[0][rank])
    take(stable, lambda rank: int(ages[rank]) << 24 | int(x[1][rank]) >> 8)
    take(mixed, lambda rank: max(mixture(rank), floor) / races[2][rank])
    return drawn


@pytest.mark.parametrize("mixed", ["error_age", "uniform"])
@pytest.mark.parametrize("view", [0, 1])
def test_draw_is_the_documented_one(view, mixed):
    maps = random_maps()
    sampler = ErrorGuidedPixelSampler(mixed=mixed)
    rule = DrawRule("pixel", 0.4, 0.3, mixed == "uniform", 0.0)
    for iteration in (100, 101):
        samples = sampler.sample(maps, (view,), 0.2, step(iteration, seed=5))
        width, height = SIZES[view]
        for tile, pixels in pixels_by_tile(samples).items():
            columns = -(-width // TILE_SIZE)
            ys, xs = np.mgrid[0:16, 0:16].reshape(2, -1)
            order = np.argsort(sample_order(torch.as_tensor(xs), torch.as_tensor(ys)).numpy())
            ys, xs = ys[order] + tile // columns * 16, xs[order] + tile % columns * 16
            inside = (xs < width) & (ys < height)
            ids = (ys * width + xs)[inside]
            flat = maps.offsets[view] + ids
            ages = np.minimum(iteration - maps.stamps.numpy()[flat].astype(np.int64), AGE_MAX)
            wanted = min(51, len(ids))
            drawn = documented_draw(maps.errors.numpy()[flat], ages, ids, view, rule, wanted, 5, iteration)
            if wanted < len(ids):
                assert set(ids[list(drawn)]) == set(pixels)
            else:
                assert set(pixels) == set(ids)


# --- extremes -------------------------------------------------------------------------------------------------------


def many_tiles(errors, iteration=0, sampler=None, rate=0.1):
    """How often each place of a tile is drawn, [256] in row order, over 400 equal tiles."""
    image = torch.as_tensor(errors).reshape(16, 16).repeat(20, 20)
    maps = ErrorMaps.from_images([image])
    samples = (sampler or ErrorGuidedPixelSampler()).sample(maps, (0,), rate, step(iteration))
    x, y = (samples.coordinates() % 16).unbind(dim=1)
    return torch.bincount(y * 16 + x, minlength=256).numpy(), samples


@pytest.mark.parametrize("iteration", [0, 70_000])
@pytest.mark.parametrize("value", [0.0, 65504.0, float("nan"), float("inf"), 6e-8])
def test_tiles_of_one_error_are_drawn_uniformly(value, iteration):
    """All-zero, saturated, NaN-seeded, denormal; all ages equal or saturated: no stripe, no pixel left out."""
    counts, samples = many_tiles(torch.full((256,), value), iteration)
    assert counts.sum() == 400 * 25
    p = 25 / 256
    assert (np.abs(counts - 400 * p) < SIGMAS * np.sqrt(400 * p * (1 - p))).all()
    assert samples.filled.all()


def test_one_hot_tile_always_gives_the_hot_pixel_and_else_is_uniform():
    errors = torch.zeros(256)
    errors[77] = 1e-3
    counts, _ = many_tiles(errors)
    assert counts[77] == 400
    p = 24 / 255
    others = np.delete(counts, 77)
    assert (np.abs(others - 400 * p) < SIGMAS * np.sqrt(400 * p * (1 - p))).all()


def test_smallest_error_comes_before_zero_errors():
    errors = torch.zeros(256)
    errors[100:110] = 6e-8
    counts, _ = many_tiles(errors, sampler=ErrorGuidedPixelSampler(hard_ratio=1.0, stable_ratio=0.0))
    assert (counts[100:110] == 400).all()


def test_one_pixel_a_tile():
    errors = torch.zeros(256)
    errors[3] = 1.0
    counts, samples = many_tiles(errors, iteration=3, rate=1e-9)
    assert len(samples) == 400
    assert 0.4 < counts[3] / 400 < 0.6  # the mixed stage's one: half by error, half by (equal) age


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
    rate = {"pixel": 0.1, "tile": 0.2}[unit]  # 25 of 256, or 3 of 16: stable 8, or 1
    iterations = {"pixel": 256 // 8, "tile": 25}[unit]
    for t in range(iterations):
        samples = ErrorGuidedPixelSampler(unit=unit).sample(maps, (0,), rate, step(t))
        maps.update(samples, maps.errors[samples.flat_pixels(maps.offsets)], step(t))
    assert maps.ages(0, step(iterations)).max() <= iterations


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"hard_ratio": 1.2}, "hard_ratio"),
        ({"hard_ratio": 0.8, "stable_ratio": 0.3}, "stable_ratio"),
        ({"stable_ratio": -0.1}, "stable_ratio"),
        ({"mixed": "age"}, "mixed"),
        ({"unit": "warp"}, "unit"),
        ({"importance": 1.5}, "importance"),
        ({"importance": float("nan")}, "importance"),
    ],
)
def test_invalid_values_are_named(values, named):
    with pytest.raises(InputError, match=named):
        ErrorGuidedPixelSampler(**values)


@pytest.mark.parametrize("sampler", SAMPLERS[:2], ids=lambda sampler: type(sampler).__name__)
@pytest.mark.parametrize(
    ("rate", "at", "named"),
    [*((rate, step(0), f"rate = {rate}") for rate in (0.0, float("nan"), float("inf"))), (0.1, 7, "step = 7.*a Step")],
)
def test_invalid_rates_and_steps_are_named(sampler, rate, at, named):
    with pytest.raises(InputError, match=named):
        sampler.sample(random_maps(), (0,), rate, at)
