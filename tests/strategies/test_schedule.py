"""Schedules against the appendix's equations in closed form."""

import math

import pytest

from turbogs_plugin.strategies.schedule import ExponentialSchedule, FixedSchedule, LinearSchedule, SinusoidalSchedule
from turbogs_plugin.types import Step

ADAPTIVE = [SinusoidalSchedule, LinearSchedule, ExponentialSchedule]


def step(iteration=0):
    return Step(iteration=iteration, total=5000, refine_until=3500)


@pytest.mark.parametrize("schedule", ADAPTIVE)
def test_both_ends(schedule):
    start = schedule().query(step(0), 0.3, 0.3, 100)
    end = schedule().query(step(3500), 0.3, 0.3, 100)
    after = schedule().query(step(4999), 0.3, 0.3, 100)
    assert (start.views, start.rate) == (10, pytest.approx(0.1))
    assert (end.views, end.rate) == (3, pytest.approx(1 / 3)) and after == end


@pytest.mark.parametrize(
    ("schedule", "phi"),
    [
        (SinusoidalSchedule(), math.sin(math.pi / 2 * math.sqrt(0.25))),
        (LinearSchedule(), 0.25),
        (ExponentialSchedule(), (1 - math.exp(-0.75)) / (1 - math.exp(-3))),
    ],
)
def test_between(schedule, phi):
    x = 1 - 0.6 * phi  # anneal is 0.6 at 1400 of 3500
    budget = schedule.query(step(1400), 0.05, 0.2, 100)
    assert budget.views == round(3 + 7 * math.exp(-3 * x))
    assert budget.rate == pytest.approx(0.1 + (1 / 3 - 0.1) * x)


@pytest.mark.parametrize("budget", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("num_views", [2, 5, 100])
def test_pixels_of_an_iteration_stay_at_the_budget(budget, num_views):
    schedule = SinusoidalSchedule(pixel_budget=budget)
    for iteration in range(0, 5000, 100):
        drawn = schedule.query(step(iteration), 0.1, 0.3, num_views)
        assert 1 <= drawn.views <= num_views and drawn.rate <= 1
        # K is rounded to a whole number, which moves the product by up to a quarter.
        assert drawn.views * drawn.rate == pytest.approx(min(budget, drawn.views), rel=0.25)


@pytest.mark.parametrize("schedule", [*ADAPTIVE, FixedSchedule])
def test_a_budget_of_more_images_than_views_takes_whole_views(schedule):
    budget = schedule(pixel_budget=2.5).query(step(1400), 0.1, 0.3, 2)
    assert (budget.views, budget.rate) == (2, 1.0)


@pytest.mark.parametrize(
    ("mean", "initial"), [(0.0, 0.0), (1.0, 0.0), (5.0, 0.1), (math.nan, 0.1), (math.inf, math.inf)]
)
def test_degenerate_errors_give_a_valid_budget(mean, initial):
    budget = SinusoidalSchedule().query(step(0), mean, initial, 50)
    assert 3 <= budget.views <= 10
    assert 0.1 <= budget.rate <= 1 / 3 + 1e-12


@pytest.mark.parametrize(
    ("views", "num_views", "expected"), [(1, 50, (1, 1.0)), (10, 50, (10, 0.1)), (10, 2, (2, 0.5))]
)
def test_fixed(views, num_views, expected):
    for iteration in (0, 4999):
        budget = FixedSchedule(views=views).query(step(iteration), 0.1, 0.3, num_views)
        assert (budget.views, budget.rate) == (expected[0], pytest.approx(expected[1]))
