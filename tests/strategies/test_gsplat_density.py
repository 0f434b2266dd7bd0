"""gsplat's DefaultStrategy behind our protocol gives what gsplat gives when it is run by itself."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gsplat.strategy import DefaultStrategy
from gsplat.strategy.ops import reset_opa
from helpers.optimizers import make_gaussians

from turbogs_plugin.strategies.density.gsplat_default import GsplatDefaultDensity
from turbogs_plugin.types import RowUpdate, Step

COUNT, VIEWS, SIZE = 80, 3, (64, 48)


def screen(seed: int) -> SimpleNamespace:
    """Screen gradients and radii of a batch, as gsplat's `info` has them."""
    generator = torch.Generator().manual_seed(seed)
    gradients = torch.randn(VIEWS, COUNT, 2, generator=generator) * 3e-6
    # One radius in all views that see a Gaussian: of several, gsplat 1.5.3 keeps the last one, not the largest.
    sizes = torch.randint(1, 12, (COUNT, 1), generator=generator)
    radii = sizes * (torch.rand(VIEWS, COUNT, 1, generator=generator) < 0.7)
    return SimpleNamespace(gradients=gradients, radii=radii.repeat(1, 1, 2))


def gsplats_own(gaussians, batch, step: Step, config: dict, repaired: bool):
    """(parameters, Adam states) after gsplat's strategy ran on them with optimizers that have a past."""
    params = {name: torch.nn.Parameter(value.clone()) for name, value in gaussians.items()}
    optimizers = {name: torch.optim.Adam([p], lr=1e-3) for name, p in params.items()}
    for name, p in params.items():
        p.grad = torch.sin(torch.arange(p.numel(), dtype=p.dtype)).reshape(p.shape)
        optimizers[name].step()
        with torch.no_grad():
            p.copy_(getattr(gaussians, name))
    before = {name: optimizers[name].state[p]["exp_avg"].clone() for name, p in params.items()}
    strategy = DefaultStrategy(**config, refine_stop_iter=step.refine_until)
    state = strategy.initialize_state(step.scene_extent)
    means2d = SimpleNamespace(grad=batch.gradients)
    info = {"width": SIZE[0], "height": SIZE[1], "n_cameras": VIEWS, "gaussian_ids": None}
    info |= {"radii": batch.radii, "means2d": means2d}
    torch.manual_seed(int(np.random.SeedSequence([step.seed, step.iteration]).generate_state(1)[0]))
    strategy.step_post_backward(params, optimizers, state, step.iteration, info)
    if repaired and step.iteration % strategy.reset_every == 0:
        reset_opa(params, optimizers, state, strategy.prune_opa * 2)
    after = {name: optimizers[name].state[p]["exp_avg"] for name, p in params.items()}
    return {name: p.data for name, p in params.items()}, before, after


def ours(gaussians, batch, step: Step, config: dict, opacity_reset: str) -> RowUpdate | None:
    density = GsplatDefaultDensity(**config, opacity_reset=opacity_reset)
    density.setup(gaussians)
    scale = torch.tensor(SIZE) * 0.5 * VIEWS  # the units that GaussianStats promises
    visible = (batch.radii > 0).all(dim=-1).float()
    density.stats.grad_sums += ((batch.gradients * scale).norm(dim=-1) * visible).sum(dim=0)
    density.stats.view_counts += visible.sum(dim=0)
    density.stats.max_radii += (batch.radii.amax(dim=-1) * visible).amax(dim=0) / max(SIZE)
    update = density.update(gaussians, step)
    if update is not None:
        density.apply(update)
    count = COUNT if update is None else len(update.source)
    assert {len(value) for value in vars(density.stats).values()} == {count}
    return update


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("config", "iteration"), [({}, 600), ({}, 3100), ({}, 3000), ({"refine_start_iter": 30, "refine_every": 40}, 80)]
)
@pytest.mark.parametrize("opacity_reset", ["repaired", "as_shipped"])
def test_equals_gsplat(seed, config, iteration, opacity_reset):
    gaussians, batch = make_gaussians(COUNT, seed, dtype=torch.float32), screen(seed)
    gaussians.scales -= 0.7  # small enough for clones beside splits
    step = Step(iteration, 30_000, 15_000, seed=seed, scene_extent=1.3)
    expected, state_before, state_after = gsplats_own(gaussians, batch, step, config, opacity_reset == "repaired")
    update = ours(gaussians, batch, step, config, opacity_reset)
    assert update.num_split > 0 and update.num_cloned > 0
    after = update.apply(gaussians)
    for name, value in expected.items():
        assert torch.equal(getattr(after, name), value), name
        moments = update.apply_state(state_before[name])
        if name in update.reset:
            moments.zero_()
        assert torch.equal(moments, state_after[name]), name
    was_reset = opacity_reset == "repaired" and iteration == 3000
    assert update.reset == (("opacities",) if was_reset else ())
    assert not was_reset or torch.sigmoid(after.opacities).max() <= 2 * DefaultStrategy.prune_opa + 1e-6


def test_leaves_global_random_numbers_alone():
    gaussians, batch = make_gaussians(COUNT, dtype=torch.float32), screen(0)
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    assert ours(gaussians, batch, Step(600, 30_000, 15_000, scene_extent=1.3), {}, "repaired") is not None
    assert torch.equal(torch.rand(3), expected)


@pytest.mark.parametrize(("refine_every", "kept"), [(100, False), (7, True)])
def test_a_refinement_starts_a_new_window_and_a_reset_does_not(refine_every, kept):
    """Statistics follow their Gaussian, whatever the order of the rows."""
    gaussians = make_gaussians(10, dtype=torch.float32)
    density = GsplatDefaultDensity(refine_every=refine_every)
    density.setup(gaussians)
    density.stats.view_counts += torch.arange(10)
    gaussians.means[4] = torch.nan  # so that there is a change
    update = density.update(gaussians, Step(3000, 30_000, 15_000))
    update = update.taking(torch.arange(9).flip(0))
    density.apply(update)
    assert update.source.tolist() == [9, 8, 7, 6, 5, 3, 2, 1, 0]
    assert torch.equal(density.stats.view_counts, update.source.float() if kept else torch.zeros(9))
