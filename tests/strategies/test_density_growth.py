"""Orders in which Gaussians grow and go, and the events that use them."""

from __future__ import annotations

import math

import pytest
import torch
from helpers.optimizers import busy_stats, fill, make_gaussians, random_stats

from turbogs_plugin.strategies.density.error_driven import ErrorDrivenDensity
from turbogs_plugin.strategies.density.growth import drawn_by_squares, squares_of
from turbogs_plugin.types import GaussianStats, Step

COUNT = 40
FULL = Step(1200, 3500, 3500, seed=3, scene_extent=2.0)  # no final pruning follows
FINAL = Step(4000, 5000, 3500)
GROWS = {
    "grad_threshold": 0.0,
    "absgrad_threshold": 0.0,
    "top_fraction": 1.0,
    "prune_world_size": 0.0,
    "prune_opacity": 0.0,
}
"""All that is seen may grow, and nothing is pruned but by the order."""


def controlled(gaussians, stats: GaussianStats, **config) -> ErrorDrivenDensity:
    density = ErrorDrivenDensity(**config)
    density.setup(gaussians)
    fill(density.stats, stats)
    return density


def grown(update) -> set[int]:
    """Rows that the event cloned or split."""
    sources = update.source.tolist()
    return {row for row in sources if sources.count(row) > 1}


def squares_only(squares: list[float]) -> GaussianStats:
    stats = busy_stats(len(squares))
    stats.square_sums[:] = torch.tensor(squares)
    return stats


def first_drawn(squares: list[float], draws: int) -> list[float]:
    """Share of draws in which each row comes first."""
    stats = squares_only(squares)
    steps = (Step(100 * i, 10**9, 10**9, seed=0) for i in range(draws))
    first = [int(drawn_by_squares(stats, step).argmax()) for step in steps]
    return [first.count(row) / draws for row in range(len(squares))]


def test_a_draw_has_the_chances_of_the_squares():
    shares = first_drawn([0.0, 1e-9, 1e-9, 8e-9, math.nan], 1000)
    assert shares[0] == shares[4] == 0
    assert abs(shares[3] - 0.8) < 0.05 and abs(shares[1] - 0.1) < 0.04 and abs(shares[2] - 0.1) < 0.04


def test_a_draw_is_a_function_of_seed_and_iteration():
    stats = random_stats(COUNT, seed=1)
    one, same, later, other = (
        drawn_by_squares(stats, step)
        for step in (FULL, FULL, Step(1300, 3500, 3500, seed=3), Step(1200, 3500, 3500, seed=4))
    )
    assert torch.equal(one, same) and not torch.equal(one, later) and not torch.equal(one, other)


@pytest.mark.parametrize("how", ["difficulty", "squares"])
def test_a_cap_takes_the_first_by_the_given_order(how):
    gaussians, stats = make_gaussians(COUNT), random_stats(COUNT, seed=1, seen=1.0)
    density = controlled(gaussians, stats, choose_by=how, max_gaussians=COUNT + 5, **GROWS)
    keys = density.scores(FULL)[0] if how == "difficulty" else drawn_by_squares(stats, FULL)
    keys[stats.weight_sums == 0] = -torch.inf
    assert grown(density.update(gaussians, FULL)) == set(keys.argsort(descending=True)[:5].tolist())


def test_a_cap_with_room_for_all_grows_all_whatever_the_order():
    gaussians, stats = make_gaussians(COUNT), random_stats(COUNT, seed=1, seen=1.0)
    updates = [
        controlled(gaussians, stats, choose_by=how, max_gaussians=cap, **GROWS).update(gaussians, FULL)
        for how, cap in (("difficulty", 0), ("squares", 0), ("squares", 2 * COUNT))
    ]
    assert torch.equal(updates[0].source, updates[1].source) and torch.equal(updates[0].source, updates[2].source)


def test_a_draw_takes_as_many_as_pass_the_gate_from_all_the_seen():
    """A Gaussian that does not pass may be drawn: what has many samples with opposed gradients needs company.

    Only the gate of the absolute gradient counts: neither the signed gradient nor the score.
    """
    gaussians, stats = make_gaussians(COUNT), random_stats(COUNT, seed=1, seen=0.9)
    stats.grad_sums[:] = 1e3
    stats.absgrad_sums[:] = 0
    stats.absgrad_sums[:8] = 1e3
    stats.square_sums[:20] = 0  # TINY: these come last
    density = controlled(
        gaussians, stats, choose_by="squares", **GROWS | {"absgrad_threshold": 1.0, "top_fraction": 0.1}
    )
    drawn = grown(density.update(gaussians, FULL))
    assert len(drawn) == int((stats.weight_sums[:8] > 0).sum()) > 0
    assert min(drawn) >= 20 and all(stats.weight_sums[row] > 0 for row in drawn)


def test_prunings_by_squares_take_the_least_of_the_seen():
    gaussians, stats = make_gaussians(10), squares_only([3.0, 0.0, 5.0, 1.0, 6.0, 7.0, 2.0, 8.0, 9.0, 4.0])
    stats.weight_sums[1] = 0
    density = controlled(gaussians, stats, choose_by="squares", final_keep=0.6)  # 3 of 9
    assert density.update(gaussians, FINAL).source.tolist() == [1, 2, 4, 5, 7, 8, 9]
    quiet = GROWS | {"absgrad_threshold": 1e30}
    density = controlled(gaussians, stats, choose_by="squares", prune_score_fraction=0.2, **quiet)  # 1 of 9
    assert density.update(gaussians, FULL).source.tolist() == [0, 1, 2, 4, 5, 6, 7, 8, 9]
    stats.square_sums[4] = math.nan
    worth, known = squares_of(stats)
    assert not known[4] and known.sum() == 9 and worth[4] == 0


def test_prunings_by_squares_spare_the_backdrop():
    gaussians, stats = make_gaussians(10), squares_only([float(i) for i in range(10)])
    gaussians.means[0] *= 100 / gaussians.means[0].norm()
    density = controlled(gaussians, stats, choose_by="squares", final_keep=0.6, spare_beyond=10.0)  # 3 of 9
    assert density.update(gaussians, FINAL).source.tolist() == [0, 4, 5, 6, 7, 8, 9]


def test_a_capped_event_gives_up_the_least_for_the_best():
    """Turnover: what a pruning by squares frees, the drawn take."""
    gaussians, stats = make_gaussians(COUNT), random_stats(COUNT, seed=1, seen=1.0)
    config = {"choose_by": "squares", "prune_score_fraction": 0.1, "max_gaussians": COUNT}
    density = controlled(gaussians, stats, **config, **GROWS)
    update = density.update(gaussians, FULL)
    assert len(update.source) == COUNT and len(grown(update)) == update.num_pruned == 4
    assert set(range(COUNT)) - set(update.source.tolist()) == set(stats.square_sums.argsort()[:4].tolist())
