"""Error-driven density control (paper section 3.8) against numpy and closed forms, and at its edges."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers.optimizers import all_finite, busy_stats, controlled, fill, make_gaussians, random_stats
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from turbogs_plugin.strategies.density.error_driven import ErrorDrivenDensity
from turbogs_plugin.strategies.density.gsplat_default import GsplatDefaultDensity
from turbogs_plugin.types import Step

FULL = Step(1200, 3500, 3500, seed=3, scene_extent=2.0)  # past `prune_size_from`; no final pruning follows
QUIET = {"prune_world_size": 0.0, "prune_opacity": 0.0}


def covariance_of(gaussians, row: int) -> np.ndarray:
    turn = Rotation.from_quat(np.roll(gaussians.quats[row].numpy(), -1)).as_matrix()
    return turn @ np.diag(np.exp(2 * gaussians.scales[row].numpy())) @ turn.T


@pytest.mark.parametrize("kind", ["raw", "balanced"])
@pytest.mark.parametrize("iteration", [0, 1750, 3500, 4000])
def test_scores_equal_the_equation(kind, iteration):
    gaussians, stats = make_gaussians(60), random_stats(60, seed=2)
    score, seen = controlled(gaussians, stats, score=kind).scores(Step(iteration, 5000, 3500))
    weights = stats.weight_sums.numpy().astype(float)
    expected_seen = weights > 0
    errors = stats.error_sums.numpy()[expected_seen] / weights[expected_seen]
    distances = stats.distance_sums.numpy()[expected_seen] / weights[expected_seen]
    if kind == "balanced":
        errors, distances = errors / errors.mean(), distances / distances.mean()
    expected = errors + 0.8 * (1 - min(iteration / 3500, 1)) * distances
    assert 0 < expected_seen.sum() < 60
    assert (seen.numpy() == expected_seen).all()
    np.testing.assert_allclose(score.numpy()[expected_seen], expected, rtol=1e-5)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(
    "config",
    [
        {},
        {"top_fraction": 0.8, "prune_score_fraction": 0.1, "score": "raw"},
        {"prune_world_size": 0.02, "prune_screen_size": 0.15, "prune_opacity": 0.3},
        {"prune_world_size": 0.02, "prune_screen_size": 0.15, "prune_size_from": 0.9},  # not yet
        {"prune_world_size": 0.02, "prune_world_reference": "distance"},
        {"max_gaussians": 220},
        {"max_gaussians": 150},
        {"prune_world_size": 0.02, "max_gaussians": 220},  # no room for the huge: neither split nor kept
        {"prune_world_size": 0.02, "max_gaussians": 150},
        {"prune_world_size": 0.02, "prune_screen_size": 0.15, "max_gaussians": 20},
        {"spare_beyond": 0.9, "prune_score_fraction": 0.1, "prune_world_size": 0.02, "prune_opacity": 0.3},
        {"spare_beyond": 0.9, "prune_world_size": 0.02, "max_gaussians": 150},
        {"spare_beyond": 0.9, "prune_world_size": 0.02, "max_gaussians": 20},  # fewer than are spared
    ],
)
def test_event_equals_plain_loops(seed, config):
    """Who is cloned, split and pruned, one Gaussian at a time."""
    count = 200
    gaussians, stats = make_gaussians(count, seed), random_stats(count, seed)
    density = controlled(gaussians, stats, percent_dense=0.013, **config)
    score, seen = (value.tolist() for value in density.scores(FULL))
    update = density.update(gaussians, FULL)

    norms = gaussians.means.norm(dim=1).tolist()
    spared = {i for i in range(count) if density.spare_beyond and norms[i] > density.spare_beyond * 2.0}
    ranked = sorted(score[i] for i in range(count) if seen[i])
    judged = sorted(score[i] for i in range(count) if seen[i] and i not in spared)
    easy_limit = judged[math.floor(density.prune_score_fraction * len(judged) + 1e-6)]
    hard_limit = ranked[math.floor((1 - density.top_fraction) * len(ranked) + 1e-6)]
    clones, splits, prunes, huge, spared_by_distance = set(), set(), set(), set(), False
    for i in range(count):
        views = max(1.0, float(stats.view_counts[i]))
        largest = math.exp(float(gaussians.scales[i].max()))
        small = largest <= 0.013 * 2.0
        passes = float(stats.grad_sums[i]) / views > 2e-4 or float(stats.absgrad_sums[i]) / views > 4e-4
        transparent = 1 / (1 + math.exp(-float(gaussians.opacities[i]))) < density.prune_opacity
        easy = density.prune_score_fraction > 0 and seen[i] and i not in spared and score[i] < easy_limit
        candidate = passes and seen[i] and score[i] >= hard_limit and not (transparent or easy)
        reference = 2.0
        if density.prune_world_reference == "distance":
            reference = max(reference, math.dist(gaussians.means[i], (0, 0, 0)))
            spared_by_distance |= density.prune_world_size * 2.0 < largest <= density.prune_world_size * reference
        if FULL.progress >= density.prune_size_from and (
            largest > density.prune_world_size * reference
            or (density.prune_screen_size and stats.max_radii[i] > density.prune_screen_size)
        ):
            huge.add(i)
        if (transparent or easy) and i not in spared:
            prunes.add(i)
        elif candidate and not small:
            splits.add(i)
        elif i in huge - spared:
            prunes.add(i)
        elif candidate:
            clones.add(i)
    assert spared_by_distance == (density.prune_world_reference == "distance")  # or the case shows nothing
    if density.max_gaussians:
        room = max(0, density.max_gaussians - (count - len(prunes)))
        chosen = sorted(clones | splits, key=lambda i: (-score[i], i))[:room]
        denied = splits - set(chosen)
        clones, splits = clones & set(chosen), splits & set(chosen)
        prunes |= denied & huge - spared
        if density.prune_world_size == 0.02:
            assert denied & huge  # or the case shows nothing
        average = sum(score[i] for i in range(count) if seen[i]) / sum(seen)
        worth = {i: (i in spared, score[i] if seen[i] else average, i) for i in range(count)}
        rest = sorted(set(range(count)) - prunes, key=worth.get)
        prunes |= set(rest[: max(0, len(rest) - density.max_gaussians)])

    assert (update.num_cloned, update.num_split, update.num_pruned) == (len(clones), len(splits), len(prunes))
    rest = [i for i in range(count) if i not in prunes | splits]
    assert update.source.tolist() == rest + sorted(clones) + sorted(splits) + sorted(splits)
    assert update.fresh.tolist() == [False] * len(rest) + [True] * (len(clones) + 2 * len(splits))
    after = update.apply(gaussians)
    assert torch.equal(after.sh0[:, 0, 0].long(), update.source)
    if density.max_gaussians:
        assert len(after) <= density.max_gaussians
    density.apply(update)
    assert len(density.stats.weight_sums) == len(after) and not density.stats.weight_sums.any()
    assert len(splits) + len(prunes) > 0


def follow(density, gaussians, steps, seen=1.0):
    """(step, change, the model after it) of each step, with random statistics in each window."""
    for step in steps:
        if density.stats is not None:
            fill(density.stats, random_stats(len(gaussians), step.iteration, seen))
        due, update = density.event_due(step), density.update(gaussians, step)
        assert due or update is None
        if update is not None:
            gaussians = update.apply(gaussians)
            density.apply(update)
        yield step, update, gaussians


@pytest.mark.parametrize(
    ("keep", "until", "expected", "end"),
    [
        (0.9, 420, [200, 250, 300, 350, 400, 520, 620, 720], 720),  # three final ones, though 820 would have room
        (1.0, 460, [200, 250, 300, 350, 400, 450], 460),  # a time budget moves the end before the run is there
    ],
)
def test_events_are_when_the_table_says(keep, until, expected, end):
    """Statistics are kept until the last one."""
    gaussians = make_gaussians(30)
    density = controlled(gaussians, refine_every=50, final_every=100, opacity_decay=0.01, final_keep=keep)
    events, kept = [], 0
    for step, update, _ in follow(density, gaussians, [Step(t, 900, 420 if t < 410 else until) for t in range(900)]):
        events += [step.iteration] if update is not None else []
        kept += density.stats is not None
    assert (events, kept) == (expected, end)


def test_final_pruning_keeps_the_difficult_and_the_unseen():
    gaussians, stats = make_gaussians(100), random_stats(100, seed=4)
    density = controlled(gaussians, stats, final_keep=0.8)
    step = Step(4000, 5000, 3500)
    score, seen = density.scores(step)
    update = density.update(gaussians, step)
    kept = set(update.source.tolist())
    assert all(i in kept for i in range(100) if not seen[i])
    order = sorted((i for i in range(100) if seen[i]), key=lambda i: float(score[i]))
    dropped = math.floor(0.2 * len(order) + 1e-6)
    assert kept.isdisjoint(order[:dropped]) and kept.issuperset(order[dropped:])
    assert update.num_pruned == dropped == 100 - len(kept)


def test_split_draws_from_the_gaussian():
    """20,000 equal Gaussians: mean and covariance of the halves' centres, and 3DGS's smaller axes."""
    one = make_gaussians(1, seed=5)
    gaussians = one.map(lambda value: value.repeat(20_000, *[1] * (value.dim() - 1)))
    density = controlled(gaussians, busy_stats(20_000), percent_dense=0.0, **QUIET)
    update = density.update(gaussians, FULL)
    after = update.apply(gaussians)
    assert update.num_split == 20_000 and len(after) == 40_000
    offsets = (after.means - one.means).numpy()
    root = np.linalg.inv(np.linalg.cholesky(covariance_of(one, 0)))
    np.testing.assert_allclose(np.cov((offsets @ root.T).T), np.eye(3), atol=0.03)
    np.testing.assert_allclose((offsets @ root.T).mean(axis=0), 0, atol=0.02)
    torch.testing.assert_close(after.scales, (one.scales - math.log(1.6)).expand(40_000, 3))


def test_split_along_the_long_axis_keeps_mean_and_covariance():
    gaussians = make_gaussians(50, seed=6)
    density = controlled(gaussians, busy_stats(50), percent_dense=0.0, split="long_axis", **QUIET)
    after = density.update(gaussians, FULL).apply(gaussians)
    assert len(after) == 100
    for i in range(50):
        means = after.means[[i, i + 50]].numpy()
        offset = (means[0] - means[1]) / 2
        pair = covariance_of(after, i) + np.outer(offset, offset)
        np.testing.assert_allclose(means.mean(axis=0), gaussians.means[i].numpy(), rtol=1e-12)
        np.testing.assert_allclose(pair, covariance_of(gaussians, i), rtol=1e-10, atol=1e-14)
        assert np.linalg.norm(offset) > 0.7 * math.exp(float(gaussians.scales[i].max()))


@pytest.mark.parametrize("split", ["sample", "long_axis"])
@pytest.mark.parametrize("size", [1e-15, 1e-3, 1e3, 1e25])
def test_a_split_goes_along_the_axes_that_are_drawn_whatever_the_quaternions_norm(split, size):
    gaussians, means = make_gaussians(20, seed=6, dtype=torch.float32), []
    for factor in (1.0, size):
        gaussians.quats *= factor
        density = controlled(gaussians, busy_stats(20), percent_dense=0.0, split=split, **QUIET)
        means.append(density.update(gaussians, FULL).apply(gaussians).means)
    torch.testing.assert_close(*means)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_opacity_decay(dtype):
    gaussians = make_gaussians(6, dtype=dtype)
    gaussians.opacities[:] = torch.tensor([-200.0, -50.0, -2.0, 0.0, 3.0, 60.0], dtype=dtype)
    stats = busy_stats(6)
    stats.grad_sums.zero_()  # nothing is densified
    gaussians.means[:] = gaussians.means / gaussians.means.norm(dim=1, keepdim=True)
    gaussians.means[3] *= 2.0 * 10.1  # of an extent of 2
    density = controlled(gaussians, stats, opacity_decay=0.1, spare_beyond=10.0, **QUIET)
    update = density.update(gaussians, FULL)
    expected = 0.9 * torch.sigmoid(gaussians.opacities.double())
    expected[3] = 0.5
    result = torch.sigmoid(update.apply(gaussians).opacities.double())
    torch.testing.assert_close(result, expected, rtol=1e-5, atol=0)
    assert torch.isfinite(update.values["opacities"]).all() and not update.fresh.any()


def test_equal_scores_stand_together():
    """With a cap the lower rows win; without one all densify, and none counts as easy."""
    gaussians = make_gaussians(10)
    for config, expected in (({"top_fraction": 0.5}, 10), ({"max_gaussians": 13}, 3)):
        density = controlled(gaussians, busy_stats(10), prune_score_fraction=0.3, percent_dense=0.0, **QUIET, **config)
        update = density.update(gaussians, FULL)
        assert (update.num_split, update.num_pruned) == (expected, 0)
        assert sorted(set(update.source[update.fresh].tolist())) == list(range(expected))
    density = controlled(gaussians, busy_stats(10), final_keep=0.5)
    assert density.update(gaussians, Step(4000, 5000, 3500)) is None


@pytest.mark.parametrize("step", [FULL, Step(4000, 5000, 3500)])
def test_everything_is_due_for_pruning(step):
    """The most opaque finite one stays."""
    gaussians = make_gaussians(5)
    gaussians.opacities[:] = torch.tensor([-9.0, -8.0, -7.0, 5.0, -10.0])
    gaussians.means[[3] if step is FULL else [0, 1, 2, 3, 4]] = math.nan
    density = controlled(gaussians, busy_stats(5))
    update = density.update(gaussians, step)
    assert update.source.tolist() == ([2] if step is FULL else [0])
    density.apply(update)
    assert len(density.stats.weight_sums) == 1


@pytest.mark.parametrize("spare_beyond", [0.0, 1e-6])
def test_non_finite_rows_go_and_non_finite_statistics_are_unseen(spare_beyond):
    gaussians, stats = make_gaussians(6), busy_stats(6)
    gaussians.shN[1, 0, 0] = math.inf
    gaussians.quats[4, 2] = math.nan
    stats.error_sums[2] = math.nan
    stats.grad_sums[0] = math.nan
    density = controlled(gaussians, stats, percent_dense=0.0, spare_beyond=spare_beyond, **QUIET)
    update = density.update(gaussians, FULL)
    after = update.apply(gaussians)
    assert update.source.tolist() == [0, 2, 3, 5, 3, 5]
    assert all_finite(after)


@pytest.mark.parametrize("cls", [ErrorDrivenDensity, GsplatDefaultDensity])
def test_resumed_is_bit_identical(cls):
    gaussians, stats = make_gaussians(30, dtype=torch.float32), random_stats(30, seed=1)
    step = Step(800, 5000, 3500, seed=2, scene_extent=0.5)
    first, second = cls(), cls()
    first.setup(gaussians)
    second.setup(gaussians)
    fill(first.stats, stats)
    second.load_state_dict(first.state_dict())
    one, two = first.update(gaussians, step), second.update(gaussians, step)
    assert torch.equal(one.source, two.source) and torch.equal(one.values["means"], two.values["means"])
    first.update(gaussians, Step(4999, 5000, 3500))
    second.load_state_dict(first.state_dict())
    assert first.stats is None and second.stats is None


@given(
    cap=st.integers(1, 60),
    keep=st.sampled_from([0.1, 0.5, 0.8, 0.95, 1.0]),
    every=st.sampled_from([100, 150, 400, 1100]),
    choose_by=st.sampled_from(["difficulty", "squares"]),
    seen=st.sampled_from([0.0, 0.5, 1.0]),
    far=st.booleans(),
)
@settings(max_examples=30, deadline=None)
def test_the_cap_holds_at_the_end(cap, keep, every, choose_by, seen, far):
    """Whatever was seen, and whatever is spared: never more than the bound, and at the end never more than the cap."""
    settings_of = {"max_gaussians": cap, "final_keep": keep, "final_every": every, "choose_by": choose_by}
    gaussians = make_gaussians(40, dtype=torch.float32)
    gaussians.means[:20] *= 1e3 if far else 1.0
    density = controlled(gaussians, **settings_of, spare_beyond=10.0, **QUIET, split="long_axis")
    steps = [Step(iteration, 1500, 800) for iteration in range(100, 1500, 50)]
    for step, update, after in follow(density, gaussians, steps, seen):
        assert update is None or len(after) <= density.bound(step) <= 2 * cap
    assert len(after) <= density.bound(step) == cap


@pytest.mark.parametrize(("base", "refine_until", "prunings"), [(5000, 3500, 2), (8000, 6000, 3), (30_000, 3500, 3)])
def test_runs_of_any_length_have_as_many_final_prunings(base, refine_until, prunings):
    """The last pruning leaves half an interval, however the length and what is scaled with it were rounded."""
    for total in range(200, 12_000, 37):
        until, interval = round(refine_until * total / base), round(500 * total / base)
        density = ErrorDrivenDensity(final_every=interval)
        at = [it for it in range(until + interval, total, interval) if density.due(Step(it, total, until))[1]]
        assert len(at) == prunings and total - at[-1] >= interval / 2, total


@pytest.mark.parametrize(
    ("first", "lengths", "counts"),
    [
        (40, {200: 5000, 300: 5000, 3500: 5000, 4000: 5000, 4500: 5000}, [60, 90, 110, 105, 100]),
        # A time budget may leave no room for a final pruning that growth counted on.
        (120, {3500: 5000, 4000: 5000, 4050: 4700, 4100: 4700, 4200: 4700}, [110, 105, 105, 100, 100]),
    ],
)
def test_growth_goes_beyond_the_cap_by_what_final_prunings_remove(first, lengths, counts):
    """To the room that they leave, and down again by worth, to the cap itself."""
    before = make_gaussians(first, dtype=torch.float32)
    density = controlled(before, max_gaussians=100, percent_dense=0.0, grad_threshold=0.0, **QUIET)
    steps, found = [Step(at, total, 3500) for at, total in lengths.items()], []
    for step, update, gaussians in follow(density, before, steps):
        if update is not None and step.iteration > 3500:
            stats = random_stats(len(before), step.iteration, 1.0)
            least = controlled(before, stats).scores(step)[0].argsort()[:4]
            assert set(least.tolist()).isdisjoint(update.source.tolist())
        found.append(len(gaussians))
        before = gaussians
    assert found == counts and density.stats is None
