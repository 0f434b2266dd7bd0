"""Orders in which Gaussians grow and go, and the events that use them."""

from __future__ import annotations

import math

import torch
from helpers.optimizers import controlled, make_gaussians, random_stats
from helpers.squares import grown, window

from turbogs_plugin.strategies.density.growth import drawn_by_squares
from turbogs_plugin.types import Step

COUNT = 40
FULL = Step(1200, 3500, 3500, seed=3, scene_extent=2.0)  # no final pruning follows
GROWS = {"absgrad_threshold": 0.0, "prune_world_size": 0.0, "prune_opacity": 0.0}
"""All that is seen may grow, and nothing is pruned but by the order."""


def test_a_draw_has_the_chances_of_the_squares():
    """Of a thousand draws, how often each row comes first."""
    stats, steps = window([0.0, 1e-9, 1e-9, 8e-9, math.nan]), [Step(100 * i, 10**9, 10**9) for i in range(1000)]
    first = torch.stack([drawn_by_squares(stats, step).argmax() for step in steps])
    shares = (first.bincount(minlength=5) / 1000).tolist()
    assert shares[0] == shares[4] == 0
    assert abs(shares[3] - 0.8) < 0.05 and abs(shares[1] - 0.1) < 0.04 and abs(shares[2] - 0.1) < 0.04


def test_a_draw_is_a_function_of_seed_and_iteration():
    stats = random_stats(COUNT, seed=1)
    steps = (FULL, FULL, Step(1300, 3500, 3500, seed=3), Step(1200, 3500, 3500, seed=4))
    one, same, later, other = (drawn_by_squares(stats, step) for step in steps)
    assert torch.equal(one, same) and not torch.equal(one, later) and not torch.equal(one, other)


def test_a_cap_takes_the_first_of_a_draw():
    gaussians, stats = make_gaussians(COUNT), random_stats(COUNT, seed=1, seen=1.0)
    density = controlled(gaussians, stats, choose_by="squares", max_gaussians=COUNT + 5, **GROWS)
    keys = drawn_by_squares(stats, FULL)
    assert grown(density.update(gaussians, FULL)) == set(keys.argsort(descending=True)[:5].tolist())


def test_a_draw_takes_as_many_as_pass_the_gate_from_all_the_seen():
    """A Gaussian that does not pass may be drawn: what has many samples with opposed gradients needs company.

    Only the gate of the absolute gradient counts: neither the signed gradient nor the score.
    """
    gaussians, stats = make_gaussians(COUNT), random_stats(COUNT, seed=1, seen=0.9)
    stats.grad_sums[:] = 1e3
    stats.absgrad_sums[:] = 0
    stats.absgrad_sums[:8] = 1e3
    stats.square_sums[:20] = 0  # TINY: these come last
    density = controlled(gaussians, stats, choose_by="squares", **GROWS | {"absgrad_threshold": 1, "top_fraction": 0.1})
    drawn = grown(density.update(gaussians, FULL))
    assert len(drawn) == int((stats.weight_sums[:8] > 0).sum()) > 0
    assert min(drawn) >= 20 and all(stats.weight_sums[row] > 0 for row in drawn)
