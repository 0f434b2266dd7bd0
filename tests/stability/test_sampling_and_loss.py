"""Properties of samplers, maps and losses over arbitrary inputs."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from turbogs_plugin.error_maps import AGE_MAX, ErrorMaps
from turbogs_plugin.strategies.losses import CharbonnierNccLoss, SparseSsimLoss
from turbogs_plugin.strategies.pixel_sampling import ErrorGuidedPixelSampler
from turbogs_plugin.types import PixelSamples, Step

ANY_ERROR = st.sampled_from([0.0, 6e-8, 1e-3, 0.3, 3.0, 65504.0, 1e30, float("inf"), float("-inf"), float("nan")])


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    sizes=st.lists(st.tuples(st.integers(1, 40), st.integers(1, 40)), min_size=1, max_size=4),
    palette=st.lists(ANY_ERROR, min_size=1, max_size=4),
    unit=st.sampled_from(["pixel", "tile"]),
    shares=st.sampled_from([(0.4, 0.3), (1.0, 0.0), (0.0, 1.0), (0.0, 0.0), (0.5, 0.5)]),
    importance=st.sampled_from([0.0, 0.5, 1.0]),
    rate=st.sampled_from([1e-9, 0.01, 0.1, 0.4, 1.0]),
    starts=st.integers(0, 200_000),
    seed=st.integers(0, 2**63),
)
def test_training_on_any_errors_keeps_maps_and_samples_valid(
    sizes, palette, unit, shares, importance, rate, starts, seed
):
    """Three iterations, far apart, with errors of every kind at the start and after."""
    rng = np.random.default_rng(seed)
    maps = ErrorMaps(np.array(sizes))
    for view_id, (width, height) in enumerate(sizes):
        maps.initialise(view_id, torch.tensor(rng.choice(palette, width * height), dtype=torch.float32))
    hard, stable = shares
    importance *= unit == "pixel"
    sampler = ErrorGuidedPixelSampler(unit=unit, hard_ratio=hard, stable_ratio=stable, importance=importance)
    views = tuple(rng.permutation(len(sizes)).tolist())
    for iteration in (starts, starts + 1, starts + 40_000):
        step = Step(iteration=iteration, total=10**6, refine_until=10**6, seed=seed)
        samples = sampler.sample(maps, views, rate, step)
        filled = samples.filled
        pixels = samples.flat_pixels(maps.offsets)[filled]
        assert len(torch.unique(pixels)) == len(pixels) > 0
        widths, heights = torch.as_tensor(samples.sizes)[samples.view_of_slot()].unbind(dim=1)
        assert (samples.pixel_ids < widths * heights).all()
        if importance:
            assert torch.isfinite(samples.weights).all()
            assert (samples.weights[filled] > 0).all()
        errors = torch.tensor(rng.choice(palette, len(samples)), dtype=torch.float32)
        maps.update(samples, errors.abs(), step)
        assert torch.isfinite(maps.errors).all()
        assert (maps.errors >= 0).all()
        for view_id in range(len(sizes)):
            begin, end = maps.offsets[view_id : view_id + 2]
            assert maps.view_sums[view_id] == maps.errors[begin:end].double().sum()
            ages = maps.ages(view_id, step)
            assert ((ages >= 0) & (ages <= AGE_MAX)).all()


@settings(max_examples=80, deadline=None, derandomize=True)
@given(
    counts=st.lists(st.integers(1, 40), min_size=1, max_size=4),
    levels=st.lists(st.sampled_from([0.0, 1e-20, 1e-4, 0.5, 1.0, 1e4, -1e4, 1e6]), min_size=2, max_size=2),
    truth=st.sampled_from([(0.0, 0.0), (0.3, 1e-8), (0.3, 1e-3), (1.0, 0.0), (0.0, 1.0)]),
    structure=st.sampled_from(["ncc", "printed_ncc"]),
    dtype=st.sampled_from([torch.float16, torch.float32, torch.float64]),
    seed=st.integers(0, 2**32 - 1),
)
def test_gradients_of_any_tiles_are_finite_and_bounded(counts, levels, truth, structure, dtype, seed):
    """`levels`, `truth`: mean and contrast of the tiles' predictions and photos."""
    slots, tiles = sum(counts), torch.arange(len(counts), dtype=torch.int32)
    noise, texture = torch.rand(2, slots, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    colors, targets = (levels[0] + levels[1] * noise).to(dtype), (truth[0] + truth[1] * texture).to(dtype)
    offsets = torch.tensor(np.concatenate([[0], np.cumsum(counts)]), dtype=torch.int32)
    pixel_ids = torch.arange(slots, dtype=torch.int32)
    samples = PixelSamples((0,), np.array([[16 * len(counts), 16]]), pixel_ids, tiles, offsets)
    for loss in (CharbonnierNccLoss(structure=structure), SparseSsimLoss()):
        result = loss(colors, targets, samples)
        assert all(value.isfinite().all() for value in (result.loss, result.color_gradients, result.pixel_errors))
        assert (result.color_gradients[~colors.isfinite().all(dim=1)] == 0).all()  # half precision ends at 65504
        if isinstance(loss, CharbonnierNccLoss):
            assert result.color_gradients.abs().max() <= 1.001 * (1 / (3 * slots) + 1 / len(counts))
