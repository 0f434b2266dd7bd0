"""Pixel samplers: exact probabilities of what is drawn, and importance weights."""

import itertools

import numpy as np
import pytest
import torch
from helpers.sampling_cases import SIGMAS, random_maps, step, successive

from turbogs_plugin.engine.reference.draws import draw_units
from turbogs_plugin.engine.reference.philox import PURPOSE_PIXELS, random_words
from turbogs_plugin.engine.rules import DrawRule
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.strategies.pixel_sampling import ErrorGuidedPixelSampler, RandomPixelSampler


def oldest(ages, count, left):
    """{frozenset: probability} of the `count` oldest of `left`, ties at random."""
    ranked = sorted((ages[i] for i in left), reverse=True)[:count]
    if not ranked:
        return {frozenset(): 1.0}
    sure = {i for i in left if ages[i] > ranked[-1]}
    tied = [i for i in left if ages[i] == ranked[-1]]
    choices = list(itertools.combinations(tied, count - len(sure)))
    return {frozenset(sure | set(choice)): 1 / len(choices) for choice in choices}


def exact_sets(errors, ages, stages, uniform=False):
    """{frozenset: probability} of the whole draw."""
    errors, ages = np.asarray(errors, dtype=float), np.asarray(ages, dtype=float)
    mixed = np.ones(len(errors)) if uniform else errors / errors.sum() + ages / ages.sum()
    everything = frozenset(range(len(errors)))
    result = {}
    for first, p1 in successive(errors, stages[0], everything).items():
        for second, p2 in oldest(ages, stages[1], everything - first).items():
            for third, p3 in successive(mixed, stages[2], everything - first - second).items():
                drawn = first | second | third
                result[drawn] = result.get(drawn, 0.0) + p1 * p2 * p3
    return result


def drawn_units(sampler, rate, views, size, errors, ages, units):
    """[views, units] bool: what is drawn in as many equal views; `units` gives the unit of each pixel of a view. In
    iteration 0, where the grid of tiles begins with the image."""
    maps = ErrorMaps(np.tile(size, (views, 1)))
    for view in range(views):
        maps.initialise(view, torch.as_tensor(errors, dtype=torch.float32)[units])
    maps.stamps.copy_((-torch.as_tensor(ages)[units]).repeat(views))
    samples = sampler.sample(maps, tuple(range(views)), rate, step(0))
    filled = samples.filled
    drawn = torch.zeros(views, len(errors), dtype=torch.bool)
    drawn[samples.view_of_slot()[filled], units[samples.pixel_ids[filled].long()]] = True
    return drawn.numpy()


def assert_frequencies(drawn, exact):
    """Frequencies of single units and of whole sets against exact probabilities."""
    trials = len(drawn)
    inclusion = np.zeros(drawn.shape[1])
    for members, probability in exact.items():
        inclusion[list(members)] += probability
    spread = np.sqrt(inclusion * (1 - inclusion) / trials)
    assert (np.abs(drawn.mean(axis=0) - inclusion) <= SIGMAS * spread + 1e-9).all()
    counts = dict.fromkeys(exact, 0)
    for row in drawn:
        counts[frozenset(np.flatnonzero(row))] += 1
    for members, probability in exact.items():
        spread = np.sqrt(probability * (1 - probability) / trials)
        assert abs(counts[members] / trials - probability) <= SIGMAS * spread + 1 / trials


ERRORS = [0.125, 0.5, 1.0, 2.0, 0.25, 0.0625]
AGES = [3, 9, 9, 2, 9, 4]
STAGED = [
    (1.0, 0.0, "error_age", (3, 0, 0)),
    (0.0, 1.0, "error_age", (0, 3, 0)),
    (0.0, 0.0, "error_age", (0, 0, 3)),
    (0.0, 0.0, "uniform", (0, 0, 3)),
    (0.4, 0.3, "error_age", (1, 1, 1)),
    (0.4, 0.3, "uniform", (1, 1, 1)),
]


