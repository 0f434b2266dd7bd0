"""Photos of lenses with distortion, against the formulas of the models written in numpy."""

import json
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers.captures import write_capture, write_transforms
from helpers.refusals import assert_refused
from PIL import Image

from turbogs_plugin.captures import load_scene
from turbogs_plugin.captures.undistort import pinhole_of_camera

pytestmark = pytest.mark.usefixtures("few_random_points")

WIDTH, HEIGHT = 320, 240
FISHEYE = {"camera_model": "OPENCV_FISHEYE"}
PARAMS = {
    "OPENCV": [260.0, 270.0, 163.0, 117.0, 0.12, -0.05, 0.004, -0.003],
    "FULL_OPENCV": [260.0, 270.0, 163.0, 117.0, 0.12, -0.05, 0.004, -0.003, 0.02, 0.05, 0.01, 0.0],
    "OPENCV_FISHEYE": [200.0, 210.0, 163.0, 117.0, 0.03, -0.01, 0.002, 0.001],
}


def brown(points: np.ndarray, radial: np.ndarray, p1: float = 0.0, p2: float = 0.0) -> np.ndarray:
    """OpenCV's tangential distortion on top of a radial factor for each point."""
    x, y = points[..., 0], points[..., 1]
    squared = x * x + y * y
    bent = points * radial[..., None]
    bent[..., 0] += 2 * p1 * x * y + p2 * (squared + 2 * x * x)
    bent[..., 1] += 2 * p2 * x * y + p1 * (squared + 2 * y * y)
    return bent


def bend(model: str, params: list[float], points: np.ndarray) -> np.ndarray:
    """[..., 2] points at depth 1 -> the same, distorted, before the focal length: the models' textbook formulas."""
    radius = np.maximum(np.linalg.norm(points, axis=-1), 1e-12)
    squared, angle = radius**2, np.arctan(radius)
    if model == "OPENCV_FISHEYE":
        powers = sum(k * angle ** (2 * power) for power, k in enumerate(params[4:], start=1))
        return brown(points, angle * (1 + powers) / radius)
    k1, k2, p1, p2, k3, k4, k5, k6 = (*params[4:], 0, 0, 0, 0)[:8]
    upper = 1 + k1 * squared + k2 * squared**2 + k3 * squared**3
    return brown(points, upper / (1 + k4 * squared + k5 * squared**2 + k6 * squared**3), p1, p2)


def straighten(bent: np.ndarray, model: str, params: list[float]) -> np.ndarray:
    """The inverse of `bend`: iterated until it fits."""
    points = bent.copy()
    for _ in range(300):
        missed = bent - bend(model, params, points)
        if np.abs(missed).max() < 1e-7:
            return points
        points += 0.7 * missed
    raise AssertionError(f"{model} {params} cannot be inverted")


def pattern(points: np.ndarray) -> np.ndarray:
    """[..., 3] uint8: what the cameras look at, by the direction (at depth 1) in which it lies."""
    x, y = points[..., 0], points[..., 1]
    waves = [np.sin(14 * x + 3 * y), np.cos(11 * y - 4 * x), np.sin(9 * x * y + 5 * x)]
    return np.round(127.5 + 110 * np.stack(waves, axis=-1)).astype(np.uint8)


def pixel_centers(width: int, height: int) -> np.ndarray:
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([x, y], axis=-1)


def bent_photo(model: str, params: list[float]) -> np.ndarray:
    return pattern(straighten((pixel_centers(WIDTH, HEIGHT) - params[2:4]) / params[:2], model, params))


def camera(model: str, params: list[float]) -> pycolmap.Camera:
    return pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=params, camera_id=1)


def with_photos(folder: Path, photo: np.ndarray) -> Path:
    """The capture with this photo in the place of each."""
    for path in (folder / "images").iterdir():
        Image.fromarray(photo).save(path)
    return folder


def write_colmap(folder: Path, model: str, params: list[float], photo: np.ndarray) -> Path:
    return with_photos(write_capture(folder, views=4, cameras=((model, WIDTH, HEIGHT, params),)), photo)


def require_straight(scene, levels: float = 2.0) -> None:
    """Every pixel, to its rim, shows what a pinhole camera of the scene's intrinsics sees."""
    K = scene.train.cameras.Ks[0].double().numpy()
    width, height = scene.train.cameras.sizes[0].tolist()
    seen = pattern((pixel_centers(width, height) - K[:2, 2]) / K[[0, 1], [0, 1]]).astype(np.float64)
    loaded = scene.train.photos.image(0).double().numpy() * 255
    difference = np.abs(loaded - seen)
    assert difference[2:-2, 2:-2].max() <= levels
    assert difference.max() <= 8 * levels  # the outermost pixels may be repeated from half a pixel inside


@pytest.mark.parametrize("model", PARAMS)
def test_colmap_photos_are_those_of_a_pinhole(tmp_path, model):
    photo = bent_photo(model, PARAMS[model])
    scene = load_scene(write_colmap(tmp_path / "cup", model, PARAMS[model], photo))
    require_straight(scene)
    width, height = scene.train.cameras.sizes[0]
    assert scene.notes[-1] == f"4 photos undistorted: {model} 320x240 -> PINHOLE {width}x{height}"
    center = scene.frame.restore_points(scene.train.cameras.centers[0].numpy())
    np.testing.assert_allclose(center, [1, 0, -5], atol=1e-5)  # the pose is the capture's: only the lens changed


