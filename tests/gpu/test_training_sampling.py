"""The CUDA pixel sampler draws the sets of its torch twin; means of maps on a GPU never stall."""

import numpy as np
import pytest
import torch
from helpers.raster_cases import GPU_ONLY

from turbogs_plugin.engine.cuda import training as training_kernels
from turbogs_plugin.engine.reference.draws import WEIGHT_FLOOR, draw_pixels
from turbogs_plugin.engine.reference.philox import PURPOSE_PIXELS, exponentials, random_words
from turbogs_plugin.engine.rules import DrawRule
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.types import Step

pytestmark = GPU_ONLY

DEVICE = "cuda"
SIZES = [(40, 33), (16, 16), (7, 50), (128, 64)]  # whole tiles, edge tiles, one tile, a narrow image
NOW = 7


def random_maps(seed=0, zero_share=0.3):
    """Errors with ties, zeros and wholly zero tiles; stamps in which most ages are equal."""
    generator = torch.Generator().manual_seed(seed)
    pixels = sum(width * height for width, height in SIZES)
    errors = 3 * torch.rand(pixels, generator=generator) ** 3
    errors[torch.rand(pixels, generator=generator) < zero_share] = 0
    errors[40 * 33 : 40 * 33 + 256] = 0  # the one-tile view
    stamps = torch.randint(-2, 5, (pixels,), generator=generator)
    stamps[:200] = -32767
    return errors.half(), stamps.to(torch.int16)


def make_maps(device, errors, stamps, sizes=SIZES):
    """Maps of training views 1, 4, 7, ...; those between are of one pixel. So a view's number is not its place."""
    padded = np.ones((3 * len(sizes), 2), dtype=np.int64)
    padded[1::3] = sizes
    maps = ErrorMaps(padded, device)
    counts = np.stack([np.ones_like(padded[1::3, 0]), padded[1::3].prod(axis=1), np.ones_like(padded[1::3, 0])], axis=1)
    used = torch.as_tensor(np.repeat(np.tile([False, True, False], len(sizes)), counts.reshape(-1)), device=device)
    maps.errors[used], maps.stamps[used] = errors.to(device), stamps.to(device)
    return maps


def draw_both(errors, stamps, views, rate, rule, seed, iteration, sizes=SIZES):
    """The draw of the kernels, and that of the reference."""
    step, numbers = Step(iteration, iteration + 1, iteration + 1, seed), tuple(3 * view + 1 for view in views)
    draws = {DEVICE: training_kernels.sample_pixels, "cpu": draw_pixels}
    samples = []
    for device, draw in draws.items():
        maps = make_maps(device, errors, stamps, sizes)
        maps.stamp_base = iteration - NOW
        samples.append(draw(rule, maps, numbers, rate, step))
    return samples


def assert_equal_samples(found, expected):
    assert found.view_ids == expected.view_ids
    for name in ("pixel_ids", "tile_ids", "tile_offsets"):
        assert getattr(found, name).dtype == torch.int32
        assert torch.equal(getattr(found, name).cpu(), getattr(expected, name)), name
    if expected.weights is None:
        assert found.weights is None
    else:
        torch.testing.assert_close(found.weights.cpu(), expected.weights, rtol=2e-5, atol=0)


@pytest.mark.parametrize("unit", ["pixel", "tile"])
@pytest.mark.parametrize("rate", [0.004, 0.1, 0.33, 1.0])
@pytest.mark.parametrize(
    ("hard", "stable", "uniform", "importance"),
    [(0.4, 0.3, False, 0.5), (0.4, 0.3, True, 0.0), (0.0, 0.0, True, 0.0), (1.0, 0.0, False, 1.0), (0, 1, False, 0.0)],
)
def test_equal_sets(unit, rate, hard, stable, uniform, importance):
    """The weights, too, where there are any."""
    errors, stamps = random_maps()
    rule = DrawRule(unit, hard, stable, uniform, importance * (unit == "pixel"))
    for iteration, views in enumerate([(0,), (3, 1, 0, 2)]):
        assert_equal_samples(*draw_both(errors, stamps, views, rate, rule, 2**40 + 5, iteration))


@pytest.mark.parametrize("rate", [0.01, 0.18, 0.33])
def test_equal_sets_in_multiples(rate):
    rule = DrawRule("pixel", 0.4, 0.3, False, 0.0, multiple=32)
    assert_equal_samples(*draw_both(*random_maps(), (3, 1, 0, 2), rate, rule, 2**40 + 5, 7))


@pytest.mark.parametrize("iteration", range(4))
def test_equal_sets_of_many_tiles(iteration):
    """So many that in about a hundred of them the approximate keys leave the set in doubt."""
    sizes = [(800, 640)]  # 2000 tiles, each with two races of 76 and 58 winners
    generator = torch.Generator().manual_seed(iteration)
    errors = torch.rand(800 * 640, generator=generator).square().half()
    stamps = torch.randint(-40, 5, (800 * 640,), generator=generator).to(torch.int16)
    rule = DrawRule("pixel", 0.4, 0.3, False, 0.0)
    assert_equal_samples(*draw_both(errors, stamps, (0,), 0.75, rule, 5, iteration, sizes))


@pytest.mark.parametrize("value", [0.0, 0.25])
def test_tied_errors_and_ages(value):
    """All errors and ages equal: only the random words and the ranks decide."""
    errors, stamps = random_maps()
    errors[:], stamps[:] = value, 3
    rule = DrawRule("pixel", 0.4, 0.3, False, 0.0)
    assert_equal_samples(*draw_both(errors, stamps, (0, 3), 0.1, rule, 0, 9))


@pytest.mark.parametrize("iteration", [144101, 222332, 285526])
def test_equal_keys_at_the_threshold(iteration):
    """Found by search: without errors, the 25th and 26th largest keys of this tile are one number; rank decides."""
    errors, stamps = random_maps()
    errors[:] = 0
    words = random_words(torch.arange(256), 4, PURPOSE_PIXELS, 0, iteration)
    keys = (torch.tensor(WEIGHT_FLOOR) / exponentials(words[0])).sort(descending=True).values
    assert keys[24] == keys[25]
    rule = DrawRule("pixel", 1.0, 0.0, False, 0.0)
    assert_equal_samples(*draw_both(errors, stamps, (1,), 0.1, rule, 0, iteration))


def test_exponentials_have_the_same_bits():
    words = torch.arange(1 << 23) << 9
    assert torch.equal(exponentials(words), exponentials(words.cuda()).cpu())


def test_means_are_a_known_number_of_calls_old():
    """With refresh = 4: exact at the first call, then the state of 4 to 7 calls before, also across a resume."""
    maps = ErrorMaps(np.array([[16, 16]]), device="cuda", refresh=4)
    maps.initialise(0, torch.zeros(256, device="cuda"))
    seen = []
    for call in range(18):
        maps.view_sums.fill_(256.0 * call)  # the mean at this call is its number
        if call in (7, 10):
            resumed = ErrorMaps(np.array([[16, 16]]), device="cuda", refresh=4)
            resumed.load_state_dict(maps.state_dict())
            maps = resumed
        seen.append(maps.view_means()[0])
    assert seen == [0, 0, 0, 0, 0, 0, 0, 0, 4, 4, 4, 4, 8, 8, 8, 8, 12, 12]


def test_sums_can_be_read_at_once_after_initialise():
    maps = ErrorMaps(np.array([[16, 16]]), device="cuda", refresh=4)
    for value in (1.0, 2.0, 3.0):
        maps.initialise(0, torch.full((256,), value, device="cuda"))
        assert maps.view_means()[0] == value
