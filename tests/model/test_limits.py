"""The space around training cameras that is kept free, against plain distances; the size of what is far away."""

import numpy as np
import pytest
import torch
from helpers.models import random_gaussians

from turbogs_plugin.engine.render import render_image
from turbogs_plugin.model import limits
from turbogs_plugin.model.limits import DISTANT, POINTS, RARE, SHARE, Clearance, restrain_distant
from turbogs_plugin.types import Cameras, RowUpdate

CENTERS = torch.tensor([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0]])


def points_around(center, distance, count, seed=0):
    directions = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed))
    return torch.tensor(center) + distance * directions / directions.norm(dim=1, keepdim=True)


def unchanged(gaussians):
    return RowUpdate(torch.arange(len(gaussians)), torch.zeros(len(gaussians), dtype=torch.bool), {})


def test_a_camera_near_its_points_has_a_smaller_sphere():
    points = torch.cat([points_around([0.0, 0.0, 0.0], 0.2, 30), points_around([4.0, 0.0, 0.0], 1.0, 3000)])
    radii = Clearance.of(points, CENTERS).radii
    # 30 of 3030 points lie nearer than any other: that is more than RARE, so 0.2 is what points commonly have.
    assert radii.tolist() == pytest.approx([SHARE * 0.2, 0.2])


def test_single_points_count_neither_for_a_camera_nor_for_all():
    few = POINTS - 1
    points = torch.cat([points_around([0.0, 0.0, 0.0], 0.01, few), points_around([0.0, 0.0, 0.0], 1.0, 10_000)])
    assert few < RARE * len(points)
    radii = Clearance.of(points, CENTERS).radii
    assert radii[0].item() == pytest.approx(SHARE)
    assert radii[1].item() == pytest.approx(1.0, rel=1e-5)  # farther from every point than from 0.9 of its own


def test_pieces_change_nothing_and_too_few_points_say_nothing(monkeypatch):
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(1)) * 4
    gaussians, made = random_gaussians(300), []
    for at_once in (limits.DISTANCES_AT_ONCE, 14):
        monkeypatch.setattr(limits, "DISTANCES_AT_ONCE", at_once)
        made.append(Clearance.of(points, CENTERS))
        made.append(made[-1].clear(unchanged(gaussians), gaussians).source)
    assert torch.equal(made[0].radii, made[2].radii) and torch.equal(made[1], made[3]) and 0 < len(made[1]) < 300
    assert Clearance.of(torch.zeros(POINTS - 1, 3), CENTERS) is None


def test_rows_in_a_sphere_are_taken_out_of_a_change():
    gaussians = random_gaussians(6)
    gaussians.means[:] = torch.tensor([[0.05, 0, 0], [0.3, 0, 0], [3.7, 0, 0], [4.3, 0, 0], [9.0, 0, 0], [9.0, 1, 0]])
    spheres = Clearance(CENTERS, torch.tensor([0.2, 0.4]))
    moved = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0], [4.1, 0, 0], [9.0, 0, 0], [9.0, 1, 0], [5.0, 0, 0]])
    sizes = torch.arange(21.0).view(7, 3)
    source, fresh = torch.tensor([0, 1, 2, 3, 4, 5, 5]), torch.tensor([0, 0, 0, 0, 0, 0, 1]).bool()
    cleared = spheres.clear(RowUpdate(source, fresh, {"means": moved, "scales": sizes}, num_pruned=4), gaussians)
    kept = [1, 2, 4, 5, 6]  # by where the rows are after the change
    assert cleared.source.tolist() == [1, 2, 4, 5, 5] and cleared.fresh.tolist() == [0, 0, 0, 0, 1]
    assert torch.equal(cleared.values["means"], moved[kept]) and torch.equal(cleared.values["scales"], sizes[kept])
    assert cleared.num_pruned == 4 + 2
    without_values = spheres.clear(unchanged(gaussians), gaussians)
    assert without_values.source.tolist() == [1, 4, 5] and without_values.num_pruned == 3


def test_a_change_without_rows_in_a_sphere_is_returned_as_it_is():
    """Means that are not finite are left to others."""
    gaussians, spheres = random_gaussians(5), Clearance(CENTERS, torch.ones(2))
    gaussians.means += 100.0
    gaussians.means[:2] = torch.tensor([[torch.nan, 0, 0], [torch.inf, 0, 0]])
    for update in (unchanged(gaussians), unchanged(random_gaussians(0))):
        assert spheres.clear(update, gaussians) is update


def test_distant_gaussians_are_restrained_and_the_scene_is_not():
    gaussians = random_gaussians(60)
    gaussians.means *= torch.linspace(0.1, 30.0, 60)[:, None]
    gaussians.scales += 3.0
    before = gaussians.scales.clone()
    restrain_distant(gaussians, extent=2.0, size=0.3)
    distances = gaussians.means.norm(dim=1, keepdim=True)
    bounds = torch.where(distances > DISTANT * 2.0, (0.3 * (distances - 2.0)).log(), torch.inf)
    assert torch.equal(gaussians.scales, torch.minimum(before, bounds))
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
