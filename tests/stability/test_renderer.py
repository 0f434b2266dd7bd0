"""The reference renderer in float32 against itself in float64, on its worst inputs. What it does on each of them is in
tests/engine/test_extremes.py; here it is how exact that is."""

from __future__ import annotations

import pytest
import torch
from helpers.raster_extremes import CASES, assert_within, compare, lens, random_scene, render_and_check
from helpers.tolerances import TOLERANCES
from hypothesis import example, given, settings
from hypothesis import strategies as st

from turbogs_plugin.types import PARAMETER_NAMES


@pytest.mark.parametrize("case", CASES)
def test_float32_is_close_to_float64(case):
    error, errors = compare(case, torch.float32, "cpu")
    assert_within(case, error, errors, TOLERANCES[torch.float32])


SIZES = st.sampled_from([-200.0, -20.0, -10.0, -2.0, 0.0, 3.0, 9.0, 14.0, 20.0, 88.0, 200.0])
PLACES = st.sampled_from([0.0, 1e-30, 1e-3, 1.0, -1.0, 4.0, -4.0, 1e3, 1e6, -1e6, 1e18, -1e18, 1e30, 3e38])
NORMS = st.sampled_from([0.0, 1e-38, 1e-20, 1e-3, 1.0, 1e20, 1e37])
LOGITS = st.sampled_from([-50.0, -5.0, 0.0, 5.0, 50.0, 1e30, -1e30])
COLORS = st.sampled_from([0.0, 1.0, -1e4, 1e6])


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    sizes=st.lists(SIZES, min_size=3, max_size=3),
    place=st.lists(PLACES, min_size=3, max_size=3),
    norm=NORMS,
    logit=LOGITS,
    color=COLORS,
    degrees=st.sampled_from([5.0, 60.0, 170.0]),
    center=st.sampled_from([-500.0, 10.0, 5000.0]),
    size=st.sampled_from([(1, 1), (3, 40), (20, 17)]),
)
@example([-200.0] * 3, [0.0, 3e38, -4.0], 0.0, -5.0, 0.0, 5.0, -500.0, (1, 1))  # near, and endlessly far to the side
def test_any_gaussian_among_ordinary_ones_stays_finite(sizes, place, norm, logit, color, degrees, center, size):
    """Colours, gradients and statistics of everybody; a Gaussian that is not drawn has no gradient."""
    gaussians = random_scene(8)
    gaussians.scales[3], gaussians.means[3] = torch.tensor(sizes), torch.tensor(place)
    gaussians.quats[3] *= norm
    gaussians.opacities[3], gaussians.sh0[3] = logit, color
    _, gradients = render_and_check(gaussians, lens(degrees, size, center))
    for name in PARAMETER_NAMES[:-1]:
        assert (getattr(gradients, name)[:, ~gradients.touched] == 0).all(), name
