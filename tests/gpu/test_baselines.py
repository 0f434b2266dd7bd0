"""The baselines on a GPU: dense Adam by torch's fused kernel, MCMC by gsplat's own operators, and whole runs."""

import pytest
import torch
from helpers.framework_runs import assert_iterations_wait_for_nothing, tiny_capture
from helpers.optimizers import STEP, clone, make_gaussians, make_gradients
from helpers.raster_cases import GPU_ONLY

from turbogs_plugin.captures import load_scene
from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.strategies.density.mcmc import GsplatMcmcDensity
from turbogs_plugin.strategies.learning_rates import LearningRates
from turbogs_plugin.strategies.optimizers.dense_adam import DenseAdam
from turbogs_plugin.train.run import train
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import GaussianGradients, Step

pytestmark = GPU_ONLY

DEVICE, COUNT = "cuda", 200
RATES = LearningRates(scales=0.1, quats=0.05, opacities=0.2, sh0=0.1, shN=0.05, batch_scale=1.0)
"""Large, so that a step is not lost in the rounding of the parameters."""


def on_device(gradients: GaussianGradients) -> GaussianGradients:
    """In float32 where they are of floats."""
    values = {name: value.to(DEVICE) for name, value in vars(gradients).items()}
    return GaussianGradients(**{name: v.float() if v.is_floating_point() else v for name, v in values.items()})


def gradients_of(seed: int) -> GaussianGradients:
    gradients = make_gradients(2, COUNT, seed)
    untouched = torch.rand(COUNT, generator=torch.Generator().manual_seed(seed)) < 0.4
    for name, value in vars(gradients).items():
        if name == "touched":
            value[untouched] = False
        else:
            value[untouched if name == "shN" else (slice(None), untouched)] = 0
    return gradients


def pair() -> tuple:
    """((model, optimizer) in float64 on the CPU, the same in float32 on the GPU)."""
    sides = []
    for place in (torch.float64, DEVICE):
        gaussians = make_gaussians(COUNT, dtype=torch.float32).map(lambda value, place=place: value.to(place))
        optimizer = DenseAdam(RATES, opacity_reg=0.01, scale_reg=0.01)
        optimizer.setup(gaussians)
        sides.append((gaussians, optimizer))
    return tuple(sides)


def test_dense_adam_is_the_same_on_the_gpu_and_does_not_wait():
    (exact, reference), (gaussians, optimizer) = pair()
    start = clone(exact)
    for seed in range(12):
        gradients = gradients_of(seed)
        reference.step(exact, gradients, STEP)
        gradients = on_device(gradients)
        torch.cuda.synchronize()
        torch.cuda.set_sync_debug_mode("error")
        try:
            optimizer.step(gaussians, gradients, STEP)
        finally:
            torch.cuda.set_sync_debug_mode("default")
    for name, value in gaussians.items():
        moved, wanted = (side - getattr(start, name) for side in (value.double().cpu(), getattr(exact, name)))
        assert (moved - wanted).abs().max() <= 2e-4 * wanted.abs().max(), name


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_mcmc_relocates_what_is_not_finite_or_endless(bad):
    gaussians = make_gaussians(COUNT, dtype=torch.float32).map(lambda value: value.to(DEVICE))
    gaussians.opacities[:] = 1.0
    gaussians.means[3], gaussians.quats[4], gaussians.scales[5], gaussians.scales[6] = bad, bad, bad, 60.0
    density = GsplatMcmcDensity(max_gaussians=COUNT + 7)
    density.setup(gaussians)
    result = density.update(gaussians, Step(600, 5000, 3500)).apply(gaussians)
    assert len(result) == COUNT + 7
    assert all(value.isfinite().all() for _, value in result.items()) and result.scales.max() < 40


SOON = {
    "3dgs": ("density.refine_start_iter=9", "density.refine_every=10"),
    "3dgs-as-shipped": ("density.refine_start_iter=9", "density.refine_every=10"),
    "mcmc": ("density.refine_start_iter=9", "density.refine_every=10", "density.max_gaussians=2000"),
    "fastgs": ("density.refine_from=10", "density.refine_every=10"),
}


@pytest.mark.parametrize("name", SOON)
def test_baselines_train(tmp_path, name):
    length = ("train.iterations=100", "train.refine_until=30", "train.sh_interval=50", "train.device=cuda")
    config = load_config(name, [*length, "train.evaluate_at=[0.5]", *SOON[name]])
    config.scene.path = str(tiny_capture(tmp_path))
    outcome = train(config, tmp_path / "run")
    assert outcome.history[-1].psnr > outcome.history[0].psnr
    assert outcome.history[-1].num_gaussians > outcome.history[0].num_gaussians


def test_a_baseline_waits_for_nothing_between_events(tmp_path):
    scene = load_scene(tiny_capture(tmp_path))
    config = load_config("3dgs", ["train.device=cuda", "density.refine_start_iter=1000"])
    assert_iterations_wait_for_nothing(Trainer(config.without_plan(), scene, torch.device("cuda")))
