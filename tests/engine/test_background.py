"""A background behind the model: colours and gradients against plain arithmetic, in the reference."""

import pytest
import torch
from helpers.rendering_scenes import make_cameras, make_gaussians, thin_out

from turbogs_plugin.engine.render import dense_samples, rasterize, render_image
from turbogs_plugin.gsplat_bridge.autograd import rasterize_differentiable
from turbogs_plugin.types import PARAMETER_NAMES

SIZES = [(37, 29), (20, 50)]
COLOR = (0.9, 0.25, 0.5)


@pytest.fixture(scope="module")
def case():
    cameras = make_cameras(SIZES)
    return make_gaussians(40), cameras, thin_out(dense_samples(cameras), 0.3, empty_slots=2)


def test_colors_are_over_the_background(case):
    plain, shown = rasterize(*case), rasterize(*case, background=COLOR)
    assert torch.equal(plain.alphas, shown.alphas)
    expected = plain.colors + (1 - plain.alphas[:, None]) * torch.tensor(COLOR, dtype=torch.float64)
    torch.testing.assert_close(shown.colors, expected, rtol=0, atol=1e-15)
    empty = shown.colors[~case[2].filled].unique(dim=0)
    torch.testing.assert_close(empty, torch.tensor([COLOR], dtype=torch.float64))
    gaussians, cameras, _ = case
    images = [render_image(gaussians, cameras, 1, **options) for options in ({}, {"background": COLOR})]
    assert images[1].colors.amin() > images[0].colors.amin()


def test_gradients_are_those_of_the_sum_written_out(case):
    """To opacities, places and colours, with gradients of alphas and depths beside them."""
    gaussians, cameras, samples = case
    generator = torch.Generator().manual_seed(0)
    weights = torch.randn(len(samples), 3, generator=generator, dtype=torch.float64) * samples.filled[:, None]
    of_alphas, of_depths = torch.randn(2, len(samples), generator=generator, dtype=torch.float64) * samples.filled

    def gradients(written_out: bool):
        leaves = gaussians.map(lambda value: value.clone().requires_grad_())
        options = {} if written_out else {"background": COLOR}
        output = rasterize_differentiable(leaves, cameras, samples, with_depth=True, **options)
        colors = output.colors
        if written_out:
            colors = colors + (1 - output.alphas[:, None]) * torch.tensor(COLOR, dtype=torch.float64)
        loss = (colors * weights).sum() + (output.alphas * of_alphas).sum() + (output.depths * of_depths).sum()
        loss.backward()
        return leaves

    found, expected = gradients(False), gradients(True)
    for name in PARAMETER_NAMES:
        torch.testing.assert_close(getattr(found, name).grad, getattr(expected, name).grad, rtol=1e-9, atol=1e-12)
    assert expected.opacities.grad.abs().max() > 1e-3
