"""Points for the empty cells of photos: where they lie, what they show, and where there are none."""

import numpy as np
import pytest
import torch
from helpers.framework_runs import tiny_config

from turbogs_plugin.masks import PixelMasks
from turbogs_plugin.scene import load_scene
from turbogs_plugin.scene.filled_points import REACH, filled_points
from turbogs_plugin.scene.photos import Photos
from turbogs_plugin.train.initial_state import initial_gaussians
from turbogs_plugin.types import Cameras

WIDTH, HEIGHT, CELLS = 64, 48, 16
SIDE = WIDTH / CELLS
NORMAL, OFFSET = np.array([0.2, -0.3, 1.0]), 4.0
"""A plane before the cameras: normal . x = offset."""


def cameras(count: int = 2) -> Cameras:
    """Beside each other, looking along z."""
    viewmats = torch.eye(4).repeat(count, 1, 1)
    viewmats[:, 0, 3] = -0.4 * torch.arange(count)
    K = torch.tensor([[50.0, 0.0, WIDTH / 2], [0.0, 50.0, HEIGHT / 2], [0.0, 0.0, 1.0]])
    return Cameras(viewmats, K.repeat(count, 1, 1), np.tile([WIDTH, HEIGHT], (count, 1)))


def photos(count: int = 2, channels: int = 3) -> Photos:
    """Whose pixels tell their place: x, y, the view, and an alpha of 255."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    images = [np.stack([x, y, np.full_like(x, view), np.full_like(x, 255)], axis=-1) for view in range(count)]
    colors = np.concatenate(images).reshape(-1, 4)[:, :channels].astype(np.uint8)
    return Photos(torch.from_numpy(colors), np.tile([WIDTH, HEIGHT], (count, 1)))


def on_plane(columns: range, rows: range = range(HEIGHT // 4)) -> torch.Tensor:
    """Points of the plane in the middles of some cells of the first view."""
    x, y = np.meshgrid((np.array(columns) + 0.5) * SIDE, (np.array(rows) + 0.5) * SIDE)
    rays = np.column_stack([(x.ravel() - WIDTH / 2) / 50, (y.ravel() - HEIGHT / 2) / 50, np.ones(x.size)])
    return torch.from_numpy(rays * (OFFSET / (rays @ NORMAL))[:, None]).float()


def places(points: torch.Tensor, view: int) -> tuple[np.ndarray, np.ndarray]:
    """[F, 2] pixels and [F] bool, which lie in the image."""
    camera = cameras()
    in_camera = points @ camera.viewmats[view, :3, :3].T + camera.viewmats[view, :3, 3]
    x, y = ((in_camera @ camera.Ks[view].T)[:, :2] / in_camera[:, 2:]).numpy().T
    return np.column_stack([x, y]), (x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT)


def test_a_plane_goes_on():
    known = on_plane(range(11))
    found, colors = filled_points(known, cameras(1), photos(1), CELLS)
    assert found.dtype == torch.float32 and colors.dtype == torch.uint8 and len(found) == len(colors) == 5 * 12
    np.testing.assert_allclose(found.numpy() @ NORMAL, OFFSET, rtol=2e-3)
    pixels, inside = places(found, 0)
    assert inside.all()
    np.testing.assert_allclose(colors[:, :2].numpy(), pixels, atol=1.0)


def test_cells_that_are_near_enough_are_filled_and_what_one_photo_got_counts_for_the_next():
    known = on_plane(range(4))
    found, colors = filled_points(known, cameras(), photos(), CELLS)
    columns = (places(found, 0)[0][:, 0] // SIDE).astype(int)
    assert set(columns[(colors[:, 2] == 0).numpy()]) == set(range(4, 3 + REACH))
    first = filled_points(known, cameras(1), photos(1), CELLS)[0]
    assert torch.equal(found[: len(first)], first) and (colors[: len(first), 2] == 0).all()
    # The second photo shows the plane five pixels farther left; it goes on where the first one ended.
    assert len(found) > len(first) and (colors[len(first) :, 2] == 1).all()
    columns = [places(points, 1)[0][:, 0] // SIDE for points in (first, found[len(first) :])]
    assert columns[0].max() < columns[1].min()


def test_masked_and_transparent_pixels_get_none():
    known, keep = on_plane(range(8)), np.ones((HEIGHT, WIDTH), dtype=bool)
    keep[:, 44:] = False
    masks = PixelMasks.from_images([torch.from_numpy(keep)])
    masked, _ = filled_points(known, cameras(1), photos(1), CELLS, masks)
    transparent = photos(1, channels=4)
    transparent.colors.view(HEIGHT, WIDTH, 4)[:, 44:, 3] = 10
    seen_through, colors = filled_points(known, cameras(1), transparent, CELLS)
    assert torch.equal(masked, seen_through) and colors.shape[1] == 3
    assert 0 < len(masked) < len(filled_points(known, cameras(1), photos(1), CELLS)[0])
    assert places(masked, 0)[0][:, 0].max() < 44


@pytest.mark.parametrize("known", [torch.zeros(0, 3), torch.tensor([[0.0, 0.0, -1.0]]), on_plane(range(1), range(1))])
def test_where_there_is_nothing_to_go_by_nothing_is_added(known):
    found, colors = filled_points(known, cameras(), photos(), CELLS)
    assert found.shape == colors.shape == (0, 3)


@pytest.mark.parametrize("columns", [range(1), range(3, 4)])
def test_cells_in_one_line_suggest_depths_of_their_own(columns):
    """A plane through them may lean any way; what they suggest is within a quarter of what they have."""
    known = on_plane(columns)
    found, _ = filled_points(known, cameras(1), photos(1), CELLS)
    depths = known[:, 2]
    assert len(found) and found[:, 2].min() >= depths.min() / 1.2501 and found[:, 2].max() <= depths.max() * 1.2501


def test_of_surfaces_behind_each_other_the_near_one_is_gone_on_with():
    near = on_plane(range(8))
    far = 5 * near
    found, _ = filled_points(torch.cat([far, near]), cameras(1), photos(1), CELLS)
    np.testing.assert_allclose(found.numpy() @ NORMAL, OFFSET, rtol=2e-3)


def test_extreme_points_are_no_trouble():
    known = torch.cat([on_plane(range(6)), torch.tensor([[1e30, 0.0, 1e30], [0.0, 0.0, 1e-30], [0.0, 0.0, 0.0]])])
    found, _ = filled_points(known, cameras(), photos(), CELLS)
    assert found.isfinite().all() and len(found)


def test_training_starts_with_them_where_it_is_asked_for(capture):
    scene, sizes = load_scene(capture), []
    for cells in (0, 12):
        config = tiny_config(capture, f"train.point_cells={cells}").without_plan()
        gaussians = initial_gaussians(scene, config, "points", torch.device("cpu"))
        sizes.append(len(gaussians))
        assert torch.equal(gaussians.means[: len(scene.points)], scene.points)
    assert sizes[0] == len(scene.points) < sizes[1]
    scene.drawn_points = True
    assert len(initial_gaussians(scene, config, "points", torch.device("cpu"))) == sizes[0]
