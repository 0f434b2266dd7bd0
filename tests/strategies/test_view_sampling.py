"""View selection: the anchor, the exact probabilities of the draw, and the stack."""

import numpy as np
import pytest
import torch
from helpers.refusals import assert_refused
from helpers.sampling_cases import successive

from turbogs_plugin.scene.geometry import look_at
from turbogs_plugin.strategies.view_sampling import GeometryAwareViewSampler, RandomViewSampler, doubted
from turbogs_plugin.types import Cameras, Step

SAMPLERS = [GeometryAwareViewSampler, RandomViewSampler]


def step(iteration, seed=0):
    return Step(iteration=iteration, total=1000, refine_until=1000, seed=seed)


def orbit(num_views, radius=1.0):
    """Cameras on a circle that look at its centre."""
    angles = np.linspace(0, 2 * np.pi, num_views, endpoint=False)
    places = radius * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    viewmats = torch.from_numpy(np.stack([look_at(place, np.zeros(3), np.eye(3)[2]) for place in places])).float()
    return Cameras(viewmats, torch.eye(3).repeat(num_views, 1, 1), np.full((num_views, 2), 16))


def ready(sampler, cameras, extent=1.1):
    sampler.setup(cameras, extent)
    return sampler


def test_log_weights_follow_the_equation():
    cameras = orbit(7, radius=3.0)
    sampler = ready(GeometryAwareViewSampler(distance_weight=1.5, direction_weight=0.7), cameras, 2.0)
    angles = 2 * np.pi * np.arange(7) / 7
    centers = 3.0 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for anchor in range(7):
        distances = np.linalg.norm(centers - centers[anchor], axis=1) / 2.0
        expected = -1.5 * distances - 0.7 * (1 - np.cos(angles - angles[anchor]))
        assert sampler.log_weights(anchor) == pytest.approx(expected, abs=1e-5)


def test_frequencies_are_those_of_draws_without_replacement():
    """5,000 draws of the 3 others around the anchor; each frequency within 4.5 standard deviations."""
    sampler, trials = ready(GeometryAwareViewSampler(2.0, 1.0), orbit(7)), 5000
    errors = np.array([0.1, 0.2, 0.9, 0.3, 0.1, 0.1, 0.1])
    counts = np.zeros(7)
    for trial in range(trials):
        views = sampler.select(4, errors, step(trial))  # of all 7: three are left, so the stack is filled again
        assert views[0] == 2
        counts[list(views)] += 1
    others = np.delete(np.arange(7), 2)
    weights = np.exp(sampler.log_weights(2))[others]
    expected = np.zeros(6)
    for members, probability in successive(weights, 3, frozenset(range(6))).items():
        expected[list(members)] += probability
    spread = np.sqrt(expected * (1 - expected) / trials)
    assert (np.abs(counts[others] / trials - expected) < 4.5 * spread).all()


def test_anchor_is_the_worst_view_left_on_the_stack():
    sampler = ready(GeometryAwareViewSampler(), orbit(9))
    errors = np.array([0.3, 0.8, 0.1, 0.9, 0.2, 0.5, 0.4, 0.7, 0.6])
    left = set(range(9))
    for t in range(3):
        views = sampler.select(3, errors, step(t))
        assert views[0] == max(left, key=lambda view: errors[view])
        left -= set(views)
    assert not left


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_stack_is_refilled_when_too_few_are_left(sampler):
    sampler = ready(sampler(), orbit(8))
    errors = np.linspace(0, 1, 8)
    first, second = sampler.select(3, errors, step(0)), sampler.select(3, errors, step(1))
    assert len(set(first + second)) == 6
    third = sampler.select(3, errors, step(2))  # two are left: all eight come back
    assert len(set(third)) == 3 and len(sampler.stack) == 5
    for t in range(3, 6):
        assert sorted(sampler.select(10, errors, step(t))) == list(range(8)), "fewer views than asked for"


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_draws_depend_on_seed_and_iteration_alone(sampler):
    cameras, errors = orbit(30), np.zeros(30)
    draws = [ready(sampler(), cameras).select(5, errors, step(t, seed)) for t, seed in [(4, 1), (4, 1), (5, 1), (4, 2)]]
    assert draws[0] == draws[1]
    assert len(set(draws)) == 3


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_resume_goes_on_as_before(sampler):
    cameras, errors = orbit(11), np.linspace(1, 2, 11)
    whole = ready(sampler(), cameras)
    for t in range(3):
        whole.select(3, errors, step(t))
    resumed = ready(sampler(), cameras)
    resumed.load_state_dict(whole.state_dict())
    for t in range(3, 12):
        assert whole.select(3, errors, step(t)) == resumed.select(3, errors, step(t))


def test_views_a_million_extents_away_do_not_underflow():
    """exp(-2e6) is 0 for every candidate, yet the nearer ones win."""
    cameras = orbit(6)
    cameras.viewmats[1:4, 0, 3] += 1.0e6
    cameras.viewmats[4:, 0, 3] += 3.0e6
    sampler = ready(GeometryAwareViewSampler(), cameras)
    first, *others = sampler.select(4, np.array([1.0, 0, 0, 0, 0, 0]), step(0))
    assert first == 0 and set(others) == {1, 2, 3}


def test_the_stack_and_the_draw_from_it_have_random_numbers_of_their_own():
    geometry, shuffled = ready(GeometryAwareViewSampler(0.0, 0.0), orbit(6)), ready(RandomViewSampler(), orbit(6))
    fresh, last = geometry.state_dict(), 0
    for t in range(40):
        geometry.load_state_dict(fresh)
        first, second = geometry.select(2, np.zeros(6), step(t))
        order = shuffled.select(6, np.zeros(6), step(t))
        assert first == order[0]
        last += second == order[-1]
    assert last < 20  # 8 by chance


@pytest.mark.parametrize("extent", [0.0, 1.0])
def test_identical_cameras_are_all_drawn(extent):
    """An extent that is no number is named."""
    sampler = ready(GeometryAwareViewSampler(), orbit(1).select([0] * 5), extent)
    draws = [sampler.select(2, np.zeros(5), step(t)) for t in range(10)]
    assert {view for draw in draws for view in draw} == set(range(5)) and all(len(set(draw)) == 2 for draw in draws)
    assert_refused("scene_extent", GeometryAwareViewSampler().setup, orbit(3), float("nan"))


def test_a_photo_that_the_model_does_not_explain_comes_in_one_of_five_rounds():
    sampler, errors = ready(RandomViewSampler(), orbit(20)), 1.0 + 0.01 * np.arange(20)
    errors[[3, 11]] = 9.0
    assert np.flatnonzero(doubted(errors)).tolist() == [3, 11]
    counts = np.zeros(20)
    for iteration in range(200, 900):
        counts[list(sampler.select(18, errors, step(iteration)))] += 1
    assert (counts[[3, 11]] < 0.35 * 700).all() and (counts[[3, 11]] > 0.1 * 700).all()
    assert np.delete(counts, [3, 11]).min() > 0.85 * 700
    early = [view for _ in range(20) for view in sampler.select(20, errors, step(10))]
    assert early.count(3) == 20, "before a fifth of densification no photo is doubted"


@pytest.mark.parametrize(
    "errors", [np.ones(6), np.zeros(6), np.array([1, 1.1, 0.9, 1.2, 1, 2.4]), np.geomspace(1, 20, 30)]
)
def test_photos_that_are_harder_than_others_are_not_doubted(errors):
    assert not doubted(errors).any()
