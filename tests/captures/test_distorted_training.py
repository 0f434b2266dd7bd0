"""A known scene seen through a lens with distortion trains to the error of the same scene without one."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from helpers.framework_runs import thin_out_points
from PIL import Image

from turbogs_plugin.captures import load_scene, write_demo_capture
from turbogs_plugin.captures.demo import FOCAL
from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.scene import Scene
from turbogs_plugin.train.evaluate import Look, evaluate
from turbogs_plugin.train.trainer import Trainer

CPU = torch.device("cpu")
SIZE, FINE = (64, 48), 3
"""(width, height) of the photos; the scene is rendered so much finer, as a pinhole camera sees it."""
CLOSER = 1.3
"""Focal length of the lens in those of the pinhole, so that all it sees was rendered."""
LENSES = {
    "OPENCV": [-0.6, 0.3, 0.006, -0.004],
    "OPENCV_FISHEYE": [-0.45, 0.2, -0.02, 0.01],
}
MODEL = ("optimizer.type=sparse_adam", "density.type=none", "view_sampler.type=random", "pixel_sampler.type=random")
"""Choices that feed on errors would turn a last bit into another choice."""
STEPS = 40
BOUND = 0.12
"""dB. Measured: 0.04 (OPENCV) and 0.07 (OPENCV_FISHEYE); 0.15 and 0.25 where the photos are scaled like the lens's
middle, not bent."""


def bend(model: str, coefficients: list[float], rays: np.ndarray) -> np.ndarray:
    """[..., 2] points at depth 1, distorted: OpenCV's two formulas."""
    x, y = rays[..., 0], rays[..., 1]
    squared = x * x + y * y
    if model == "OPENCV":
        k1, k2, p1, p2 = coefficients
        stretch = 1 + k1 * squared + k2 * squared**2
        bent_x = x * stretch + 2 * p1 * x * y + p2 * (squared + 2 * x * x)
        bent_y = y * stretch + 2 * p2 * x * y + p1 * (squared + 2 * y * y)
        return np.stack([bent_x, bent_y], axis=-1)
    radius = np.maximum(np.sqrt(squared), 1e-9)
    angle = np.arctan(radius)
    bent = angle * (1 + sum(k * angle ** (2 * power) for power, k in enumerate(coefficients, start=1)))
    return rays * (bent / radius)[..., None]


def straighten(model: str, coefficients: list[float], bent: np.ndarray) -> np.ndarray:
    """The inverse of `bend`."""
    rays = bent.copy()
    for _ in range(400):
        missed = bent - bend(model, coefficients, rays)
        if np.abs(missed).max() < 1e-9:
            return rays
        rays += missed
    raise AssertionError(f"{model} {coefficients} cannot be inverted")


def places_in_pixels(size: tuple[int, int]) -> np.ndarray:
    """[height * FINE, width * FINE, 2]: `FINE` squared places in each pixel."""
    x, y = ((np.arange(side * FINE) + 0.5) / FINE for side in size)
    return np.stack(np.meshgrid(x, y), axis=-1)


def photograph(fine: np.ndarray, K: np.ndarray, rays: np.ndarray) -> Image.Image:
    """A photo from a finer render with intrinsics `K`: each pixel the mean over its rays."""
    places = rays * K[[0, 1], [0, 1]] + K[:2, 2] - 0.5
    limit = np.array(fine.shape[1::-1]) - 1
    assert (places >= -0.5).all() and (places <= limit + 0.5).all()
    before = np.clip(np.floor(places).astype(int), 0, limit - 1)
    share = np.clip(places - before, 0.0, 1.0)
    (x, y), (u, v) = before.transpose(2, 0, 1), share.transpose(2, 0, 1)[..., None]
    rows = [(1 - u) * fine[row, x] + u * fine[row, x + 1] for row in (y, y + 1)]
    colors = (1 - v) * rows[0] + v * rows[1]
    height, width = rays.shape[0] // FINE, rays.shape[1] // FINE
    return Image.fromarray(np.round(colors.reshape(height, FINE, width, FINE, 3).mean(axis=(1, 3))).astype(np.uint8))


def write_capture(folder: Path, source: Path, camera: pycolmap.Camera, rays: np.ndarray) -> Path:
    """The finely rendered capture as another camera sees it along these rays, with the same poses and points."""
    reconstruction = pycolmap.Reconstruction(source / "sparse/0")
    (present,) = reconstruction.cameras.values()
    K = present.calibration_matrix()
    present.model, present.width, present.height = camera.model, camera.width, camera.height
    present.params = camera.params
    (folder / "images").mkdir(parents=True)
    for photo in (source / "images").iterdir():
        fine = np.asarray(Image.open(photo).convert("RGB")).astype(np.float64)
        photograph(fine, K, rays).save(folder / "images" / photo.name)
    (folder / "sparse/0").mkdir(parents=True)
    reconstruction.write_binary(folder / "sparse/0")
    return folder


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("lenses") / "fine"
    return thin_out_points(write_demo_capture(folder, views=9, width=SIZE[0] * FINE, height=SIZE[1] * FINE), 3)


def trainer_of(scene: Scene) -> Trainer:
    lengths = (f"train.iterations={STEPS}", f"train.refine_until={STEPS}", "train.sh_degree=0", "schedule.max_views=3")
    lengths += ("schedule.pixel_budget=0.3",)
    return Trainer(load_config("turbogs", [*lengths, *MODEL]).without_plan(), scene, CPU)


def train(scene: Scene) -> Trainer:
    trainer = trainer_of(scene)
    trainer.initialise_maps()
    for _ in range(STEPS):
        trainer.step()
    return trainer


@pytest.mark.parametrize("model", LENSES)
def test_a_distorted_capture_trains_to_the_error_of_the_undistorted(source, tmp_path, model):
    (width, height), places = SIZE, places_in_pixels(SIZE)
    focal, center = CLOSER * FOCAL * width, np.array([0.51 * width, 0.49 * height])
    params = [focal, focal, *center, *LENSES[model]]
    lens = pycolmap.Camera(model=model, width=width, height=height, params=params)
    rays = straighten(model, LENSES[model], (places - center) / focal)
    bent = load_scene(write_capture(tmp_path / "bent", source, lens, rays))
    assert "9 photos undistorted" in bent.notes[-1]
    K, (width, height) = bent.train.cameras.Ks[0].double().numpy(), bent.train.cameras.sizes[0].tolist()
    pinhole = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=K[[0, 1, 0, 1], [0, 1, 2, 2]])
    rays = (places_in_pixels((width, height)) - K[:2, 2]) / K[[0, 1], [0, 1]]
    straight = load_scene(write_capture(tmp_path / "straight", source, pinhole, rays))
    assert not any("undistorted" in note for note in straight.notes)
    # All against the photos that no lens has bent.
    untrained, expected, reached = (
        evaluate(trainer.gaussians, straight.test, Look(0, trainer.config.raster)).mean.psnr
        for trainer in (trainer_of(straight), train(straight), train(bent))
    )
    assert expected > untrained + 2.0
    assert abs(reached - expected) <= BOUND
