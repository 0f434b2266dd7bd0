"""The Gaussians that training starts from."""

import math

import pytest
import torch
from helpers.models import random_gaussians

from turbogs_plugin.errors import InputError
from turbogs_plugin.model.initial import BACKDROP_RADIUS, backdrop_gaussians, gaussians_from_points, with_degree
from turbogs_plugin.types import SH_C0


def test_initial_gaussians():
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
    colors = torch.tensor([[255, 0, 51]] * 4, dtype=torch.uint8)
    gaussians = gaussians_from_points(points, colors, sh_degree=2, extent=1.0)
    assert torch.equal(gaussians.means, points)
    assert gaussians.scales[0].exp().tolist() == pytest.approx([2.0] * 3)
    assert gaussians.scales[1].exp().tolist() == pytest.approx([(1 + 5**0.5 + 10**0.5) / 3] * 3)
    assert gaussians.opacities.sigmoid().tolist() == pytest.approx([0.1] * 4)
    assert gaussians.quats.tolist() == [[1, 0, 0, 0]] * 4
    color = gaussians.sh0[0, 0] * 0.5 / math.sqrt(math.pi) + 0.5
    assert color.tolist() == pytest.approx([1, 0.5 / 255, 0.2], abs=1e-6)
    assert gaussians.shN.shape == (4, 8, 3) and not gaussians.shN.any()
    assert all(value.dtype == torch.float32 for _, value in gaussians.items())


def test_other_starts():
    """gsplat's MCMC preset begins with opacities of 0.5 and a tenth of the scales."""
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(1))
    colors = torch.zeros(50, 3, dtype=torch.uint8)
    plain = gaussians_from_points(points, colors, 1, 1.0)
    small = gaussians_from_points(points, colors, 1, 1.0, opacity=0.5, size=0.1)
    torch.testing.assert_close(small.scales, plain.scales - math.log(10))
    torch.testing.assert_close(torch.sigmoid(small.opacities), torch.full((50,), 0.5))


def test_coincident_points_get_a_scale_and_no_points_are_refused():
    same = gaussians_from_points(torch.ones(5, 3), torch.zeros(5, 3, dtype=torch.uint8), sh_degree=0, extent=2.0)
    assert same.scales.exp().flatten().tolist() == pytest.approx([2e-4] * 15) and same.shN.shape == (5, 0, 3)
    with pytest.raises(InputError, match="too few points"):
        gaussians_from_points(torch.zeros(1, 3), torch.zeros(1, 3, dtype=torch.uint8), 3, 1.0)


def test_a_backdrop_surrounds_everything_in_its_colour():
    backdrop = backdrop_gaussians(torch.tensor([0.2, 0.4, 0.6]), sh_degree=2, extent=3.0)
    assert torch.allclose(backdrop.means.norm(dim=1), torch.tensor(BACKDROP_RADIUS * 3.0))
    colors = backdrop.sh0[:, 0] * SH_C0 + 0.5
    assert torch.allclose(colors, torch.tensor([51.0, 102.0, 153.0]) / 255.0, atol=1e-6)
    assert backdrop.shN.shape[1] == 8
    directions = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    # Whatever the direction, the nearest Gaussian's centre is within one standard deviation.
    nearest = torch.cdist(directions * BACKDROP_RADIUS * 3.0, backdrop.means).amin(dim=1)
    assert (nearest < backdrop.scales.exp().amin()).all()


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_bands_are_dropped_or_added_as_zeros(degree):
    gaussians = random_gaussians(sh_degree=2)
    bands, kept = (degree + 1) ** 2 - 1, min(8, (degree + 1) ** 2 - 1)
    made = with_degree(gaussians, degree).shN
    assert made.shape[1] == bands and torch.equal(made[:, :kept], gaussians.shN[:, :kept]) and not made[:, kept:].any()
