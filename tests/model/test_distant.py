"""The bound on the size of what is far away."""

import numpy as np
import pytest
import torch
from helpers.models import random_gaussians

from turbogs_plugin.engine.rendering import render_image
from turbogs_plugin.model.distant import DISTANT, restrain_distant
from turbogs_plugin.types import Cameras


def test_distant_gaussians_are_restrained_and_the_scene_is_not():
    gaussians = random_gaussians(60)
    gaussians.means *= torch.linspace(0.1, 30.0, 60)[:, None]
    gaussians.scales += 3.0
    before = gaussians.scales.clone()
    restrain_distant(gaussians, extent=2.0, size=0.3)
    distances = gaussians.means.norm(dim=1, keepdim=True)
    limits = torch.where(distances > DISTANT * 2.0, (0.3 * (distances - 2.0)).log(), torch.inf)
    assert torch.equal(gaussians.scales, torch.minimum(before, limits))
    assert 0 < (before > gaussians.scales).sum() < before.numel()
    assert (distances < DISTANT * 2.0).any()


@pytest.mark.parametrize("depth", [0.05, 0.6, 2.0])
def test_what_lies_beside_a_camera_covers_none_of_its_view(depth):
    """As it did on caliterra: deviations of 32 and 45 at a distance of 25, 0.6 in front of the camera's plane."""
    gaussians = random_gaussians(1, sh_degree=0)
    gaussians.means[0], gaussians.quats[0] = torch.tensor([25.0, 0.0, depth]), torch.tensor([1.0, 0.0, 0.0, 0.0])
    gaussians.scales[0], gaussians.opacities[0] = torch.tensor([45.0, 32.0, 0.4]).log(), 10.0
    camera = Cameras(torch.eye(4)[None], torch.tensor([[[80.0, 0, 48], [0, 80, 32], [0, 0, 1]]]), np.array([[96, 64]]))
    assert render_image(gaussians, camera).alphas[32, 48] > 0.8
    restrain_distant(gaussians, extent=1.0, size=0.3)
    assert render_image(gaussians, camera).alphas[32, 48] < 0.01
