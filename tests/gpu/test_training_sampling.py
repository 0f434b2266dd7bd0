"""The CUDA pixel sampler draws the sets of its torch twin."""

import numpy as np
import pytest
import torch

from turbogs_plugin.engine.cuda import library as kernels
from turbogs_plugin.engine.cuda import training as training_kernels
from turbogs_plugin.engine.reference.draws import WEIGHT_FLOOR, DrawRule, draw_pixels
from turbogs_plugin.engine.reference.philox import PURPOSE_PIXELS, exponentials, random_words

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not kernels.available(), reason=kernels.unavailable_reason() or "available"),
]

DEVICE = "cuda"
SIZES = [(40, 33), (16, 16), (7, 50), (128, 64)]  # whole tiles, edge tiles, one tile, a narrow image


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


def arguments(errors, stamps, views, rate, rule, seed, iteration):
    offsets = np.concatenate([[0], np.cumsum([width * height for width, height in SIZES])])
    sizes = np.array([SIZES[view] for view in views], dtype=np.int64)
    numbers = tuple(3 * view + 1 for view in views)  # of training views: only the random words see them
    return errors, stamps, 7, offsets[list(views)], sizes, numbers, rate, rule, seed, iteration


def assert_equal_samples(found, expected):
    assert found.view_ids == expected.view_ids
    for name in ("pixel_ids", "tile_ids", "tile_offsets"):
        assert getattr(found, name).dtype == torch.int32
        assert torch.equal(getattr(found, name).cpu(), getattr(expected, name)), name
    if expected.weights is None:
        assert found.weights is None
    else:
        torch.testing.assert_close(found.weights.cpu(), expected.weights, rtol=2e-5, atol=0)


@pytest.mark.parametrize("unit", ["pixel", "cell", "tile"])
@pytest.mark.parametrize("rate", [0.004, 0.1, 0.33, 1.0])
@pytest.mark.parametrize(
    ("hard", "stable", "uniform"),
    [(0.4, 0.3, False), (0.4, 0.3, True), (0.0, 0.0, True), (1.0, 0.0, False), (0, 1, False)],
)
def test_equal_sets(unit, rate, hard, stable, uniform):
    errors, stamps = random_maps()
    rule = DrawRule(unit, hard, stable, uniform, 0.0)
    for iteration, views in enumerate([(0,), (3, 1, 0, 2)]):
        given = arguments(errors, stamps, views, rate, rule, 2**40 + 5, iteration)
        on_device = (errors.to(DEVICE), stamps.to(DEVICE), *given[2:])
        assert_equal_samples(training_kernels.sample_pixels(*on_device), draw_pixels(*given))


@pytest.mark.parametrize("iteration", range(4))
def test_equal_sets_of_many_tiles(iteration):
    """So many that in about a hundred of them the approximate keys leave the set in doubt."""
    sizes = np.array([[800, 640]])  # 2000 tiles, each with two races of 76 and 58 winners
    generator = torch.Generator().manual_seed(iteration)
    errors = torch.rand(800 * 640, generator=generator).square().half()
    stamps = torch.randint(-40, 5, (800 * 640,), generator=generator).to(torch.int16)
    rule = DrawRule("pixel", 0.4, 0.3, False, 0.0)
    given = (7, np.zeros(1, dtype=np.int64), sizes, (3,), 0.75, rule, 5, iteration)
    found = training_kernels.sample_pixels(errors.to(DEVICE), stamps.to(DEVICE), *given)
    assert_equal_samples(found, draw_pixels(errors, stamps, *given))


@pytest.mark.parametrize("unit", ["pixel", "cell", "tile"])
@pytest.mark.parametrize("importance", [0.5, 1.0])
def test_importance_weights(unit, importance):
    errors, stamps = random_maps(seed=1)
    rule = DrawRule(unit, 0.4, 0.3, False, importance)
    given = arguments(errors, stamps, (2, 3), 0.2, rule, 11, 400)
    on_device = (errors.to(DEVICE), stamps.to(DEVICE), *given[2:])
    assert_equal_samples(training_kernels.sample_pixels(*on_device), draw_pixels(*given))


@pytest.mark.parametrize("value", [0.0, 0.25])
def test_tied_errors_and_ages(value):
    """All errors and ages equal: only the random words and the ranks decide."""
    errors, stamps = random_maps()
    errors[:], stamps[:] = value, 3
    given = arguments(errors, stamps, (0, 3), 0.1, DrawRule("pixel", 0.4, 0.3, False, 0.0), 0, 9)
    on_device = (errors.to(DEVICE), stamps.to(DEVICE), *given[2:])
    assert_equal_samples(training_kernels.sample_pixels(*on_device), draw_pixels(*given))


@pytest.mark.parametrize("iteration", [144101, 222332, 285526])
def test_equal_keys_at_the_threshold(iteration):
    """Found by search: without errors, the 25th and 26th largest keys of this tile are one number; rank decides."""
    errors, stamps = random_maps()
    errors[:] = 0
    given = arguments(errors, stamps, (1,), 0.1, DrawRule("pixel", 1.0, 0.0, False, 0.0), 0, iteration)
    words = random_words(torch.arange(256), 4, PURPOSE_PIXELS, 0, iteration)
    keys = (torch.tensor(WEIGHT_FLOOR) / exponentials(words[0])).sort(descending=True).values
    assert keys[24] == keys[25]
    on_device = (errors.to(DEVICE), stamps.to(DEVICE), *given[2:])
    assert_equal_samples(training_kernels.sample_pixels(*on_device), draw_pixels(*given))


def test_wrong_tensors_are_named():
    errors, stamps = random_maps()
    given = arguments(errors, stamps, (0,), 0.1, DrawRule("pixel", 0.4, 0.3, False, 0.0), 0, 0)
    with pytest.raises(RuntimeError, match="errors must be a contiguous"):
        training_kernels.sample_pixels(errors.float().to(DEVICE), stamps.to(DEVICE), *given[2:])
    with pytest.raises(RuntimeError, match="stamps must be a contiguous"):
        training_kernels.sample_pixels(errors.to(DEVICE), stamps.to(DEVICE).repeat_interleave(2)[::2], *given[2:])
