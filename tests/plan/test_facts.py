"""The facts of a plan, against captures whose numbers are known."""

import numpy as np
import pytest
import torch

from turbogs_plugin.plan import gather_facts
from turbogs_plugin.scene import Frame, PosedImages, Scene
from turbogs_plugin.scene.photos import Photos
from turbogs_plugin.types import Cameras

CPU = torch.device("cpu")


def posed(images: list[np.ndarray], viewmats: np.ndarray, focal: float = 40.0) -> PosedImages:
    """Views of [H, W, 3] uint8 images, the principal point in the middle."""
    sizes = np.array([(image.shape[1], image.shape[0]) for image in images], dtype=np.int64)
    Ks = torch.zeros(len(images), 3, 3)
    Ks[:, 0, 0] = Ks[:, 1, 1] = focal
    Ks[:, :2, 2] = torch.from_numpy(sizes) / 2
    Ks[:, 2, 2] = 1.0
    colors = torch.from_numpy(np.concatenate([image.reshape(-1, 3) for image in images]))
    names = tuple(f"{index}.png" for index in range(len(images)))
    return PosedImages(Cameras(torch.from_numpy(viewmats).float(), Ks, sizes), names, Photos(colors, sizes))


def nadir(centers: np.ndarray) -> np.ndarray:
    """[V, 4, 4] cameras that all look along +z."""
    viewmats = np.tile(np.eye(4), (len(centers), 1, 1))
    viewmats[:, :3, 3] = -centers
    return viewmats


def noise(height: int = 48, width: int = 64, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(60, 120, (height, width, 3)).astype(np.uint8)


def scene_of(train: PosedImages, points: np.ndarray | None = None) -> Scene:
    if points is None:
        grid = np.stack(np.meshgrid(np.linspace(-0.3, 0.3, 9), np.linspace(-0.3, 0.3, 9)), axis=-1).reshape(-1, 2)
        points = np.concatenate([grid, np.full((len(grid), 1), 2.0)], axis=1)
    colors = torch.zeros(len(points), 3, dtype=torch.uint8)
    return Scene("made", train, train, torch.from_numpy(points).float(), colors, Frame(np.zeros(3), 5.0), 1.0)


LINE = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [0.5, 0, 0]])


def test_counts_sizes_and_bytes():
    images = [noise(48, 64), noise(48, 80), noise(32, 64), noise(48, 64)]
    facts = gather_facts(scene_of(posed(images, nadir(LINE))), CPU, memory_limit=5)
    pixels = 48 * 64 * 2 + 48 * 80 + 32 * 64
    assert facts.train_views == 4
    assert (facts.photo_bytes, facts.map_bytes) == (6 * pixels, 4 * pixels)
    assert (facts.device, facts.device_bytes) == ("cpu", 5) and facts.host_bytes > 5


@pytest.mark.parametrize("tilt", [0.0, 30.0, 90.0])
def test_concentration_of_view_directions(tilt):
    angle = np.radians(tilt)
    viewmats = nadir(np.zeros((2, 3)))
    for viewmat, sign in zip(viewmats, (1, -1), strict=True):
        c, s = np.cos(angle), sign * np.sin(angle)
        viewmat[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    facts = gather_facts(scene_of(posed([noise()] * 2, viewmats)), CPU)
    assert facts.direction_concentration == pytest.approx(abs(np.cos(angle)), abs=1e-6)


@pytest.mark.parametrize("points", [[], [[0.0, 0.0, -2.0], [50.0, 0.0, 1.0]]], ids=["none", "unseen"])
@pytest.mark.parametrize("views", [1, 4])
def test_points_that_no_camera_sees_and_a_single_view_decide_nothing(points, views):
    train = posed([noise(seed=number) for number in range(views)], nadir(LINE[:views]))
    gains = gather_facts(scene_of(train, np.reshape(points, (-1, 3))), CPU, with_exposures=True).gains
    assert not gains.compared.any() and (gains.spread, gains.rest) == (0.0, 0.0)
