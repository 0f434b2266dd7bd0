"""How many iterations fit into a time, on synthetic machines."""

import math
import random

import pytest

from turbogs_plugin.config.sections import TrainConfig
from turbogs_plugin.plan.caps import EXPECTED_GROWTH
from turbogs_plugin.plan.time import FEWEST_SHARE, IterationCost, fit_to_time
from turbogs_plugin.train.pace import TimePace

COST = IterationCost(base=2e-3, per_gaussian=2e-8)


def test_cost_through_two_measurements():
    measured = IterationCost.through((1000, COST.at(1000)), (8000, COST.at(8000)))
    assert measured.at(50_000) == pytest.approx(COST.at(50_000))
    assert IterationCost.through((1000, 2.0), (2000, 1.0)) == IterationCost(1.0, 0.0)  # noise: no slope below zero
    steep = IterationCost.through((1000, 0.1), (2000, 1.0))
    assert steep.base >= 0 and steep.at(2000) == pytest.approx(1.0)


def test_a_generous_time_is_used_for_iterations():
    iterations, cap = fit_to_time(100.0, COST, initial=50_000, cap=0, iterations=5000, refine_share=0.7)
    assert cap == 0
    mean = (0.35 + 0.65 * EXPECTED_GROWTH) * 50_000
    assert iterations == int(100.0 / COST.at(mean)) > 5000
    assert fit_to_time(100.0, COST, 50_000, 60_000, 5000, 0.7)[0] > iterations  # fewer Gaussians, faster iterations


def test_a_short_time_gives_up_gaussians_before_iterations():
    seconds = 1.1 * FEWEST_SHARE * 5000 * COST.at(60_000)
    iterations, cap = fit_to_time(seconds, COST, 50_000, 0, 5000, 0.7)
    assert 50_000 <= cap < 200_000
    assert iterations == pytest.approx(FEWEST_SHARE * 5000, rel=0.01)
    assert fit_to_time(seconds, COST, 50_000, 0, 5000, 0.7, keeps_cap=False)[1] == 0  # it would keep no other
    iterations, cap = fit_to_time(0.5, COST, 50_000, 0, 5000, 0.7)
    assert (iterations, cap) == (int(0.5 / COST.at(50_000)), 50_000)  # no growth at all, and what fits
    assert fit_to_time(1e-9, COST, 50_000, 0, 5000, 0.7)[0] == 1


def new_pace(
    seconds: float, iterations: int, refine_until: int, cost: IterationCost | None = None, cap: int = 0
) -> TimePace:
    return TimePace(TrainConfig(iterations=iterations, refine_until=refine_until), seconds, cost, cap)


def simulate(pace: TimePace, cost, count, seconds: float = 0.0) -> list[tuple[int, float, int, int]]:
    """Train by a pace on a machine where iteration i takes cost(i) with count(i / iterations) Gaussians."""
    iteration, marks = 0, []
    pace.start(iteration, seconds, count(0, pace))
    while iteration < pace.iterations:
        mark = pace.next_mark(iteration, seconds)
        assert mark > iteration
        while iteration < mark:
            seconds += cost(iteration, count(iteration, pace))
            iteration += 1
        pace.reached(iteration, seconds, count(iteration, pace))
        marks.append((iteration, seconds, pace.iterations, pace.refine_until))
    return marks


def growing(iteration: int, pace: TimePace) -> int:
    return int(50_000 + 150_000 * min(1.0, iteration / max(1, pace.refine_until)))


MACHINES = {
    "as calibrated": lambda i, n: COST.at(n),
    "twice as slow": lambda i, n: 2.0 * COST.at(n),
    "three times as fast": lambda i, n: COST.at(n) / 3.0,
    "slower from the middle on": lambda i, n: COST.at(n) * (1.0 if i < 1500 else 1.7),
    "noisy": lambda i, n: COST.at(n) * random.Random(i).choice([0.5, 1.0, 1.0, 3.0]),
    "events": lambda i, n: COST.at(n) + (0.05 if i % 100 == 0 else 0.0),
    "cost not of the model": lambda i, n: 3e-3 + 1e-13 * n * n,
}


@pytest.mark.parametrize("machine", MACHINES)
@pytest.mark.parametrize("seconds", [5.0, 20.0])
def test_a_run_ends_with_its_time(machine, seconds):
    iterations, cap = fit_to_time(seconds, COST, 50_000, 0, 5000, 0.7)
    pace = new_pace(seconds, iterations, round(0.7 * iterations), COST, cap)
    marks = simulate(pace, MACHINES[machine], growing)
    assert marks[-1][1] == pytest.approx(seconds, rel=0.02)
    assert marks[-1][0] == pace.iterations
    assert len(marks) >= 30
    # Density control ended on the way, about where it was to, and did not begin again.
    assert 0.5 < pace.refine_until / pace.iterations < 0.9
    over = [until for iteration, _, _, until in marks if iteration >= until]
    assert len(set(over)) == 1


def test_few_slow_iterations_end_within_half_of_one():
    pace = new_pace(10.0, 40, 28)
    marks = simulate(pace, lambda i, n: 0.4, lambda i, pace: 100)
    assert 9.8 <= marks[-1][1] <= 10.2


def test_a_plan_foresees_growth():
    """With what it knows after a tenth of the run, the length is within a fifth of what it will be."""
    iterations, _ = fit_to_time(20.0, COST, 50_000, 0, 5000, 0.7)
    pace = new_pace(20.0, iterations, round(0.7 * iterations), COST)
    marks = simulate(pace, lambda i, n: 1.5 * COST.at(n), growing)
    early = next(planned for iteration, seconds, planned, _ in marks if seconds > 2.0)
    assert math.isclose(early, pace.iterations, rel_tol=0.2)


def test_growth_is_foreseen_up_to_the_cap_alone():
    """A model that has just come to its cap goes on at its present cost."""
    lengths = []
    for cap in (0, 100_000, 60_000):
        pace = new_pace(20.0, 4000, 2800, COST, cap)
        pace.start(0, 0.0, 50_000)
        pace.reached(100, 0.5, 60_000)
        lengths.append(pace.iterations)
    assert lengths[0] < lengths[1] < lengths[2] == 100 + 19.5 / 0.005


def test_near_its_end_a_run_looks_at_the_clock_after_half_of_what_is_left():
    pace = new_pace(16.0, 4096, 2800)
    pace.start(4032, 15.75, 60_000)
    assert pace.next_mark(4032, 15.75) == 4032 + 32


def test_a_plan_goes_on_after_a_stop():
    pace = new_pace(20.0, 4000, 2800)
    pace.start(1000, 5.0, 60_000)
    assert pace.next_mark(1000, 5.0) == 1000 + int(0.03 * 20.0 / (15.0 / 3000))
    pace.reached(1120, 6.2, 60_000)
    assert abs(pace.iterations - (1120 + 13.8 / (0.5 * (15.0 / 3000 + 1.2 / 120)))) <= 1
