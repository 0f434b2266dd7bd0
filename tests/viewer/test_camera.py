"""Cameras of clients: what is taken, what is refused, and that they are the cameras that they say."""

import math

import numpy as np
import pytest
import torch

from turbogs_plugin.types import Cameras
from turbogs_plugin.viewer.camera import FOV_LIMITS, LARGEST_SIDE, SMALLEST_SIDE, ViewerCamera

GOOD = {"position": (1.0, 2.0, 3.0), "wxyz": (2.0, 0.0, 0.0, 0.0), "fov": 1.0, "width": 640, "height": 480}


BAD = [{"position": place} for place in ((math.nan, 0, 0), (1e30, 0, 0), (0, 0))]
BAD += [{"wxyz": (0, 0, 0, 0)}, {"wxyz": (1e300, 1e300, 0, 0)}, {"fov": -1}, {"width": 0}]


def test_a_sound_camera_is_taken_with_a_unit_quaternion_and_others_are_refused():
    assert ViewerCamera.checked(**GOOD) == ViewerCamera((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0), 1.0, 640, 480)
    assert [ViewerCamera.checked(**(GOOD | bad)) for bad in BAD] == [None] * len(BAD)


def test_sizes_and_angles_are_brought_within_limits():
    huge = ViewerCamera.checked(**(GOOD | {"width": 10**9, "height": 5 * 10**8, "fov": 100.0}))
    assert (huge.width, huge.height, huge.fov) == (LARGEST_SIDE, LARGEST_SIDE // 2, FOV_LIMITS[1])
    thin = ViewerCamera.checked(**(GOOD | {"width": 10**6, "height": 1}))
    assert (thin.width, thin.height) == (LARGEST_SIDE, SMALLEST_SIDE)
    small = ViewerCamera.checked(**GOOD).with_at_most(160 * 120)
    assert (small.width, small.height) == (160, 120)


def test_the_camera_of_a_view_is_that_of_the_capture(scene):
    cameras = scene.train.cameras
    for view in range(len(cameras)):
        found = ViewerCamera.of_view(cameras, view).cameras(torch.device("cpu"))
        torch.testing.assert_close(found.viewmats[0], cameras.viewmats[view], atol=1e-5, rtol=0)
        assert found.Ks[0, 1, 1].item() == pytest.approx(cameras.Ks[view, 1, 1].item(), rel=1e-5)
        assert np.array_equal(found.sizes[0], cameras.sizes[view])


def test_the_angle_of_a_view_is_vertical_where_pixels_are_not_square():
    K = torch.tensor([[[300.0, 0.0, 32.0], [0.0, 200.0, 24.0], [0.0, 0.0, 1.0]]])
    camera = ViewerCamera.of_view(Cameras(torch.eye(4)[None], K, np.array([[64, 48]])), 0)
    assert camera.fov == pytest.approx(2 * math.atan(48 / (2 * 200)))
