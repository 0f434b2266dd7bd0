"""Orders in which Gaussians grow and go, and the events that use them."""

from __future__ import annotations

import math

import pytest
import torch
from helpers.optimizers import busy_stats, fill, make_gaussians, random_stats
from turbogs_plugin.strategies.density.error_driven import ErrorDrivenDensity
from turbogs_plugin.strategies.density.priority import contribution, growth_priority

from turbogs_plugin.types import GaussianStats, Step

COUNT = 40
FULL = Step(1200, 5000, 3500, seed=3, scene_extent=2.0)
FINAL = Step(4000, 5000, 3500)
GROWS = {"grad_threshold": 0.0, "top_fraction": 1.0, "prune_world_size": 0.0, "prune_opacity": 0.0}
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
    stats, score = squares_only(squares), torch.zeros(len(squares))
    steps = (Step(100 * i, 10**9, 10**9, seed=0) for i in range(draws))
    first = [int(growth_priority(stats, score, "squares", step).argmax()) for step in steps]
    return [first.count(row) / draws for row in range(len(squares))]


def test_by_difficulty_the_keys_are_the_scores():
    score = torch.rand(COUNT, generator=torch.Generator().manual_seed(0))
    assert growth_priority(random_stats(COUNT, seed=1), score, "difficulty", FULL) is score


def test_a_draw_has_the_chances_of_the_squares():
    shares = first_drawn([0.0, 1e-9, 1e-9, 8e-9, math.nan], 1000)
    assert shares[0] == shares[4] == 0
    assert abs(shares[3] - 0.8) < 0.05 and abs(shares[1] - 0.1) < 0.04 and abs(shares[2] - 0.1) < 0.04


def test_a_draw_is_a_function_of_seed_and_iteration():
    stats, score = random_stats(COUNT, seed=1), torch.zeros(COUNT)
    one, same, later, other = (
        growth_priority(stats, score, "squares", step)
        for step in (FULL, FULL, Step(1300, 5000, 3500, seed=3), Step(1200, 5000, 3500, seed=4))
    )
    assert torch.equal(one, same) and not torch.equal(one, later) and not torch.equal(one, other)


@pytest.mark.parametrize("how", ["difficulty", "squares"])
def test_a_cap_takes_the_first_by_the_given_order(how):
    gaussians, stats = make_gaussians(COUNT), random_stats(COUNT, seed=1, seen=1.0)
    density = controlled(gaussians, stats, choose_by=how, max_gaussians=COUNT + 5, **GROWS)
    keys = growth_priority(stats, density.scores(FULL)[0], how, FULL)
    keys[stats.weight_sums == 0] = -torch.inf
    assert grown(density.update(gaussians, FULL)) == set(keys.argsort(descending=True)[:5].tolist())


def test_a_cap_with_room_for_all_grows_all_whatever_the_order():
    gaussians, stats = make_gaussians(COUNT), random_stats(COUNT, seed=1, seen=1.0)
    updates = [
        controlled(gaussians, stats, choose_by=how, max_gaussians=cap, **GROWS).update(gaussians, FULL)
        for how, cap in (("difficulty", 0), ("squares", 0), ("squares", 2 * COUNT))
    ]
    assert torch.equal(updates[0].source, updates[1].source) and torch.equal(updates[0].source, updates[2].source)


def test_a_draw_takes_as_many_as_pass_the_gates_from_all_the_seen():
    """A Gaussian that does not pass may be drawn: what has many samples with opposed gradients needs company."""
    gaussians, stats = make_gaussians(COUNT), random_stats(COUNT, seed=1, seen=0.9)
    stats.grad_sums[:] = 0
    stats.absgrad_sums[:] = 0
    stats.grad_sums[:8] = 1e3
    stats.square_sums[:20] = 0  # TINY: these come last
    gates = GROWS | {"grad_threshold": 1.0, "absgrad_threshold": 1.0}
    passing = controlled(gaussians, stats, **gates).update(gaussians, FULL)
    drawn = controlled(gaussians, stats, choose_by="squares", **gates).update(gaussians, FULL)
    assert grown(passing) <= set(range(8)) and len(grown(drawn)) == len(grown(passing)) > 0
    assert min(grown(drawn)) >= 20 and all(stats.weight_sums[row] > 0 for row in grown(drawn))


@pytest.mark.parametrize(("how", "name"), [("weight", "weight_sums"), ("squares", "square_sums")])
def test_prunings_take_the_least_contributions_and_the_unseen_first(how, name):
    gaussians, stats = make_gaussians(10), busy_stats(10)
    values = getattr(stats, name)
    values[:] = torch.tensor([3.0, 0.0, 5.0, 1.0, 6.0, 7.0, 2.0, 8.0, 9.0, 4.0])
    density = controlled(gaussians, stats, prune_by=how, final_keep=0.7)
    assert density.update(gaussians, FINAL).source.tolist() == [0, 2, 4, 5, 7, 8, 9]
    quiet = {"absgrad_threshold": 1.0} | GROWS | {"grad_threshold": 2.0}
    density = controlled(gaussians, stats, prune_by=how, prune_score_fraction=0.2, **quiet)
    assert density.update(gaussians, FULL).source.tolist() == [0, 2, 4, 5, 6, 7, 8, 9]
    values[4] = math.nan
    worth, known = contribution(stats, torch.zeros(10), stats.weight_sums > 0, how)
    assert not known[4] and known.sum() == 9 and worth[4] == 0


def test_prunings_by_contribution_spare_the_backdrop():
    gaussians, stats = make_gaussians(10), squares_only([float(i) for i in range(10)])
    gaussians.means[0] *= 100 / gaussians.means[0].norm()
    density = controlled(gaussians, stats, prune_by="squares", final_keep=0.7, spare_beyond=10.0)
    assert density.update(gaussians, FINAL).source.tolist() == [0, 3, 4, 5, 6, 7, 8, 9]


def test_a_capped_event_gives_up_the_least_for_the_best():
    """Turnover: what a pruning by contribution frees, the drawn take."""
    gaussians, stats = make_gaussians(COUNT), random_stats(COUNT, seed=1, seen=1.0)
    config = {"choose_by": "squares", "prune_by": "squares", "prune_score_fraction": 0.1, "max_gaussians": COUNT}
    density = controlled(gaussians, stats, **config, **GROWS)
    update = density.update(gaussians, FULL)
    assert len(update.source) == COUNT and len(grown(update)) == update.num_pruned == 4
    assert set(range(COUNT)) - set(update.source.tolist()) == set(stats.square_sums.argsort()[:4].tolist())


def test_no_final_pruning_after_its_end_and_no_statistics():
    gaussians = make_gaussians(10)
    density = controlled(gaussians, busy_stats(10), final_keep=0.5, final_until=0.85)
    assert density.due(Step(4000, 5000, 3500))[1] and not density.due(Step(4500, 5000, 3500))[1]
    density.update(gaussians, Step(3999, 5000, 3500))
    assert density.stats is not None
    density.update(gaussians, FINAL)
    assert density.stats is None
    before = controlled(gaussians, busy_stats(10), final_keep=0.5, final_until=0.5)  # it ends before densification does
    assert not before.due(FINAL)[1]
    before.update(gaussians, Step(3500, 5000, 3500))
    assert before.stats is None
