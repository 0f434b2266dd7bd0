"""The kernels on the worst inputs of tests/stability."""

import itertools
import math

import pytest
import torch
from helpers.framework_runs import tiny_capture, tiny_config
from helpers.raster_cases import FORWARD_BOUND, GPU_ONLY, GRADIENT_BOUND
from helpers.raster_extremes import CASES, TWO_VIEWS, assert_within, compare, random_scene
from helpers.tolerances import TOLERANCES, Tolerance

from turbogs_plugin.engine.render import dense_samples, rasterize
from turbogs_plugin.train.run import train
from turbogs_plugin.train.saved_model import load_model
from turbogs_plugin.types import PARAMETER_NAMES, GaussianStats

pytestmark = GPU_ONLY


@pytest.mark.parametrize("case", CASES)
def test_kernels_are_close_to_float64(case):
    """The kernels use the hardware's exponential, so their bound is that of the rasterizer's own tests."""
    single = TOLERANCES[torch.float32]
    needles = 5 * FORWARD_BOUND, max(single.needle_gradient, 5 * GRADIENT_BOUND)
    bounds = Tolerance(FORWARD_BOUND, needles[0], GRADIENT_BOUND, needles[1])
    error, errors = compare(case, torch.float32, "cuda")
    assert_within(case, error, errors, bounds)


@pytest.mark.parametrize("size", [-200.0, -20.0, 9.0, 20.0, 88.0, 200.0])
def test_any_gaussian_among_ordinary_ones_stays_finite(size):
    """Wherever it is, and whatever the length of its quaternion."""
    cameras = TWO_VIEWS.to("cuda")
    samples = dense_samples(cameras)
    places, norms = [0.0, 1e-30, 4.0, 1e6, 1e18, 3e38], [0.0, 1e-38, 1.0, 1e37]
    for place, norm in itertools.product(places, norms):
        gaussians = random_scene(8)
        gaussians.scales[3] = torch.tensor([size, -2.0, -20.0])
        gaussians.means[3] = torch.tensor([0.0, place, -place if place < 1e3 else 0.0])
        gaussians.quats[3] *= norm
        gaussians, stats = gaussians.map(lambda value: value.cuda()), GaussianStats.zeros(len(gaussians), "cuda")
        rendered = rasterize(gaussians, cameras, samples)
        ones = torch.ones_like(rendered.alphas)
        screen = rendered.backward(torch.ones_like(rendered.colors), ones, with_statistics=True)
        gradients = screen.parameter_gradients(True, stats)
        case = f"at {place}, quaternion of length {norm}"
        assert rendered.colors.isfinite().all() and rendered.alphas.isfinite().all(), case
        assert all(value.isfinite().all() for value in (*vars(gradients).values(), *vars(stats).values())), case
        for name in PARAMETER_NAMES[:-1]:
            assert (getattr(gradients, name)[:, ~gradients.touched] == 0).all(), f"{name}, {case}"


@pytest.mark.parametrize("factor", [100, 1e4])
def test_learning_rates_far_too_large(tmp_path, factor):
    """The model is useless, but finite to the end, as by the reference (tests/stability/test_training.py)."""
    rates = f"optimizer.learning_rates.batch_scale={2 * factor}"
    config = tiny_config(tiny_capture(tmp_path), rates, "train.device=cuda", "density.max_gaussians=3000")
    outcome = train(config, tmp_path / "run")
    assert outcome.history[-1].iteration == config.train.iterations
    assert all(math.isfinite(evaluation.psnr) for evaluation in outcome.history)
    trained = load_model(tmp_path / "run", torch.device("cpu")).gaussians
    assert len(trained) > 0 and all(value.isfinite().all() for _, value in trained.items())
