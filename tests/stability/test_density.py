"""Density control on models that training may leave it with."""

from __future__ import annotations

import pytest
import torch
from helpers.optimizers import all_finite, busy_stats, controlled, make_gaussians
from hypothesis import given, settings
from hypothesis import strategies as st

from turbogs_plugin.types import Step

EVENT = Step(iteration=200, total=5000, refine_until=3500, seed=7, scene_extent=1.0)
VALUES = st.sampled_from([0.0, 1e-30, 1e-4, 1.0, 1e30, float("inf"), float("nan")])
ORDERS = ({}, {"choose_by": "squares"}, {"choose_by": "squares", "prune_score_fraction": 0.2})
PARAMETERS = st.sampled_from([0.0, 1.0, -20.0, 20.0, -200.0, 50.0, 88.0, 200.0, 1e30, float("inf"), float("nan")])


@pytest.mark.parametrize("split", ["sample", "long_axis"])
@pytest.mark.parametrize("log_scale", [40.0, 60.0, 88.0, 100.0])
def test_what_is_too_large_to_split_goes(split, log_scale):
    """exp(88) is finite in float32 and ten times that is not: no split may make a model that is lost."""
    gaussians = make_gaussians(200, dtype=torch.float32)
    gaussians.scales[::2] = log_scale
    density = controlled(gaussians, busy_stats(200), refine_from=200, top_fraction=1.0, split=split)
    result = density.update(gaussians, EVENT).apply(gaussians)
    assert all_finite(result) and len(result) == (400 if log_scale == 40 else 200)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    sums=st.lists(VALUES, min_size=7, max_size=7),
    orders=st.sampled_from(ORDERS),
    parameters=st.lists(PARAMETERS, min_size=5, max_size=5),
    split=st.sampled_from(["sample", "long_axis"]),
    decay=st.sampled_from([0.0, 0.1]),
    cap=st.sampled_from([0, 1, 5]),
    final=st.booleans(),
    count=st.sampled_from([1, 2, 9]),
)
def test_any_window_and_any_model_end_in_a_finite_model(sums, orders, parameters, split, decay, cap, final, count):
    """Some rows are spoiled, all others are as ever. At least one Gaussian is left, and no row is out of range."""
    gaussians = make_gaussians(count, dtype=torch.float32)
    names = ("means", "quats", "scales", "opacities", "sh0")
    for row, (name, value) in enumerate(zip(names, parameters, strict=True)):
        getattr(gaussians, name)[row % count] = value
    density = controlled(gaussians, refine_from=0, split=split, opacity_decay=decay, max_gaussians=cap, **orders)
    fields = ("error_sums", "distance_sums", "weight_sums", "grad_sums", "absgrad_sums", "square_sums", "view_counts")
    for row, (name, value) in enumerate(zip(fields, sums, strict=True)):
        getattr(density.stats, name)[row % count] = value
    step = Step(iteration=4000 if final else 3500, total=5000, refine_until=3500, seed=7, scene_extent=1.0)
    update = density.update(gaussians, step)
    result = gaussians if update is None else update.apply(gaussians)
    assert len(result) >= 1
    assert cap == 0 or final or len(result) <= max(cap, 1)
    if len(result) > 1:  # a last Gaussian may be what is spoiled: then the trainer says so
        assert all_finite(result)
