"""Models in other coordinates: the same pictures from cameras that moved along."""

import math

import numpy as np
import pytest
import torch
from helpers.models import random_gaussians

from turbogs_plugin.engine.render import render_image
from turbogs_plugin.model.similarity import Similarity
from turbogs_plugin.scene.geometry import look_at
from turbogs_plugin.types import Cameras

AXIS_ANGLES = [(0.3, -1.2, 2.1), (math.pi, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, math.pi / 2, 0.0)]


def rotation_of(axis_angle: tuple[float, float, float]) -> np.ndarray:
    x, y, z = axis_angle
    cross = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
    return torch.linalg.matrix_exp(cross).numpy()


@pytest.mark.parametrize("axis_angle", AXIS_ANGLES)
@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_a_moved_model_looks_the_same_from_moved_cameras(axis_angle, sh_degree):
    gaussians = random_gaussians(60, sh_degree).map(torch.Tensor.double)
    gaussians.scales -= 1.5
    change = Similarity(rotation_of(axis_angle), 1.7, np.array([3.0, -2.0, 0.5]))
    viewmat = look_at(np.array([1.0, -4.0, 2.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    moved = change.apply_to_poses(viewmat[None])[0]  # camera coordinates grow with the world
    intrinsics = torch.tensor([[40.0, 0.0, 24.0], [0.0, 40.0, 20.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    images = []
    for model, pose in ((gaussians, viewmat), (change.apply(gaussians), moved)):
        camera = Cameras(torch.from_numpy(pose)[None], intrinsics[None], np.array([[48, 40]]))
        images.append(render_image(model, camera, sh_degree=sh_degree).colors)
    assert images[0].std() > 0.1
    assert (images[0] - images[1]).abs().max() < 1e-5


def test_changes_follow_one_another_and_are_undone():
    first = Similarity(rotation_of((0.3, -1.2, 2.1)), 0.4, np.array([3.0, -2.0, 0.5]))
    second = Similarity(rotation_of((-0.9, 0.1, 0.2)), 5.0, np.array([0.0, 1.0, 7.0]))
    gaussians = random_gaussians().map(torch.Tensor.double)
    together, in_turn = second.after(first).apply(gaussians), second.apply(first.apply(gaussians))
    undone = first.inverse().apply(first.apply(gaussians))
    for name, value in gaussians.items():
        if name != "quats":  # a quaternion and its negative are one rotation
            torch.testing.assert_close(getattr(together, name), getattr(in_turn, name))
            torch.testing.assert_close(getattr(undone, name), value)
    alignment = torch.nn.functional.cosine_similarity(undone.quats, gaussians.quats).abs()
    torch.testing.assert_close(alignment, torch.ones_like(alignment))
