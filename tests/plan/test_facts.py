"""The facts of a plan, against captures whose numbers are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from turbogs_plugin.plan import gather_facts
from turbogs_plugin.scene import Scene
from turbogs_plugin.scene.photos import Photos
from turbogs_plugin.types import Cameras

CPU = torch.device("cpu")


def of_views(scene: Scene, viewmats: torch.Tensor) -> Scene:
    """The first views of the scene, with other cameras."""
    count, views = len(viewmats), scene.train
    cameras = Cameras(viewmats, views.cameras.Ks[:count], views.cameras.sizes[:count])
    photos = Photos(views.photos.colors[: count * 40 * 24], views.photos.sizes[:count])
    chosen = replace(views, cameras=cameras, names=views.names[:count], photos=photos, observations=None)
    return replace(scene, train=chosen, test=replace(scene.test, observations=None))


def test_counts_sizes_and_bytes(scene):
    facts = gather_facts(scene, CPU, memory_limit=5)
    assert facts.train_views == 7
    assert (facts.photo_bytes, facts.map_bytes) == (3 * 8 * 40 * 24, 4 * 7 * 40 * 24)
    assert (facts.device, facts.device_bytes) == ("cpu", 5) and facts.host_bytes > 5


@pytest.mark.parametrize("tilt", [0.0, 30.0, 90.0])
def test_concentration_of_view_directions(scene, tilt):
    viewmats, cosine, sine = torch.eye(4).repeat(2, 1, 1), np.cos(np.radians(tilt)), np.sin(np.radians(tilt))
    for viewmat, sign in zip(viewmats, (1, -1), strict=True):
        viewmat[:3, :3] = torch.tensor([[cosine, 0, -sign * sine], [0, 1, 0], [sign * sine, 0, cosine]])
    assert gather_facts(of_views(scene, viewmats), CPU).direction_concentration == pytest.approx(cosine, abs=1e-6)


@pytest.mark.parametrize(("near", "far", "expected"), [(0.5, 0, 0.5), (0.5, 10, 0.5), (0.5, 30, 7), (3.5, 30, 2)])
def test_one_point_in_a_hundred_lies_further_away(scene, near, far, expected):
    distances = torch.tensor([7.0] * far + [near] * (1000 - far)) * scene.extent
    points = scene.train.cameras.centers.mean(dim=0) + torch.eye(3)[2] * distances[:, None]
    assert gather_facts(replace(scene, points=points), CPU).far_points == pytest.approx(expected, rel=0.2)
    assert gather_facts(replace(scene, points=points, drawn_points=True), CPU).far_points == 0.0


@pytest.mark.parametrize("points", [[], [[0.0, 0.0, 100.0]]], ids=["none", "unseen"])
@pytest.mark.parametrize("views", [1, 4])
def test_points_that_no_camera_sees_and_a_single_view_decide_nothing(scene, points, views):
    given = replace(of_views(scene, scene.train.cameras.viewmats[:views]), points=torch.tensor(points).reshape(-1, 3))
    gains = gather_facts(given, CPU, with_exposures=True).gains
    assert not gains.compared.any() and (gains.spread, gains.rest) == (0.0, 0.0)
