"""Random points: where they are drawn, and their colours, which are those of the photos."""

import numpy as np
import pytest
import torch

from turbogs_plugin.captures.starting_points import colors_in_photos, starting_points
from turbogs_plugin.masks import PixelMasks
from turbogs_plugin.scene.photos import Photos
from turbogs_plugin.types import Cameras

VIEWS, SIZE, FOCAL = 24, (80, 60), 60.0
TURNS = 2 * np.pi * np.arange(VIEWS) / VIEWS
AROUND = np.stack([np.sin(TURNS), 0 * TURNS, np.cos(TURNS)], axis=1)
"""[V, 3], a ring of radius 1 about the origin, y up."""
QUARTER = np.linspace(0, np.pi / 2, VIEWS)
LINE = np.arange(VIEWS)[:, None] * np.array([1.0, 0.0, 0.0])


def cameras_of(centers: np.ndarray, forwards: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """World-to-camera matrices, intrinsics and sizes."""
    down = np.array([0.0, -1.0, 0.0])
    poses = np.tile(np.eye(4), (len(centers), 1, 1))
    poses[:, :3] = np.stack([np.cross(down, forwards), 0 * forwards + down, forwards, centers], axis=2)
    viewmats = np.linalg.inv(poses)
    K = np.array([[FOCAL, 0, SIZE[0] / 2], [0, FOCAL, SIZE[1] / 2], [0, 0, 1]])
    return viewmats, np.tile(K, (len(viewmats), 1, 1)), np.tile(SIZE, (len(viewmats), 1))


def shares_with_points(points: np.ndarray, viewmats: np.ndarray, Ks: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """[V]: share of the 8x6 cells of each view's image that have a point in them."""
    local = points @ viewmats[:, :3, :3].swapaxes(1, 2) + viewmats[:, None, :3, 3]
    pixels = local @ Ks.swapaxes(1, 2)
    cells = np.floor(pixels[..., :2] / pixels[..., 2:] / sizes[:, None] * [8, 6])
    seen = (pixels[..., 2] > 0) & (cells >= 0).all(axis=2) & (cells < [8, 6]).all(axis=2)
    return np.array([len(np.unique(own[inside], axis=0)) / 48 for own, inside in zip(cells, seen, strict=True)])


@pytest.mark.parametrize(
    "cameras",
    [
        cameras_of(AROUND, AROUND),
        cameras_of(LINE, np.stack([np.sin(QUARTER), 0 * QUARTER, np.cos(QUARTER)], axis=1)),
        cameras_of(AROUND, np.where(np.arange(VIEWS)[:, None] % 2, 1, -1) * AROUND),
        cameras_of(AROUND + np.array([5e5, 100, 5e6]), AROUND),
        cameras_of(np.repeat(LINE, 4, axis=0), np.tile(AROUND[::6], (VIEWS, 1))),  # a rig of four in each place
        cameras_of(0 * AROUND, AROUND),
    ],
    ids=["outward ring", "turning line", "inward and outward", "far from the origin", "rig", "on the spot"],
)
def test_every_view_has_points(cameras):
    points, said = starting_points(*cameras)
    assert len(points) == 50_000 and said == "before the cameras, which do not look at one thing"
    assert shares_with_points(points[::5], *cameras).min() > 0.5
    np.testing.assert_array_equal(points, starting_points(*cameras)[0])


def test_where_views_look_at_one_thing_points_fill_a_cube_about_it():
    center = np.array([3.0, -2.0, 5.0])
    points, said = starting_points(*cameras_of(center + AROUND, -AROUND))
    assert said == "about what the cameras look at"
    np.testing.assert_allclose([points.min(axis=0), points.max(axis=0)], [center - 0.5, center + 0.5], atol=1e-3)
    np.testing.assert_allclose(points.mean(axis=0), center, atol=0.01)


def test_depths_follow_extent_and_spacing():
    """Between half the extent of a ring of radius 1 and ten times it; nearer where cameras stand closer."""
    for views, nearest in ((24, 0.5), (600, 0.1)):
        turns = 2 * np.pi * np.arange(views) / views
        ring = np.stack([np.sin(turns), 0 * turns, np.cos(turns)], axis=1)
        points, _ = starting_points(*cameras_of(ring, ring))
        distances = np.linalg.norm(points, axis=1)
        assert 1 + nearest <= distances.min() < 1.05 + nearest and 9 < distances.max() < 1 + 10 / np.cos(0.7)


def two_views() -> tuple[Cameras, Photos]:
    """A 4x2 photo from the origin along z, and a 2x3 one of one colour from z = 10, looking back."""
    viewmats = torch.eye(4).repeat(2, 1, 1)
    viewmats[1, :3, :3], viewmats[1, 2, 3] = torch.diag(torch.tensor([-1.0, 1.0, -1.0])), 10.0
    Ks = torch.tensor([[[2.0, 0, 2], [0, 2, 1], [0, 0, 1]], [[1.0, 0, 1], [0, 1, 1.5], [0, 0, 1]]])
    colors = torch.cat([torch.arange(24).view(8, 3), torch.full((6, 3), 100)]).to(torch.uint8)
    sizes = np.array([[4, 2], [2, 3]])
    return Cameras(viewmats, Ks, sizes), Photos(colors, sizes)


def test_the_mean_of_the_pixels_that_see_a_point():
    points = torch.tensor(
        [
            [0.6, -0.4, 1.0],  # (3.2, 0.2) of the first: its pixel 3; (0.93, 1.46) of the other
            [-0.9, 0.4, 1.0],  # (0.2, 1.8): pixel 4; and the other
            [5.0, 0.0, 9.9],  # (3.01, 1.0): pixel 7 of the first alone
            [0.0, 50.0, 1.0],  # beside both
        ]
    )
    found = colors_in_photos(points, *two_views())
    expected = [[54, 55, 56], [56, 56, 57], [21, 22, 23]]
    assert found.dtype == torch.uint8
    np.testing.assert_allclose(found[:3], expected, atol=1)
    np.testing.assert_allclose(found[3], [(9 + 12 + 21 + 200 + 5 * shift) / 5 for shift in (0, 0.6, 1.2)], atol=1)


def test_masked_pixels_give_no_colour_and_transparent_ones_count_by_their_alpha():
    cameras, photos = two_views()
    keep = [torch.ones(2, 4, dtype=torch.bool), torch.zeros(3, 2, dtype=torch.bool)]
    points = torch.tensor([[0.6, -0.4, 1.0]])  # pixel 3 of the first, which is 9, 10, 11
    assert colors_in_photos(points, cameras, photos, PixelMasks.from_images(keep)).tolist() == [[9, 10, 11]]
    keep[0][0, 3] = False  # then the mean of nothing that was seen
    assert colors_in_photos(points, cameras, photos, PixelMasks.from_images(keep)).tolist() == [[128, 128, 128]]
    alphas = torch.tensor([51] * 8 + [204] * 6)[:, None]  # 0.2 and 0.8; pixel 3 of the first has 50, 100, 0 there
    colors = torch.cat([photos.colors.long() * alphas // 255, alphas], dim=1).to(torch.uint8)
    colors[3, :3] = torch.tensor([10, 20, 0])
    assert colors_in_photos(points, cameras, Photos(colors, photos.sizes)).tolist() == [[90, 100, 80]]
