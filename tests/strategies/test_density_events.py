"""When density control says that it has an event, and what it really looks at and changes between events."""

from __future__ import annotations

from contextlib import nullcontext

import pytest
import torch
from gsplat.strategy import MCMCStrategy, ops
from helpers.optimizers import fill, make_gaussians, random_stats

from turbogs_plugin.errors import InputError
from turbogs_plugin.strategies.density.error_driven import ErrorDrivenDensity
from turbogs_plugin.strategies.density.gsplat_default import GsplatDefaultDensity
from turbogs_plugin.strategies.density.mcmc import GsplatMcmcDensity
from turbogs_plugin.strategies.density.rows import NoDensity
from turbogs_plugin.strategies.optimizers.moment_lm import MomentLMOptimizer
from turbogs_plugin.types import Gaussians, Step

TOTAL, REFINE_UNTIL, COUNT = 60, 30, 40


def error_driven(**options) -> ErrorDrivenDensity:
    return ErrorDrivenDensity(refine_from=5, refine_every=4, final_every=7, final_keep=0.9, **options)


MAKERS = {
    "error_driven": error_driven,
    "no final": lambda: ErrorDrivenDensity(refine_from=5, refine_every=4, final_keep=1.0),
    "mcmc": lambda: GsplatMcmcDensity(refine_start_iter=5, refine_every=4),
    "gsplat_default": lambda: GsplatDefaultDensity(refine_start_iter=5, refine_every=4),
    "none": NoDensity,
}
EXACT = ("error_driven", "no final", "mcmc", "none")
"""Every event of theirs changes something here."""
WITHOUT_LATER_EVENTS = ("no final", "mcmc", "gsplat_default", "none")
"""None of theirs comes after densification has ended."""


class Untouchable:
    """A model or statistics of which only the number of rows may be asked."""

    def __len__(self) -> int:
        return COUNT

    def __getattr__(self, name: str):
        raise AssertionError(f"{name} was looked at though no event was due")


@pytest.fixture(autouse=True)
def gsplats_operators_do_little(monkeypatch):
    monkeypatch.setattr(ops, "compute_relocation", lambda opacities, scales, ratios, binoms: (opacities, scales))
    still = lambda quats, scales, **_: (scales.new_zeros(len(scales), 3, 3), None)  # noqa: E731
    monkeypatch.setattr(ops, "quat_scale_to_covar_preci", still)
    monkeypatch.setattr(MCMCStrategy, "initialize_state", lambda self: {"binoms": torch.empty(0)})


def model() -> Gaussians:
    """With Gaussians that every event prunes or relocates."""
    gaussians = make_gaussians(COUNT, dtype=torch.float32)
    gaussians.opacities[:] = 1.0
    gaussians.opacities[::5] = -9.0
    return gaussians


@pytest.mark.parametrize("name", MAKERS)
def test_events_are_where_it_says(name):
    """Over a whole run. Between events nothing is looked at but a model that is moved, and nothing is changed."""
    density = MAKERS[name]()
    with pytest.raises(InputError, match="'mcmc' needs a GPU") if name == "mcmc" else nullcontext():
        density.setup(model())  # mcmc has no state
    said, changed = [], []
    for iteration in range(TOTAL):
        step = Step(iteration, TOTAL, REFINE_UNTIL, seed=3)
        due, stats = density.event_due(step), density.stats
        given = model() if due or density.moves_model else Untouchable()
        if stats is not None:
            fill(stats, random_stats(COUNT, seed=iteration))
        hidden = stats is not None and not due
        if hidden:
            density.stats = Untouchable()
        update = density.update(given, step)
        if hidden and density.stats is not None:
            density.stats = stats
        said += [iteration] if due else []
        changed += [iteration] if update is not None else []
        if update is not None:
            assert due, iteration  # it is not followed: all models here have as many rows
    assert set(changed) <= set(said)
    if name in EXACT:
        assert changed == said
    assert len(said) < TOTAL / 3 and (len(changed) > 3 or name == "none")
    if name in WITHOUT_LATER_EVENTS:
        assert max(said, default=0) <= REFINE_UNTIL


def test_the_noise_of_mcmc_is_why_it_moves_the_model(monkeypatch):
    gaussians, density = model(), GsplatMcmcDensity()
    round_ones = lambda quats, scales, **_: (torch.eye(3).expand(len(scales), 3, 3), None)  # noqa: E731
    monkeypatch.setattr(ops, "quat_scale_to_covar_preci", round_ones)
    before, step = gaussians.means.clone(), Step(1, TOTAL, REFINE_UNTIL)
    assert not density.event_due(step) and density.update(gaussians, step) is None
    assert not torch.equal(gaussians.means, before) and density.moves_model


def test_an_event_ends_a_window_whether_it_changes_anything_or_not():
    """The next one begins with zeros, for the rows of the change as it was followed."""
    gaussians, due = make_gaussians(COUNT), Step(8, TOTAL, REFINE_UNTIL)
    density = error_driven(prune_opacity=0.0, prune_world_size=0.0, absgrad_threshold=1e3, grad_threshold=1e3)
    density.setup(gaussians)
    fill(density.stats, random_stats(COUNT, seed=1))
    assert density.update(gaussians, due) is None
    assert not any(value.any() for value in vars(density.stats).values())
    gaussians.opacities[::5] = torch.nan
    fill(density.stats, random_stats(COUNT, seed=1))
    change = density.update(gaussians, due)
    density.apply(change.taking(torch.arange(3, 20)))
    assert all(len(value) == 17 and not value.any() for value in vars(density.stats).values())


def test_what_mcmc_adds_has_the_step_count_of_what_it_was_copied_from():
    """Some are dead and relocated first, onto others of which copies may be added as well."""
    gaussians, added = model(), COUNT // 20  # 5 %
    before = gaussians.sh0.clone()
    optimizer = MomentLMOptimizer()
    optimizer.setup(gaussians)
    optimizer.moments.steps[:] = torch.arange(COUNT) + 1
    optimizer.moments.exp_avg[:] = 1.0
    update = GsplatMcmcDensity(max_gaussians=COUNT + added).update(gaussians, Step(600, 5000, 3500))
    after = update.apply(gaussians)
    optimizer.apply(update)
    assert len(after) == COUNT + added
    assert update.source[:COUNT].tolist() == list(range(COUNT)) and update.num_cloned == added
    torch.testing.assert_close(after.sh0[COUNT:], before[update.source[COUNT:]])
    assert optimizer.moments.steps.tolist() == (update.source + 1).tolist()
    assert (optimizer.moments.exp_avg[COUNT:] == 0).all()
