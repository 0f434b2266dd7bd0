"""Exposures: the map of colours, its gradients and its steps, against autograd and torch's own Adam."""

import numpy as np
import pytest
import torch

from turbogs_plugin.engine.exposures import (
    BETA1,
    BETA2,
    EPSILON,
    FIRST_RATE,
    LAST_RATE,
    PULL,
    Exposures,
    expose,
    exposure_gradients,
    exposure_rate,
    step_exposures,
)
from turbogs_plugin.tiles import dense_pixels
from turbogs_plugin.types import PixelSamples, Step

SIZES = np.array([[21, 17], [16, 16], [5, 40]])
VIEWS, PHOTOS = (4, 0, 2), 6


def some_exposures(seed: int = 0) -> Exposures:
    exposures = Exposures.identity(PHOTOS, "cpu")
    exposures.offsets += 0.2 * torch.randn(PHOTOS, 3, 4, generator=torch.Generator().manual_seed(seed))
    return exposures


@pytest.fixture
def samples() -> PixelSamples:
    """Every pixel of three views; two slots are empty."""
    samples = dense_pixels(VIEWS, SIZES, "cpu")
    samples.pixel_ids[[3, 400]] = -1
    return samples


def random_colors(samples: PixelSamples, seed: int = 1) -> torch.Tensor:
    return torch.rand(len(samples), 3, generator=torch.Generator().manual_seed(seed))


def plainly_exposed(matrices: torch.Tensor, colors: torch.Tensor) -> torch.Tensor:
    """By whole maps, 3x4, view after view: those of the batch, whose slots follow one another."""
    parts = colors.split(SIZES.prod(axis=1).tolist())
    mapped = [part @ matrices[view, :, :3].T + matrices[view, :, 3] for view, part in zip(VIEWS, parts, strict=True)]
    return torch.cat(mapped)


def test_each_colour_is_mapped_by_its_photo(samples):
    exposures, colors = some_exposures(), random_colors(samples)
    matrices = torch.eye(3, 4) + exposures.offsets
    torch.testing.assert_close(expose(exposures, colors, samples), plainly_exposed(matrices, colors))


def test_the_identity_changes_no_bit(samples):
    colors, gradients = random_colors(samples), random_colors(samples, 2)
    exposures = Exposures.identity(PHOTOS, "cpu")
    assert torch.equal(expose(exposures, colors, samples), colors)
    assert torch.equal(exposure_gradients(exposures, colors, gradients, samples)[0], gradients)


def test_gradients_are_those_of_autograd(samples):
    exposures, gradients = some_exposures(), random_colors(samples, 2) - 0.5
    colors = random_colors(samples).double().requires_grad_()
    matrices = (torch.eye(3, 4) + exposures.offsets).double().requires_grad_()
    plainly_exposed(matrices, colors).backward(gradients.double())
    of_colors, sums = exposure_gradients(exposures, colors.float(), gradients, samples)
    torch.testing.assert_close(of_colors.double(), colors.grad, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(sums, matrices.grad[list(VIEWS)], rtol=1e-5, atol=1e-5)


def test_a_colour_that_is_not_finite_teaches_nothing(samples):
    exposures, colors, gradients = some_exposures(), random_colors(samples), random_colors(samples, 2)
    gradients[[7, 300]] = 0.0  # as a loss gives them
    wanted = exposure_gradients(exposures, colors, gradients, samples)[1]
    colors[7, 1], colors[300, 0] = torch.nan, torch.inf
    torch.testing.assert_close(exposure_gradients(exposures, colors, gradients, samples)[1], wanted)


def test_steps_are_those_of_adam_on_the_pulled_loss_with_the_mean_at_the_identity():
    """Ten steps, of batches of one to three photos, against torch's Adam with a parameter a photo."""
    exposures, random = Exposures.identity(PHOTOS, "cpu"), torch.Generator().manual_seed(5)
    parameters = [torch.zeros(3, 4, dtype=torch.float64, requires_grad=True) for _ in range(PHOTOS)]
    adams = [torch.optim.Adam([value], lr=0.01, betas=(BETA1, BETA2), eps=EPSILON) for value in parameters]
    for step in range(10):
        views = ((4, 0, 2), (1, 4), (3,))[step % 3]
        sums = 0.1 * torch.randn(len(views), 3, 4, generator=random, dtype=torch.float64)
        step_exposures(exposures, sums, views, 0.01)
        for view, gradient in zip(views, sums, strict=True):
            parameters[view].grad = gradient + PULL / len(views) * parameters[view].detach()
            adams[view].step()
        with torch.no_grad():
            mean = torch.stack([value.detach() for value in parameters]).mean(dim=0)
            for value in parameters:
                value -= mean
        torch.testing.assert_close(exposures.offsets.double(), torch.stack(parameters).detach(), rtol=0, atol=2e-6)
        assert exposures.offsets.mean(dim=0).abs().max() < 1e-7
    assert exposures.steps.tolist() == [4, 3, 4, 3, 7, 0]


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, 1e300])
def test_a_photo_whose_gradient_is_not_finite_is_passed_over(bad):
    exposures, alone = some_exposures(), some_exposures()
    sums = torch.randn(2, 3, 4, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    sums[0, 1, 2] = bad
    before = exposures.offsets.clone()
    step_exposures(exposures, sums, (4, 1), 0.01)
    assert all(value.isfinite().all() for value in vars(exposures).values())
    assert exposures.steps.tolist() == [0, 1, 0, 0, 0, 0] and not exposures.exp_avg[4].any()
    step_exposures(alone, 2 * sums[1:], (1,), 0.01)  # Adam's first step is the sign of the gradient, of any size
    torch.testing.assert_close(exposures.offsets, alone.offsets, rtol=0, atol=1e-6)
    assert not torch.equal(exposures.offsets, before)


def test_an_iteration_that_did_nothing_changes_no_exposure():
    exposures, sums = some_exposures(), torch.ones(len(VIEWS), 3, 4, dtype=torch.float64)
    before = {name: value.clone() for name, value in vars(exposures).items()}
    for overflow, same in ((1, True), (0, False)):
        step_exposures(exposures, sums, VIEWS, 0.01, torch.tensor([overflow], dtype=torch.int32))
        assert all(torch.equal(value, before[name]) for name, value in vars(exposures).items()) == same


def test_the_rate_falls_tenfold():
    rates = [exposure_rate(Step(iteration, 100, 70)) for iteration in (0, 50, 100, 120)]
    np.testing.assert_allclose(rates, [FIRST_RATE, (FIRST_RATE * LAST_RATE) ** 0.5, LAST_RATE, LAST_RATE])


def test_a_state_of_other_photos_is_refused():
    exposures = some_exposures()
    for name in vars(exposures):
        state = {**exposures.state_dict(), name: exposures.state_dict()[name][:-1]}
        with pytest.raises(ValueError, match=rf"^exposures {name}: found shape \(5.*expected shape \(6"):
            exposures.load_state_dict(state)
