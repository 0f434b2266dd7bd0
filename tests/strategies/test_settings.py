"""Settings that no strategy can use are refused, by their names."""

import math

import pytest
from helpers.refusals import assert_refused

from turbogs_plugin import strategies
from turbogs_plugin.config.typed import settings_of

REFUSED = {
    "SinusoidalSchedule": ({"min_views": 0}, {"max_views": 2}, {"pixel_budget": math.nan}, {"alpha": -1.0}),
    "FixedSchedule": ({"views": 0}, {"views": 2.5}, {"pixel_budget": 0.0}),
    "GeometryAwareViewSampler": ({"distance_weight": -1.0},),
    "RandomPixelSampler": ({"unit": "warp"}, {"multiple": 0}, {"multiple": 24}, {"multiple": 512}),
    "ErrorGuidedPixelSampler": (
        {"hard_ratio": 1.2},
        {"stable_ratio": 0.7},
        {"mixed": "age"},
        {"importance": 1.5},
        {"importance": 1.0, "unit": "tile"},
    ),
    "CharbonnierNccLoss": ({"ncc_weight": -0.1}, {"structure": "cosine"}, {"variance_constant": 0.0}),
    "SparseSsimLoss": ({"ssim_weight": 1.1},),
    "LearningRates": ({"shN": math.nan}, {"means": 0.0}, {"batch_scale": math.inf}),
    "SparseAdam": ({"beta1": 1.0}, {"beta2": -0.1}, {"eps": 0.0}),
    "MomentLMOptimizer": ({"beta1": 1.0},),
    "DenseAdam": ({"opacity_reg": -1.0}, {"scale_reg": math.nan}),
    "ErrorDrivenDensity": ({"score": "best"}, {"refine_every": 0}, {"top_fraction": 0.0}, {"max_gaussians": -1}),
    "GsplatDefaultDensity": ({"opacity_reset": "never"}, {"refine_every": 0}, {"refine_start_iter": -1}),
    "GsplatMcmcDensity": ({"refine_start_iter": -1}, {"max_gaussians": 0}, {"refine_every": 0}),
}
"""Strategy -> mappings of one setting each, alone impossible beside the defaults."""


@pytest.mark.parametrize("strategy", REFUSED)
def test_impossible_settings_are_refused_by_name(strategy):
    for values in REFUSED[strategy]:
        assert_refused(next(iter(values)), getattr(strategies, strategy), **values)


@pytest.mark.parametrize("strategy", REFUSED)
def test_settings_of_another_type_are_refused_by_name(strategy):
    """Numbers in text, as a script reads them from its arguments or from a file."""
    for name in settings_of(cls := getattr(strategies, strategy)):
        for wrong in ("3", None, [1.0]):
            assert_refused(f"^{name} = .* must be ", cls, **{name: wrong})
