"""Exposures on the kernels: maps, gradients and steps of their torch twins; and iterations that wait for nothing."""

import copy

import numpy as np
import pytest
import torch
from helpers.framework_runs import assert_iterations_wait_for_nothing, tiny_config
from helpers.raster_cases import GPU_ONLY

from turbogs_plugin.engine.cuda import training as kernels
from turbogs_plugin.engine.exposures import Exposures, expose, exposure_gradients, step_exposures
from turbogs_plugin.tiles import dense_pixels
from turbogs_plugin.train.loop import TrainingLoop
from turbogs_plugin.train.trainer import Trainer

pytestmark = GPU_ONLY

DEVICE = torch.device("cuda")
SIZES = np.array([(700, 500), (16, 16), (7, 50), (128, 64)])
ALL_VIEWS = ("schedule.min_views=7", "schedule.max_views=7")
VIEWS, PHOTOS = (4, 0, 37, 2), 40


def case(device="cpu"):
    """Exposures, every pixel of views from many tiles to one, their colours and gradients. Some slots are empty, some
    colours not finite."""
    random = torch.Generator().manual_seed(3)
    exposures = Exposures.identity(PHOTOS, device)
    for name, scale in (("offsets", 0.2), ("exp_avg", 0.01), ("exp_avg_sq", 1e-4)):
        value = scale * torch.randn(PHOTOS, 3, 4, generator=random)
        getattr(exposures, name).copy_(value.abs() if name == "exp_avg_sq" else value)
    exposures.steps.copy_(torch.randint(0, 50, (PHOTOS,), generator=random))
    samples = dense_pixels(VIEWS, SIZES, device)
    colors = torch.rand(len(samples), 3, generator=random)
    gradients = (torch.rand(len(samples), 3, generator=random) - 0.4) / len(samples)
    samples.pixel_ids[[5, 350_010]] = -1
    colors[[9, 350_100], 1] = torch.tensor([torch.nan, torch.inf])
    gradients[[5, 9, 350_010, 350_100]] = 0.0
    return exposures, samples, colors.to(device), gradients.to(device)


def test_colours_are_mapped_as_by_the_reference():
    exposures, samples, colors, _ = case()
    on_gpu = case(DEVICE)
    wanted = expose(exposures, colors, samples)
    found = kernels.expose_colors(on_gpu[0], on_gpu[2], on_gpu[1]).cpu()
    finite = colors.isfinite().all(dim=1)
    torch.testing.assert_close(found[finite], wanted[finite], rtol=1e-6, atol=1e-6)
    assert not found[~finite].isfinite().all(dim=1).any()
    identity = Exposures.identity(PHOTOS, DEVICE)
    assert torch.equal(kernels.expose_colors(identity, on_gpu[2], on_gpu[1]).cpu()[finite], colors[finite])


def test_gradients_and_steps_are_those_of_the_reference():
    exposures, samples, colors, gradients = case()
    of_colors, sums = exposure_gradients(exposures, colors, gradients, samples)
    step_exposures(exposures, sums, VIEWS, 0.003)
    found, samples, colors, gradients = case(DEVICE)
    gradients_found = kernels.learn_exposures(found, colors, gradients, samples, 0.003)
    torch.testing.assert_close(gradients_found.cpu(), of_colors, rtol=1e-5, atol=1e-10)
    assert torch.equal(found.steps.cpu(), exposures.steps)
    for name, tolerance in (("exp_avg", 1e-6), ("exp_avg_sq", 1e-8), ("offsets", 1e-5)):
        torch.testing.assert_close(getattr(found, name).cpu(), getattr(exposures, name), rtol=1e-4, atol=tolerance)
    assert found.offsets.mean(dim=0).abs().max() < 1e-6


