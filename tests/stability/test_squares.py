"""Growth drawn by squares, and turnover, on windows that training may leave them with. Claims: docs/numerics.md."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from helpers.optimizers import all_finite, controlled, fill
from helpers.squares import EVENT, SQUARES, event, event_at, grown, removed, small_model, spread_squares, window

from turbogs_plugin.strategies.density.error_driven import _decayed
from turbogs_plugin.strategies.density.growth import TINY, drawn_by_squares
from turbogs_plugin.types import Step

COUNT = 40


@pytest.mark.parametrize("count", [1, 2, 3, 19])
@pytest.mark.parametrize("cap", ["none", "one", "present"])
def test_a_model_of_less_than_20_loses_none_to_turnover(count, cap):
    """5 % of 19 is not one. So turnover alone never leaves less than 19, and at its cap such a model stands still."""
    gaussians = small_model(count)
    update = event(gaussians, window(spread_squares(count)), max_gaussians={"none": 0, "one": 1, "present": count}[cap])
    if cap == "none":
        assert len(update.source) == 2 * count and not removed(update, count)
    elif cap == "present" or count == 1:
        assert update is None
    else:
        assert len(update.source) == 1 and not update.fresh.any()  # the cut of a model that is above its cap


@pytest.mark.parametrize("fraction", [0.05, 0.5, 0.999])
@pytest.mark.parametrize("count", [2, 3, 21, 60])
def test_turnover_takes_its_share_and_never_all(count, fraction):
    squares = spread_squares(count)
    update = event(small_model(count), window(squares, passing=0.0), prune_score_fraction=fraction)
    least = set(squares.argsort()[: math.floor(fraction * count)].tolist())
    assert removed(update, count) == least and len(least) < count


@pytest.mark.parametrize("step", [EVENT, Step(4000, 5000, 3500, scene_extent=2.0)], ids=["turnover", "final"])
def test_the_backdrop_stays_and_has_no_part_in_the_share(step):
    """The share is of what may go, so it is not used up by a backdrop that has the least squares of all."""
    gaussians, squares = small_model(COUNT), spread_squares(COUNT)
    least = squares.argsort().tolist()
    far = least[:10]
    gaussians.means[far] *= 100 / gaussians.means[far].norm(dim=1, keepdim=True)
    settings = {"prune_score_fraction": 0.1, "final_keep": 0.9}
    update = event(gaussians, window(squares, passing=0.0), step, **settings)
    assert removed(update, COUNT) == set(least[10:13])  # a tenth of the 30


@pytest.mark.parametrize("cap", [1, 2, 4])
@pytest.mark.parametrize("square", [1e-14, 3e38])
def test_the_cut_to_a_cap_holds_where_squares_overflow(square, cap):
    """Sums that are not finite count as average there, and the average of finite ones is finite."""
    gaussians = small_model(6)
    gaussians.opacities[0] = -20.0  # goes anyway
    stats = window([square, math.nan, math.inf, square, square, square])
    assert len(event(gaussians, stats, max_gaussians=cap).source) == cap
    stats = window([square, math.nan, math.inf, square / 3, square, square * 1.1])
    kept = event(gaussians, stats, max_gaussians=3, prune_score_fraction=0.0).source.tolist()
    assert kept == [2, 4, 5]  # the least, and the first of two average ones


@pytest.mark.parametrize("value", [0.0, -0.0, 1e-45, 1e-30, 1e-14, 3e38, math.inf, math.nan])
@pytest.mark.parametrize("room", [0, 5])
def test_equal_squares_stand_together(value, room):
    """None goes; who grows is drawn evenly, the same each time."""
    gaussians, stats = small_model(COUNT), window([value] * COUNT)
    cap = COUNT + room if room else 0
    update, again = (event(gaussians, stats, max_gaussians=cap) for _ in range(2))
    assert not removed(update, COUNT) and len(grown(update)) == (room or COUNT)
    assert torch.equal(update.source, again.source) and all_finite(update.apply(gaussians))


def test_squares_that_are_not_finite_are_drawn_last_and_never_go():
    squares = spread_squares(COUNT)
    squares[:4] = torch.tensor([math.inf, math.nan, -math.inf, 3.4e38])
    gaussians = small_model(COUNT)
    update = event(gaussians, window(squares), max_gaussians=COUNT + 35, prune_score_fraction=0.5)
    assert not removed(update, COUNT) & {0, 1, 2}
    assert len(removed(update, COUNT)) == 18  # half of the 37 that are finite
    drawn = grown(event(gaussians, window(squares), max_gaussians=COUNT + 35))
    assert not drawn & {0, 1, 2} and 3 in drawn


def test_turnover_tells_the_smallest_numbers_apart():
    """Also those below float32's normal range, of which a draw makes one."""
    squares = spread_squares(COUNT)
    squares[[7, 11, 13, 17, 19, 23]] = torch.tensor([-0.0, 0.0, 1e-45, 3e-45, 1e-38, 1e-37])
    for share, rows in ((0.05, {7, 11}), (0.075, {7, 11, 13}), (0.1, {7, 11, 13, 17}), (0.125, {7, 11, 13, 17, 19})):
        update = event(small_model(COUNT), window(squares, passing=0.0), prune_score_fraction=share)
        assert removed(update, COUNT) == rows
    keys = drawn_by_squares(window(squares), EVENT)
    none = drawn_by_squares(window([0.0] * COUNT), EVENT)
    assert all(keys[row] == none[row] for row in (7, 11, 13, 17, 19, 23))


