"""The baselines' density control on models and windows that training may leave it with.

gsplat's relocation has no CPU form: its two operators are replaced here by the formulas of their publications.
"""

from __future__ import annotations

import math
from dataclasses import fields

import pytest
import torch
from gsplat.cuda._torch_impl import _quat_scale_to_covar_preci
from gsplat.strategy import ops
from helpers.optimizers import all_finite, clone, fill, make_gaussians, random_stats
from hypothesis import given, settings
from hypothesis import strategies as st

from turbogs_plugin.strategies.density.gsplat_default import GsplatDefaultDensity
from turbogs_plugin.strategies.density.mcmc import GsplatMcmcDensity
from turbogs_plugin.strategies.learning_rates import LearningRates
from turbogs_plugin.types import PARAMETER_NAMES, Gaussians, GaussianStats, Step

EVENT = Step(iteration=600, total=5000, refine_until=3500, seed=7, scene_extent=1.0)
LATE = Step(iteration=3600, total=5000, refine_until=3500, seed=7, scene_extent=1.0)
VALUES = st.sampled_from([0.0, 1e-30, 1e-4, 1.0, 1e30, float("inf"), float("nan")])
PARAMETERS = st.sampled_from([0.0, 1.0, -20.0, 20.0, -200.0, 50.0, 88.0, 200.0, 1e30, float("inf"), float("nan")])
BROKEN = [float("nan"), float("inf"), -float("inf")]


def relocation_on_cpu(opacities, scales, ratios, binoms):
    """Kheradmand et al. 2024, equation 9: n Gaussians in the place of one that look like it from afar."""
    new_opacities, new_scales = torch.empty_like(opacities), torch.empty_like(scales)
    for row, (opacity, ratio) in enumerate(zip(opacities.double().tolist(), ratios.tolist(), strict=True)):
        n = min(ratio, len(binoms))
        new = 1 - (1 - opacity) ** (1 / n)
        terms = [(-1) ** k * new ** (k + 1) / math.sqrt(k + 1) for k in range(n)]
        total = sum(math.comb(i - 1, k) * terms[k] for i in range(1, n + 1) for k in range(i))
        new_opacities[row], new_scales[row] = new, opacity / total * scales[row]
    return new_opacities, new_scales


def covariances_on_cpu(quats, scales, compute_covar=True, compute_preci=False, triu=False):
    return _quat_scale_to_covar_preci(quats, scales, compute_covar, compute_preci, triu)


@pytest.fixture(autouse=True)
def gsplats_ops_on_cpu(monkeypatch):
    monkeypatch.setattr(ops, "compute_relocation", relocation_on_cpu)
    monkeypatch.setattr(ops, "quat_scale_to_covar_preci", covariances_on_cpu)


MAKERS = {"gsplat_default": GsplatDefaultDensity, "mcmc": GsplatMcmcDensity}


def controller(name: str, gaussians: Gaussians, stats: GaussianStats | None = None, **options):
    """A controller that has been set up, with these statistics in its window."""
    density = MAKERS[name](**options)
    if name != "mcmc":  # which has no state, and on a CPU refuses
        density.setup(gaussians)
    if stats is not None and density.stats is not None:
        fill(density.stats, stats)
    return density


def follow(density, gaussians: Gaussians, step: Step = EVENT) -> Gaussians:
    """The model after the event; the window, if there is one, has as many rows."""
    update = density.update(gaussians, step)
    result = gaussians if update is None else update.apply(gaussians)
    if update is not None:
        density.apply(update)
    if density.stats is not None:
        assert all(len(getattr(density.stats, item.name)) == len(result) for item in fields(GaussianStats))
    if update is not None:
        assert ((update.source >= 0) & (update.source < len(gaussians))).all()
        assert len(update.fresh) == len(update.source) == len(result)
    return result


@pytest.mark.parametrize("step", [EVENT, LATE], ids=["event", "late"])
@pytest.mark.parametrize("name", MAKERS)
def test_everything_is_due_to_go(name, step):
    """The most opaque one is left; MCMC, which has nobody alive to relocate to, leaves all as they are."""
    gaussians = make_gaussians(9, dtype=torch.float32)
    gaussians.opacities[:] = -torch.arange(20.0, 29.0)
    gaussians.opacities[5] = -9.0
    result = follow(controller(name, gaussians, random_stats(9, 0)), gaussians, step)
    if name == "mcmc" or (name == "gsplat_default" and step is LATE):
        assert len(result) == 9
    else:
        assert result.sh0[:, 0, 0].tolist() == [5.0]
    assert all_finite(result)