def test_moments_take_the_share_of_a_gradient_that_adam_has():
    """1 - beta, rounded once: the difference of two floats is off by 1.3e-5 at 0.999. The sums here are exact."""
    found, samples = Exposures.identity(PHOTOS, DEVICE), dense_pixels((7,), SIZES[1:2], DEVICE)
    colors, gradients = (torch.full((256, 3), value, device=DEVICE) for value in (0.5, 2.0**-10))
    wanted = copy.deepcopy(found)
    _, sums = exposure_gradients(wanted, colors, gradients, samples)
    step_exposures(wanted, sums, (7,), 0.003)
    kernels.learn_exposures(found, colors, gradients, samples, 0.003)
    assert (found.exp_avg_sq[7] > 0).all()
    for name in ("exp_avg", "exp_avg_sq"):
        torch.testing.assert_close(getattr(found, name), getattr(wanted, name), rtol=1e-6, atol=0)


@pytest.mark.parametrize("tiles", [0, 1])
def test_batches_of_no_or_one_tile(tiles):
    exposures, _, colors, gradients = case(DEVICE)
    samples = dense_pixels((7,), SIZES[1:2], DEVICE)
    if not tiles:
        samples.pixel_ids, samples.tile_ids = samples.pixel_ids[:0], samples.tile_ids[:0]
        samples.tile_offsets = samples.tile_offsets[:1]
    colors, gradients = colors[: 256 * tiles].nan_to_num(0.5, posinf=0.5), gradients[: 256 * tiles]
    reference = copy.deepcopy(exposures)
    _, sums = exposure_gradients(reference, colors, gradients, samples)
    step_exposures(reference, sums, (7,), 0.003)
    assert kernels.expose_colors(exposures, colors, samples).shape == colors.shape
    kernels.learn_exposures(exposures, colors, gradients.clone(), samples, 0.003)
    torch.testing.assert_close(exposures.offsets, reference.offsets, rtol=1e-4, atol=1e-5)


def test_a_view_whose_gradient_is_not_finite_and_an_overflow_change_nothing():
    exposures, samples, colors, gradients = case(DEVICE)
    before = copy.deepcopy(exposures)
    kernels.learn_exposures(exposures, colors, gradients.clone(), samples, 0.003, torch.ones(1, device=DEVICE).int())
    assert all(torch.equal(value, getattr(before, name)) for name, value in vars(exposures).items())
    gradients[100, 0] = torch.inf  # of view 4
    kernels.learn_exposures(exposures, colors, gradients, samples, 0.003)
    assert exposures.steps[4] == before.steps[4] and exposures.steps[0] == before.steps[0] + 1
    assert torch.equal(exposures.exp_avg[4], before.exp_avg[4]) and exposures.offsets.isfinite().all()


@pytest.mark.parametrize(("exposure", "place"), [(False, "device"), (True, "device"), (True, "host")])
def test_iterations_between_events_wait_for_nothing(scene, exposure, place):
    overrides = (f"train.exposure={exposure}", "density.refine_from=1000", f"train.pixels_place={place}")
    config = tiny_config("capture", "train.device=cuda", *overrides)
    trainer = Trainer(config.without_plan(), scene, DEVICE)
    assert_iterations_wait_for_nothing(trainer)
    if exposure:
        assert trainer.exposures.offsets.any() and trainer.exposures.offsets.mean(dim=0).abs().max() < 1e-6


def test_a_whole_run_on_the_gpu_ends_near_that_of_the_reference(scene):
    exposures = []
    for device in ("cuda", "cpu"):
        config = tiny_config("capture", f"train.device={device}", "train.exposure=true", *ALL_VIEWS)
        trainer = Trainer(config.without_plan(), scene, torch.device(device))
        TrainingLoop(trainer).run()
        exposures.append(trainer.exposures)
    assert exposures[0].steps.tolist() == exposures[1].steps.tolist()
    assert exposures[0].offsets.any() and (exposures[0].offsets.cpu() - exposures[1].offsets).abs().max() < 0.03