Y, X = np.mgrid[0:32, 0:48]
OF_UNIT = {
    "pixel": (3.5 / 256, 800, (3, 2), ERRORS, AGES, torch.arange(6)),  # 800 views of 3x2 pixels, 3 drawn of each
    "tile": (3 / 6, 300, (48, 32), ERRORS, AGES, torch.as_tensor((Y // 16 * 3 + X // 16).reshape(-1))),
}


@pytest.mark.parametrize(
    ("unit", "staged"), [*(("pixel", staged) for staged in STAGED), *(("tile", staged) for staged in STAGED[::2])]
)
def test_frequencies_are_exact(unit, staged):
    """Of pixels, and of six tiles of equal pixels, which are drawn by their sums."""
    hard, stable, mixed, stages = staged
    sampler = ErrorGuidedPixelSampler(hard_ratio=hard, stable_ratio=stable, mixed=mixed, unit=unit)
    drawn = drawn_units(sampler, *OF_UNIT[unit])
    assert (drawn.sum(axis=1) == 3).all()
    assert_frequencies(drawn, exact_sets(ERRORS, AGES, stages, mixed == "uniform"))


def test_a_tile_with_one_bad_pixel_counts_its_sum_and_its_oldest():
    errors, stamps = torch.zeros(64 * 64), torch.full((64 * 64,), -1)
    errors[17 * 2] = 1.0  # (34, 0): the third tile
    maps = ErrorMaps(np.array([[64, 64]]))
    maps.initialise(0, errors)
    stamps[60 * 64 + 60] = -2  # the last tile
    maps.stamps.copy_(stamps)
    samples = ErrorGuidedPixelSampler(hard_ratio=0.5, stable_ratio=0.5, unit="tile").sample(maps, (0,), 2 / 16, step(0))
    assert samples.tile_ids.tolist() == [2, 15]


def test_random_pixels_are_uniform():
    assert RandomPixelSampler().rule == ErrorGuidedPixelSampler(hard_ratio=0, stable_ratio=0, mixed="uniform").rule


@pytest.mark.parametrize(
    ("stages", "columns", "wanted", "tolerance"),
    [((1.0, 0.0), 12, 5, 0.0), ((0.0, 1.0), 12, 5, 0.0), ((0.0, 0.0), 12, 5, 0.0), ((0.4, 0.3), 64, 16, 0.02)],
)
def test_weights_make_sums_unbiased(stages, columns, wanted, tolerance):
    """Sums of 1 and of v over the drawn, divided by p, against the sums over all: exact for a single stage, and within
    2 % where three follow one another (they are combined as if independent)."""
    rows = 8_000
    generator = torch.Generator().manual_seed(3)
    errors = torch.rand(columns, generator=generator, dtype=torch.float64).half().double()
    values = torch.rand(columns, generator=generator, dtype=torch.float64)
    place = torch.arange(rows * columns).view(rows, columns)
    # Draws by age alone are unbiased only where ages are equal: a pixel too young has no chance at all.
    ages = torch.randint(1, 2 if stages[1] == 1.0 else 4, (rows, columns), generator=generator)
    exist = torch.ones_like(ages, dtype=torch.bool)
    words = random_words(place, 0, PURPOSE_PIXELS, 0, 0)
    rule = DrawRule("pixel", *stages, False, 1.0)
    drawn, probabilities = draw_units(errors.expand(rows, columns), ages, exist, words, wanted, rule)
    assert (drawn.sum(dim=1) == wanted).all()
    assert ((probabilities[drawn] > 0) & (probabilities[drawn] <= 1)).all()
    for quantity in (torch.ones(columns, dtype=torch.float64), values):
        estimates = torch.where(drawn, quantity / probabilities.double(), 0.0).sum(dim=1)
        error = abs(estimates.mean() - quantity.sum())
        assert error < SIGMAS * estimates.std() / rows**0.5 + tolerance * quantity.sum()


@pytest.mark.parametrize("importance", [0.25, 1.0])
def test_weights_have_mean_one_and_same_draw(importance):
    maps, views = random_maps(), (4, 0, 3)
    plain = ErrorGuidedPixelSampler().sample(maps, views, 0.2, step(95))
    weighted = ErrorGuidedPixelSampler(importance=importance).sample(maps, views, 0.2, step(95))
    assert torch.equal(plain.pixel_ids, weighted.pixel_ids)
    weights = weighted.weights[weighted.filled]
    assert weights.dtype == torch.float32 and (weights > 0).all() and weights.std() > 0.01
    assert (weighted.weights[~weighted.filled] == 0).all()
    assert weights.mean().item() == pytest.approx(1, abs=1e-5)
    everything = ErrorGuidedPixelSampler(importance=importance).sample(maps, views, 1.0, step(3))
    assert (everything.weights[everything.filled] == 1).all()


def test_what_was_likely_to_be_drawn_weighs_little_and_the_exponent_says_how_little():
    """Two errors a thousandfold apart, drawn by error alone: the weights of the small one are the large ones, and those
    of exponent 1 are the fourth power of the weights of 1/4, up to the factor that makes their mean 1."""
    generator = torch.Generator().manual_seed(5)
    large = torch.rand(32, 32, generator=generator) < 0.5
    errors = torch.where(large, 1.0, 1e-3)
    maps = ErrorMaps.from_images(errors[None])
    quarter, whole = (
        ErrorGuidedPixelSampler(hard_ratio=1.0, stable_ratio=0.0, importance=exponent).sample(maps, 0, 0.6, step(7))
        for exponent in (0.25, 1.0)
    )
    is_large = large.reshape(-1)[whole.pixel_ids.long()]
    assert 0 < int(is_large.sum()) < len(whole)
    assert whole.weights[~is_large].min() > whole.weights[is_large].max()
    factors = whole.weights / quarter.weights**4
    torch.testing.assert_close(factors, factors[:1].expand_as(factors), rtol=1e-4, atol=0.0)
