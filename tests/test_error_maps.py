"""Error and age maps against straightforward models, and at their limits."""

import numpy as np
import pytest
import torch
from helpers.framework_runs import assert_identical
from helpers.refusals import assert_refused
from helpers.sampling_cases import step

from turbogs_plugin.error_maps import AGE_MAX, ErrorMaps
from turbogs_plugin.strategies.pixel_sampling import RandomPixelSampler
from turbogs_plugin.tiles import dense_pixels
from turbogs_plugin.types import PixelSamples

SIZES = np.array([[21, 17], [5, 40], [16, 16]])


def one_tile(pixel_ids, size=(16, 16), view_id=0):
    """Samples of a view of one tile."""
    ids = torch.tensor(pixel_ids, dtype=torch.int32)
    offsets = torch.tensor([0, len(pixel_ids)], dtype=torch.int32)
    return PixelSamples((view_id,), np.array([size]), ids, torch.zeros(1, dtype=torch.int32), offsets)


def test_means_of_given_images():
    images = [torch.rand(17, 21), torch.rand(40, 5)]
    maps = ErrorMaps.from_images(images)
    assert maps.sizes.tolist() == [[21, 17], [5, 40]]
    expected = [image.half().double().mean().item() for image in images]
    assert maps.view_means() == pytest.approx(expected, rel=1e-14)
    assert torch.equal(maps.errors[17 * 21 :], images[1].half().reshape(-1))
    assert torch.equal(maps.view_errors(1), images[1].half().float().reshape(-1))


def test_updates_follow_the_equations():
    """Ten iterations against a loop over pixels; the sums are exact."""
    generator = torch.Generator().manual_seed(1)
    maps = ErrorMaps(SIZES, beta=0.4)
    starts = maps.offsets
    for view_id, (width, height) in enumerate(SIZES):
        maps.initialise(view_id, torch.rand(int(width * height), generator=generator) * 3)
    errors = maps.errors.numpy().copy()
    counters = np.zeros(len(errors), dtype=int)  # the paper's ages
    keep, blend = np.float32(1 - 0.4), np.float32(0.4)
    for t in range(10):
        views = [(0, 2), (1,), (2, 1, 0)][t % 3]
        samples = RandomPixelSampler().sample(maps, views, 0.2, step(t))
        new = torch.rand(len(samples), generator=generator) * 3
        for view_id in range(3):
            ages = maps.ages(view_id, step(t)).numpy()
            assert (ages == counters[starts[view_id] : starts[view_id + 1]] + 1).all()
        maps.update(samples, new, step(t))
        counters += 1
        for view, pixel, error in zip(samples.view_of_slot().tolist(), samples.pixel_ids.tolist(), new, strict=True):
            flat = starts[views[view]] + pixel
            errors[flat] = np.float16(np.float32(errors[flat]) * keep + np.float32(error) * blend)
            counters[flat] = 0
        assert (maps.errors.numpy() == errors).all()
        sums = [errors[starts[v] : starts[v + 1]].astype(np.float64).sum() for v in range(3)]
        assert maps.view_sums.tolist() == sums


def test_empty_slots_touch_nothing():
    maps = ErrorMaps.from_images(torch.rand(1, 16, 16))
    before = maps.state_dict()
    maps.update(one_tile([-1, -1]), torch.tensor([2.0, torch.nan]), step(5))
    assert all(torch.equal(before[name], maps.state_dict()[name]) for name in ("errors", "stamps", "view_sums"))


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
def test_non_finite_errors_change_nothing_of_their_pixel(bad):
    maps = ErrorMaps.from_images(torch.full((1, 16, 16), 0.5))
    maps.update(one_tile([3, 200]), torch.tensor([bad, 1.5]), step(9))
    assert maps.errors[[3, 200]].tolist() == pytest.approx([0.5, 0.9], abs=1e-3)
    assert maps.ages(0, step(9))[[3, 200]].tolist() == [10, 0]
    assert maps.view_sums[0] == maps.errors.double().sum()


