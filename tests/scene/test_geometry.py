"""Poses, where a camera stands and what it looks at, and distances to the nearest points."""

import math

import numpy as np
import pytest
import torch

from turbogs_plugin.engine.reference.projection import rotation_matrices
from turbogs_plugin.scene.frame import Frame
from turbogs_plugin.scene.geometry import camera_centers, look_at, mean_neighbor_distances, quaternions, viewmat_of_pose


def test_a_camera_looks_at_its_target_with_up_upwards():
    center, target, up = np.array([3.0, -2.0, 1.5]), np.array([0.5, 0.25, -1.0]), np.array([0.0, 0.0, 1.0])
    viewmat = look_at(center, target, up)
    np.testing.assert_allclose(camera_centers(viewmat[None]), [center], atol=1e-12)
    np.testing.assert_allclose(viewmat[:3, :3] @ viewmat[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(viewmat[:3, :3]) > 0
    ahead, above = (viewmat[:3, :3] @ point + viewmat[:3, 3] for point in (target, target + 0.1 * up))
    np.testing.assert_allclose(ahead, [0.0, 0.0, np.linalg.norm(target - center)], atol=1e-12)
    assert abs(above[0]) < 1e-12 and above[1] < 0  # y points down


def test_a_pose_whose_decimals_were_cut_has_an_exact_rotation():
    exact = look_at(np.array([1.0, -2.0, 0.5]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    viewmat = viewmat_of_pose(np.round(exact[:3, :3].T, 3), np.array([1.0, -2.0, 0.5]))
    np.testing.assert_allclose(viewmat[:3, :3] @ viewmat[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(viewmat, exact, atol=3e-3)
    np.testing.assert_allclose(camera_centers(viewmat[None])[0], [1.0, -2.0, 0.5], atol=1e-12)


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.6, -0.48, 0.64)])
@pytest.mark.parametrize("angle", [0.0, 1.0, math.pi, 4.0])
def test_quaternions_go_to_rotations_and_back(axis, angle):
    wxyz = np.array([math.cos(angle / 2), *(math.sin(angle / 2) * np.array(axis))])
    rotation = rotation_matrices(torch.from_numpy(wxyz)).numpy()
    np.testing.assert_allclose(rotation @ np.array(axis), axis, atol=1e-12)
    again = rotation_matrices(torch.from_numpy(quaternions(rotation[None])))[0]
    np.testing.assert_allclose(again, rotation, atol=1e-12)
    assert np.trace(rotation) == pytest.approx(1 + 2 * math.cos(angle))


CLOUDS = {
    "heavy tails": lambda random: random.normal(size=(1500, 3)) ** 5,
    "clusters": lambda random: random.integers(0, 5, (1500, 1)) * 100 + random.normal(size=(1500, 3)) * 1e-2,
    "coincident": lambda random: np.repeat(random.normal(size=(300, 3)), 5, axis=0),
    "two": lambda random: random.normal(size=(2, 3)),
}


@pytest.mark.parametrize("cloud", CLOUDS)
def test_neighbor_distances_are_exact(cloud):
    points = CLOUDS[cloud](np.random.default_rng(0))
    distances = np.linalg.norm(points[:, None] - points[None], axis=-1)
    np.fill_diagonal(distances, np.inf)
    neighbors = min(3, len(points) - 1)
    expected = np.sort(distances, axis=1)[:, :neighbors].mean(axis=1)
    np.testing.assert_allclose(mean_neighbor_distances(torch.from_numpy(points), 3), expected, rtol=1e-12, atol=1e-14)


def test_the_frame_of_cameras_that_turn_on_the_spot_is_by_the_points():
    centers, points = np.full((4, 3), [1.0, 0.0, 0.0]) + 1e-12 * np.eye(4, 3), np.full((5, 3), [1.0, 0.0, 7.0])
    assert Frame.around(centers, points).scale == pytest.approx(1.1 * 7.0)
    assert Frame.around(centers + 4.0 * np.eye(4, 3), points).scale > 1.1