@pytest.mark.parametrize("name", MAKERS)
@pytest.mark.parametrize("parameter", PARAMETER_NAMES)
@pytest.mark.parametrize("bad", BROKEN)
def test_a_gaussian_that_is_not_finite_goes(name, parameter, bad):
    """MCMC relocates it; the others remove it. What it was never spreads."""
    gaussians = make_gaussians(40, dtype=torch.float32)
    gaussians.opacities[:] = 1.0
    getattr(gaussians, parameter)[7] = bad
    result = follow(controller(name, gaussians, random_stats(40, 1)), gaussians)
    assert all_finite(result)
    assert 7.0 not in result.sh0[:, 0, 0] and 6.0 in result.sh0[:, 0, 0]


@pytest.mark.parametrize("name", MAKERS)
@pytest.mark.parametrize("log_scale", [50.0, 60.0, 88.0, 100.0])
def test_scales_that_overflow(name, log_scale):
    """exp(50) squared is not finite in float32, exp(100) itself is not: no split, no noise may make such a mean."""
    gaussians = make_gaussians(40, dtype=torch.float32)
    gaussians.opacities[:] = -1.0
    gaussians.scales[::2] = log_scale
    stats = random_stats(40, 2, seen=1.1)
    stats.grad_sums.fill_(1.0)
    result = follow(controller(name, gaussians, stats), gaussians)
    assert all_finite(result) and result.scales.max() < 40
    assert len(result) >= 20


def test_noise_that_overflows_is_left_out():
    """Between two events of MCMC: the others are moved, a Gaussian endlessly large stays where it is."""
    gaussians = make_gaussians(6, dtype=torch.float32)
    gaussians.opacities[:] = -6.0
    gaussians.scales[2], gaussians.quats[4] = 88.0, float("nan")
    before = clone(gaussians)
    density = GsplatMcmcDensity()
    assert density.update(gaussians, Step(601, 5000, 3500, seed=7)) is None
    moved = (gaussians.means != before.means).any(dim=-1)
    assert moved.tolist() == [True, True, False, True, False, True]
    assert gaussians.means.isfinite().all()


def test_noise_follows_the_next_iterations_rate_of_the_means():
    """gsplat's trainer steps its scheduler before its strategy, and the noise is in proportion to rate and extent."""
    rates = LearningRates(means=1e-2, means_final=1e-6, batch_scale=1.0)
    lengths = []
    for total, extent in ((100, 3.0), (200, 3.0), (200, 6.0)):
        gaussians = make_gaussians(50, dtype=torch.float32)
        gaussians.opacities[:] = -6.0
        before = gaussians.means.clone()
        GsplatMcmcDensity(learning_rates=rates).update(gaussians, Step(99, total, total, 7, scene_extent=extent))
        lengths.append(float((gaussians.means - before).norm()))
    assert lengths[0] / lengths[1] == pytest.approx(1e-6 / 1e-4, rel=0.01)
    assert lengths[2] / lengths[1] == pytest.approx(2.0, rel=1e-3)


@settings(max_examples=70, deadline=None, derandomize=True)
@given(
    name=st.sampled_from(sorted(MAKERS)),
    sums=st.lists(VALUES, min_size=len(fields(GaussianStats)), max_size=len(fields(GaussianStats))),
    parameters=st.lists(PARAMETERS, min_size=len(PARAMETER_NAMES), max_size=len(PARAMETER_NAMES)),
    late=st.booleans(),
    count=st.sampled_from([1, 2, 30]),
)
def test_any_window_and_any_model_end_in_a_finite_model(name, sums, parameters, late, count):
    """Some rows are spoiled, all others are as ever. At an event, at least one Gaussian is left and all are finite."""
    gaussians = make_gaussians(count, dtype=torch.float32)
    for row, (parameter, value) in enumerate(zip(PARAMETER_NAMES, parameters, strict=True)):
        getattr(gaussians, parameter)[row % count] = value
    density = controller(name, gaussians)
    if density.stats is not None:
        for row, (item, value) in enumerate(zip(fields(GaussianStats), sums, strict=True)):
            getattr(density.stats, item.name)[row % count] = value
    result = follow(density, gaussians, LATE if late else EVENT)
    assert len(result) >= 1
    if count == 30 and not late:
        assert all_finite(result)
