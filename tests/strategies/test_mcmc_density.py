"""gsplat's MCMC behind our protocol: what its new Gaussians come from, and what it refuses. gsplat's own operators are
replaced here by ones that change nothing; `stability/test_baseline_density.py` has them by their formulas."""

import pytest
import torch
from gsplat.strategy import ops
from helpers.optimizers import make_gaussians

from turbogs_plugin.errors import InputError
from turbogs_plugin.strategies.density.mcmc import GsplatMcmcDensity
from turbogs_plugin.strategies.optimizers.moment_lm import MomentLMOptimizer
from turbogs_plugin.types import Step

COUNT, ADDED = 100, 5


@pytest.fixture(autouse=True)
def gsplats_operators_change_nothing(monkeypatch):
    monkeypatch.setattr(ops, "compute_relocation", lambda opacities, scales, ratios, binoms: (opacities, scales))
    still = lambda quats, scales, **_: (scales.new_zeros(len(scales), 3, 3), None)  # noqa: E731
    monkeypatch.setattr(ops, "quat_scale_to_covar_preci", still)


def test_what_is_added_has_the_step_count_of_what_it_was_copied_from():
    """Some are dead and relocated first, onto others of which copies may be added as well."""
    gaussians = make_gaussians(COUNT, dtype=torch.float32)
    gaussians.opacities[::5] = -9.0
    before = gaussians.sh0.clone()
    optimizer = MomentLMOptimizer()
    optimizer.setup(gaussians)
    optimizer.moments.steps[:] = torch.arange(COUNT) + 1
    optimizer.moments.exp_avg[:] = 1.0
    update = GsplatMcmcDensity(max_gaussians=COUNT + ADDED).update(gaussians, Step(600, 5000, 3500))
    after = update.apply(gaussians)
    optimizer.apply(update)
    assert len(after) == COUNT + ADDED
    assert update.source[:COUNT].tolist() == list(range(COUNT)) and update.num_cloned == ADDED
    torch.testing.assert_close(after.sh0[COUNT:], before[update.source[COUNT:]])
    assert optimizer.moments.steps.tolist() == (update.source + 1).tolist()
    assert (optimizer.moments.exp_avg[COUNT:] == 0).all()


def test_a_cpu_is_refused():
    with pytest.raises(InputError, match="'mcmc' needs a GPU"):
        GsplatMcmcDensity().setup(make_gaussians(3))