@pytest.mark.parametrize(
    ("content", "model", "params"),
    [
        ({"k1": 0.12, "k2": -0.05, "p1": 0.004, "p2": -0.003}, "OPENCV", [0.12, -0.05, 0.004, -0.003]),
        ({"k1": 0.12, "k3": 0.03, "p1": 0.004, "p2": 0.001}, "FULL_OPENCV", [0.12, 0, 0.004, 0.001, 0.03, 0, 0, 0]),
        ({**FISHEYE, "k1": 0.03, "k2": -0.01, "k3": 0.002, "k4": 0.001}, "OPENCV_FISHEYE", [0.03, -0.01, 0.002, 0.001]),
        ({"is_fisheye": True, "k1": 0.03}, "OPENCV_FISHEYE", [0.03, 0.0, 0.0, 0.0]),
        (FISHEYE, "OPENCV_FISHEYE", [0.0, 0.0, 0.0, 0.0]),
    ],
)
def test_transforms_photos_are_those_of_a_pinhole(tmp_path, content, model, params):
    """Wherever the lens stands: for all frames, or in each."""
    numbers = {"fl_x": 260.0, "fl_y": 270.0, "cx": 163.0, "cy": 117.0, **content}
    photo = bent_photo(model, [260.0, 270.0, 163.0, 117.0, *params])
    folder = with_photos(write_transforms(tmp_path / "cup", 4, w=WIDTH, h=HEIGHT, **numbers), photo)
    scene = load_scene(folder)
    require_straight(scene)
    written = json.loads((folder / "transforms.json").read_text(encoding="utf-8-sig"))
    for key in numbers:
        del written[key]
    for frame in written["frames"]:
        frame.update(numbers)
    (folder / "transforms.json").write_text(json.dumps(written))
    again = load_scene(folder).train
    assert again.cameras.Ks.equal(scene.train.cameras.Ks) and again.photos.colors.equal(scene.train.photos.colors)


def test_a_wide_fisheye_keeps_to_60_degrees_off_the_axis():
    K, size, _ = pinhole_of_camera(camera("OPENCV_FISHEYE", [100.0, 100.0, 160.0, 120.0, 0.0, 0.0, 0.0, 0.0]), "camera")
    extent = np.array(size) / K[[0, 1], [0, 1]] / 2
    assert (extent < np.tan(np.pi / 3) + 0.01).all() and extent.max() > 1.5  # of 173 degrees at the photo's rim


def test_reduced_photos_are_undistorted_in_full_size(tmp_path):
    """Copies of half the size are not used; where they are all there is, they get full size first."""
    params = PARAMS["OPENCV"]
    photo = bent_photo("OPENCV", params)
    folder = write_colmap(tmp_path / "cup", "OPENCV", params, photo)
    full = load_scene(folder)
    (folder / "images_2").mkdir()
    for view in range(4):
        small = Image.fromarray(photo).resize((WIDTH // 2, HEIGHT // 2), Image.Resampling.BOX)
        small.save(folder / "images_2" / f"photo{view:02d}.png")
    for whole in (True, False):
        scene = load_scene(folder, factor=2)
        assert (np.abs(scene.train.cameras.sizes - full.train.cameras.sizes / 2) <= 0.5).all()
        require_straight(scene, levels=6.0 if whole else 12.0)  # an average of pixels is not the colour in their middle
        shutil.rmtree(folder / "images", ignore_errors=True)


def test_a_zero_distortion_changes_no_pixel(tmp_path):
    photo = bent_photo("OPENCV", PARAMS["OPENCV"])
    scene = load_scene(write_colmap(tmp_path / "cup", "OPENCV", [260.0, 270.0, 163.0, 117.0, 0, 0, 0, 0], photo))
    assert np.array_equal(scene.train.photos.colors.view(3, HEIGHT, WIDTH, 3)[0], photo)
    assert not any("undistorted" in note for note in scene.notes)


@pytest.mark.parametrize(
    ("model", "params", "words"),
    [
        ("EQUIRECTANGULAR", [320.0, 240.0], " is EQUIRECTANGULAR, a panorama: cut it"),
        ("OPENCV", [260.0, 270.0, 163.0, 117.0, np.nan, 0, 0, 0], " is OPENCV with parameters that are not those of a"),
        # radii beyond 0.91 come back into the photo, where COLMAP takes them for pixels
        ("SIMPLE_RADIAL", [190.0, 160.0, 120.0, -0.4], " is SIMPLE_RADIAL with .* or whose image folds"),
        ("SIMPLE_RADIAL", [20.0, 160.0, 120.0, -0.4], " is SIMPLE_RADIAL with parameters that are not those of a"),
        ("OPENCV", [43.0, 45.0, 27.0, 20.0, 0.12, -0.05, 0, 0], ": principal points are at 0.084, 0.083 of the"),
        ("OPENCV", [1560.0, 1620.0, 978.0, 702.0, 0.12, -0.05, 0, 0], ": principal points are at 3.1, 2.9 of the"),
        ("SIMPLE_RADIAL", [260.0, 1e9, 120.0, -0.1], " is SIMPLE_RADIAL with parameters that are not those of a"),
    ],
)
def test_what_is_no_lens_is_refused(model, params, words):
    assert_refused(f"camera 1{words}", pinhole_of_camera, camera(model, params), "camera 1")