def test_non_finite_and_huge_initial_errors():
    errors = torch.zeros(256)
    errors[:5] = torch.tensor([torch.nan, torch.inf, -torch.inf, 1e30, -1.0])
    maps = ErrorMaps(np.array([[16, 16]]))
    maps.initialise(0, errors)
    assert maps.errors[:5].tolist() == [0, 0, 0, 65504, 0]
    assert maps.view_sums.item() == 65504


def test_errors_saturate_at_the_largest_half():
    maps = ErrorMaps.from_images(torch.zeros(1, 16, 16))
    everything = dense_pixels((0,), maps.sizes, "cpu")
    for t in range(20):
        maps.update(everything, torch.full((256,), 3e38), step(t))
    assert (maps.errors == 65504).all()
    assert maps.view_sums.item() == 256 * 65504
    for t in range(20, 120):
        maps.update(everything, torch.zeros(256), step(t))
    assert maps.view_sums.item() == maps.errors.double().sum().item()
    assert 0 <= maps.view_means()[0] < 1e-6


def test_ages_saturate_and_never_wrap():
    """Visits spread over 210,000 iterations, with gaps around every limit of 15, 16 and 17 bits."""
    times = [0, 1, 32766, 32767, 32768, 32770, 65534, 65535, 65536, 65540, 98304, 131073, 131080, 170000, 209999]
    maps = ErrorMaps(np.array([[16, 16]]))
    visited = np.full(256, -1)
    for place, t in enumerate(times):
        for now in (t - 1, t):
            if now >= 0:
                expected = np.minimum(now - visited, AGE_MAX)
                assert (maps.ages(0, step(now)).numpy() == expected).all()
        pixels = [place, place + 100]
        maps.update(one_tile(pixels), torch.ones(2), step(t))
        visited[pixels] = t
        assert (maps.ages(0, step(t)).numpy() == np.minimum(t - visited, AGE_MAX)).all()
    assert maps.ages(0, step(300_000)).tolist() == [AGE_MAX] * 256


def test_resume_is_bit_identical():
    """And a state is a copy, which further updates leave alone."""

    def run(maps, begin, end):
        for t in range(begin, end):
            samples = RandomPixelSampler().sample(maps, (1, 0), 0.3, step(t))
            maps.update(samples, torch.rand(len(samples), generator=torch.Generator().manual_seed(t)), step(t))
        return maps.state_dict()

    first, resumed = ErrorMaps(SIZES), ErrorMaps(SIZES)
    state = run(first, 0, 5)
    whole = run(first, 5, 8)
    resumed.load_state_dict(state)
    assert_identical(run(resumed, 5, 8), whole)


def test_errors_come_without_their_graph():
    image = torch.rand(1, 16, 16, requires_grad=True)
    maps = ErrorMaps.from_images(image)
    maps.initialise(0, image.reshape(-1))
    for t in range(2):
        maps.update(one_tile([3, 200]), torch.ones(2, requires_grad=True) * 2.0, step(t))
    assert not maps.errors.requires_grad and not maps.view_sums.requires_grad
    assert maps.view_means()[0] * 256 == maps.errors.double().sum()


@pytest.mark.parametrize("shape", [(), (1,), (2, 1), (2, 3), (1, 2), (3,)])
def test_errors_of_another_shape_change_nothing(shape):
    maps = ErrorMaps.from_images(torch.rand(1, 16, 16))
    before = maps.state_dict()
    assert_refused(r"expected \(2,\)", maps.update, one_tile([3, 200]), torch.ones(shape), step(AGE_MAX + 5))
    after = maps.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in ("errors", "stamps", "view_sums"))
    assert after["stamp_base"] == before["stamp_base"]


def test_wrong_shape_and_options_are_named():
    for images in (torch.rand(2, 16, 16, 3), np.zeros((2, 16, 16)), [], torch.full((2, 16, 16), torch.nan)):
        assert_refused(r"a finite tensor .H, W. for each view", ErrorMaps.from_images, images)
    assert_refused(r"view 1 have shape \(7,\), expected \(200,\)", ErrorMaps(SIZES).initialise, 1, torch.zeros(7))
    for option, value in {"beta": 0.0, "refresh": 0}.items():
        assert_refused(option, ErrorMaps, SIZES, **{option: value})
