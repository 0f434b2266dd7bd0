"""Colours of random points: those of the photos."""

import numpy as np
import torch

from turbogs_plugin.masks import PixelMasks
from turbogs_plugin.scene.photos import Photos
from turbogs_plugin.scene.starting_points import colors_in_photos
from turbogs_plugin.types import Cameras


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


def test_masked_pixels_give_no_colour():
    cameras, photos = two_views()
    keep = [torch.ones(2, 4, dtype=torch.bool), torch.zeros(3, 2, dtype=torch.bool)]
    points = torch.tensor([[0.6, -0.4, 1.0]])  # pixel 3 of the first, which is 9, 10, 11
    assert colors_in_photos(points, cameras, photos, PixelMasks.from_images(keep)).tolist() == [[9, 10, 11]]
    keep[0][0, 3] = False  # then the mean of nothing that was seen
    assert colors_in_photos(points, cameras, photos, PixelMasks.from_images(keep)).tolist() == [[128, 128, 128]]


def test_transparent_pixels_count_by_their_alpha():
    cameras, photos = two_views()
    alphas = torch.tensor([51] * 8 + [204] * 6)[:, None]  # 0.2 and 0.8; pixel 3 of the first has 50, 100, 0 there
    colors = torch.cat([photos.colors.long() * alphas // 255, alphas], dim=1).to(torch.uint8)
    colors[3, :3] = torch.tensor([10, 20, 0])
    found = colors_in_photos(torch.tensor([[0.6, -0.4, 1.0]]), cameras, Photos(colors, photos.sizes))
    assert found.tolist() == [[90, 100, 80]]


def test_points_that_no_photo_sees_are_grey():
    assert colors_in_photos(torch.tensor([[0.0, 50.0, 1.0]]), *two_views()).tolist() == [[128, 128, 128]]


def test_no_more_photos_are_looked_at_than_say_anything_new():
    """Of 100 photos of their own number, 32 evenly spread ones."""
    cameras = Cameras(torch.eye(4).repeat(100, 1, 1), torch.eye(3).repeat(100, 1, 1), np.ones((100, 2), dtype=np.int64))
    photos = Photos(torch.arange(100, dtype=torch.uint8)[:, None].repeat(1, 3), cameras.sizes)
    views = np.linspace(0, 99, 32).round()
    found = colors_in_photos(torch.tensor([[0.5, 0.5, 1.0]]), cameras, photos)
    assert found[0, 0].item() == round(float(views.mean()))