@pytest.mark.parametrize("largest", [1e-10, 1.0, 3e38])
def test_one_gaussian_with_all_the_squares_grows_first(largest):
    squares = [0.0] * COUNT
    squares[17] = largest
    seconds = set()
    for i in range(50):
        update = event(small_model(COUNT), window(squares), event_at(100 * i + 1000), max_gaussians=COUNT + 2)
        assert 17 in grown(update) and not removed(update, COUNT)
        seconds |= grown(update)
    assert len(seconds) > 20  # the others stand together


@pytest.mark.parametrize(("unseen", "goes"), [(1, 1), (2, 1), (3, 1), (20, 1), (21, 0), (39, 0)])
def test_what_a_window_missed_has_no_part_in_turnover(unseen, goes):
    """5 %, rounded down, of those that a sample met. What none met is not judged, and does not grow."""
    squares = spread_squares(COUNT)
    rows = torch.randperm(COUNT, generator=torch.Generator().manual_seed(1))[:unseen].tolist()
    squares[rows] = 0.0
    stats = window(squares)
    stats.weight_sums[rows] = 0.0
    update = event(small_model(COUNT), stats, max_gaussians=COUNT)
    assert len(removed(update, COUNT)) == goes and (goes == 0) == (update is None)
    assert not removed(update, COUNT) & set(rows)
    if goes:
        assert len(grown(update)) == goes and not grown(update) & set(rows)


@pytest.mark.parametrize(("zeros", "goes"), [(1, 2), (2, 2), (3, 0), (40, 0)])
def test_more_zeros_than_the_share_stop_turnover(zeros, goes):
    """Nothing tells apart those that samples met and that have no slope: all of them go, or none."""
    squares = spread_squares(COUNT)
    rows = torch.randperm(COUNT, generator=torch.Generator().manual_seed(1))[:zeros].tolist()
    squares[rows] = 0.0
    update = event(small_model(COUNT), window(squares, passing=0.0), max_gaussians=COUNT)
    gone = removed(update, COUNT)
    assert len(gone) == goes
    assert not goes or set(rows) <= gone


@pytest.mark.parametrize("factor", [1e-12, 1e-6, 1e6, 1e12, 2.0**-20, 2.0**20])
def test_the_unit_of_the_loss_does_not_choose(factor):
    """Squares of a loss times `factor`, as long as they are above `TINY`."""
    gaussians, squares = small_model(COUNT), spread_squares(COUNT)
    assert squares.min() * min(1.0, factor) > 100 * TINY
    updates = [
        event(gaussians, window(scale * squares.double()), max_gaussians=COUNT + 5, prune_score_fraction=0.1)
        for scale in (1.0, factor)
    ]
    assert torch.equal(updates[0].source, updates[1].source)
    assert len(removed(updates[0], COUNT)) == 4 and len(grown(updates[0])) == 9


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_the_unit_of_the_world_does_not_choose(scale):
    gaussians, stats = small_model(COUNT), window(spread_squares(COUNT))
    gaussians.means[5] *= 50 / gaussians.means[5].norm()
    settings = {"max_gaussians": COUNT + 5, "prune_score_fraction": 0.2, "prune_world_reference": "distance"}
    expected = event(gaussians, stats, **settings)
    gaussians.means *= scale
    gaussians.scales += math.log(scale)
    update = event(gaussians, stats, replace(EVENT, scene_extent=scale * EVENT.scene_extent), **settings)
    assert torch.equal(update.source, expected.source) and update.num_split == expected.num_split
    assert len(removed(update, COUNT)) > 4 and len(grown(update)) > 5


@pytest.mark.parametrize("decay", [0.4, 0.01, 1e-5])
def test_ten_thousand_decays_of_the_opacity(decay):
    """In float32, each by its share: finite, always less, and as in float64 while a Gaussian may still be kept."""
    opacities = torch.tensor([1 - 1e-7, 0.999, 0.5, 0.1, 0.006], dtype=torch.float64)
    logits = torch.cat([torch.logit(opacities), torch.tensor([30.0, 88.0, math.inf])]).float()
    present, events = logits.clone(), 10_000
    for number in range(1, events + 1):
        after = _decayed(present, decay)
        assert (after < present).all()
        present = after
        if number in (1, 10, 100, 1000, events):
            wanted = torch.sigmoid(logits.double()) * (1 - decay) ** number
            kept = wanted > 0.005
            torch.testing.assert_close(torch.sigmoid(present.double())[kept], wanted[kept], rtol=2e-3, atol=0.0)
    assert present.isfinite().all()


@pytest.mark.parametrize("cap", [1, 2, 30])
def test_two_hundred_events_under_a_cap_stay_finite(cap):
    """With decay and splits, of windows in which all pass: never above the cap, never none, every number finite."""
    gaussians = small_model(3)
    density = controlled(gaussians, **SQUARES, max_gaussians=cap, opacity_decay=0.4, percent_dense=1e-9)
    for number in range(10, 210):
        fill(density.stats, window(spread_squares(len(gaussians), number)))
        update = density.update(gaussians, event_at(100 * number))
        if update is not None:
            gaussians = update.apply(gaussians)
            gaussians.opacities.clamp_(min=0.0)  # as photos that need them would
            density.apply(update)
        assert 1 <= len(gaussians) <= cap and all_finite(gaussians)
    assert len(gaussians) == cap
