"""Orders in which Gaussians grow and go, and the mechanisms that use them."""

from __future__ import annotations

import math

import pytest
import torch
from helpers.optimizers import busy_stats, fill, make_gaussians, random_stats
from turbogs_plugin.strategies.density.error_driven import ErrorDrivenDensity
from turbogs_plugin.strategies.density.priority import contribution, drawn_priority, growth_priority

from turbogs_plugin.types import Step

COUNT = 40
FULL = Step(1200, 5000, 3500, seed=3, scene_extent=2.0)
QUIET = {"prune_world_size": 0.0, "prune_opacity": 0.0}


def controlled(gaussians, stats, **config) -> ErrorDrivenDensity:
    density = ErrorDrivenDensity(**config)
    density.setup(gaussians)
    fill(density.stats, stats)
    return density


def grown(density, gaussians, step=FULL) -> set[int]:
    """Rows that the event clones or splits."""
    update = density.update(gaussians, step)
    sources = update.source.tolist()
    return {row for row in sources if sources.count(row) > 1}


@pytest.mark.parametrize("how", ["gradient", "opposed", "squares", "error"])
def test_a_cap_takes_the_first_by_the_given_order(how):
    gaussians, stats = make_gaussians(COUNT), random_stats(COUNT, seed=1, seen=1.0)
    stats.view_counts.fill_(4.0)
    settings = {"grad_threshold": 0.0, "top_fraction": 1.0, "max_gaussians": COUNT + 5} | QUIET
    values = {
        "gradient": stats.absgrad_sums / 4,
        "opposed": (stats.absgrad_sums - stats.grad_sums) / 4,
        "squares": stats.square_sums,
        "error": stats.error_sums / stats.weight_sums.sqrt(),
    }[how]
    torch.testing.assert_close(growth_priority(stats, torch.zeros(COUNT), how), values)
    density = controlled(gaussians, stats, choose_by=how, **settings)
    assert grown(density, gaussians) == set(values.argsort(descending=True)[:5].tolist())


def test_a_draw_goes_by_the_priority_and_never_takes_zero_first():
    priority = torch.tensor([0.0, 1.0, 1.0, 8.0])
    first = [int(drawn_priority(priority, Step(i, 5000, 3500, seed=0)).argmax()) for i in range(400)]
    assert first.count(0) == 0
    assert 0.7 < first.count(3) / 400 < 0.9  # 0.8 expected; the standard error is 0.02
    assert 0.05 < first.count(1) / 400 < 0.15


def test_the_room_grows_in_a_straight_line_to_the_cap():
    gaussians = make_gaussians(10)
    for iteration, expected in ((700, 10), (1400, 16), (2100, 20), (2800, 20)):  # 40 %, 80 %, 120 % of the pace's span
        density = controlled(gaussians, busy_stats(10), pace=0.5, max_gaussians=20, top_fraction=1.0, **QUIET)
        update = density.update(gaussians, Step(iteration, 5000, 3500))
        assert (10 if update is None else len(update.source)) == expected


def test_final_pruning_takes_the_least_contributions_and_the_unseen_first():
    gaussians, stats = make_gaussians(10), busy_stats(10)
    stats.weight_sums[:] = torch.tensor([3.0, 0.0, 5.0, 1.0, 6.0, 7.0, 2.0, 8.0, 9.0, 4.0])
    density = controlled(gaussians, stats, prune_by="weight", final_keep=0.7)
    update = density.update(gaussians, Step(4000, 5000, 3500))
    assert update.source.tolist() == [0, 2, 4, 5, 7, 8, 9]
    stats.weight_sums[4] = math.nan
    worth, known = contribution(stats, torch.zeros(10), stats.weight_sums > 0, "weight")
    assert not known[4] and known.sum() == 9 and worth[4] == 0


def test_no_final_pruning_after_its_end():
    gaussians = make_gaussians(10)
    density = controlled(gaussians, busy_stats(10), final_keep=0.5, final_until=0.85, prune_by="weight")
    assert density.due(Step(4000, 5000, 3500))[1] and not density.due(Step(4500, 5000, 3500))[1]


def test_final_prunings_bring_an_overshoot_back_to_the_cap():
    gaussians, settings = make_gaussians(40), {"max_gaussians": 10, "overshoot": 4.0, "prune_by": "weight"}
    density = controlled(gaussians, busy_stats(40), final_keep=1.0, final_every=400, **settings, **QUIET)
    counts = []
    for iteration in (3500, 3900, 4300, 4700, 4999):  # the last densification, three final prunings, the last iteration
        density.stats.weight_sums[:] = torch.arange(len(gaussians)) + 1.0
        update = density.update(gaussians, Step(iteration, 5000, 3500))
        if update is not None:
            gaussians = update.apply(gaussians)
            density.apply(update)
        counts.append(len(gaussians))
        if density.stats is None:
            break
    assert counts[:2] == [40, 25] and counts[2:] == [15, 10]


def test_what_was_never_met_goes_in_the_last_iteration():
    gaussians, stats = make_gaussians(10), busy_stats(10)
    stats.weight_sums[[2, 5]] = 0.0
    density = controlled(gaussians, stats, drop_unseen=True, final_keep=1.0)
    assert density.update(gaussians, Step(4998, 5000, 3500)) is None
    assert density.update(gaussians, Step(4999, 5000, 3500)).source.tolist() == [0, 1, 3, 4, 6, 7, 8, 9]


def test_decay_stops_at_its_floor_and_the_cost_takes_the_faint():
    gaussians = make_gaussians(4).map(torch.Tensor.float)
    opacities = torch.tensor([0.9, 0.02, 0.01, 0.006])
    gaussians.opacities[:] = torch.logit(opacities)
    quiet = {"grad_threshold": 1.0, "absgrad_threshold": 1.0, **QUIET}
    floor = controlled(gaussians, busy_stats(4), opacity_decay=0.4, decay_floor=0.008, **quiet)
    after = torch.sigmoid(floor.update(gaussians, FULL).values["opacities"])
    torch.testing.assert_close(after, torch.tensor([0.54, 0.012, 0.008, 0.006]), rtol=1e-4, atol=0)
    cost = controlled(gaussians, busy_stats(4), opacity_cost=0.015, **quiet)
    after = torch.sigmoid(cost.update(gaussians, FULL).values["opacities"])
    torch.testing.assert_close(after, torch.tensor([0.885, 0.005, 1e-6, 1e-6]), rtol=1e-3, atol=1e-7)
