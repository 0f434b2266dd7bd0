"""LLFF captures: poses_bounds.npy beside images, or beside reduced copies alone."""

import io
import math
from pathlib import Path

import numpy as np
import pytest
from helpers.bounded_memory import outcome_within
from helpers.painted import axes_of, painted_photo, require_points_at_their_pixels, seen_by
from helpers.refusals import assert_refused
from PIL import Image

from turbogs_plugin.captures import load_scene
from turbogs_plugin.errors import InputError

FULL, FOCAL, NEAR, FAR = (120, 80), 90.0, 2.0, 10.0
POINTS = np.array([[0.3, 0.0, -4.0], [-0.5, 0.4, -3.0], [0.0, -0.6, -6.0]])
VIEWS = 9


def axes_and_center(view: int) -> tuple[np.ndarray, np.ndarray]:
    """([3, 3] rows right, up, backward, [3]) of cameras in front of the origin that look along -z, all a bit askew."""
    turn, tilt = 0.05 * (view - 4), 0.04 * (view % 3)
    backward = np.array([math.sin(turn) * math.cos(tilt), math.sin(tilt), math.cos(turn) * math.cos(tilt)])
    return axes_of(backward, (0.1, 1.0, 0.0)), np.array([0.1 * view - 0.4, 0.05 * (view % 4), 0.0])


def table(views: int = VIEWS) -> np.ndarray:
    """[V, 17] as LLFF's imgs2poses.py writes it."""
    rows = []
    for view in range(views):
        (right, up, backward), center = axes_and_center(view)
        hwf = np.array([FULL[1], FULL[0], FOCAL])
        matrix = np.stack([-up, right, backward, center, hwf], axis=1)  # [3, 5]
        rows.append(np.concatenate([matrix.ravel(), [NEAR + 0.1 * view, FAR]]))
    return np.array(rows)


def write_photos(folder: Path, size: tuple[int, int] = FULL, prefix: str = "IMG_") -> None:
    folder.mkdir(parents=True)
    for view in range(VIEWS):
        places = seen_by(*axes_and_center(view), POINTS, FOCAL * size[0] / FULL[0], size)
        Image.fromarray(painted_photo(size, places)).save(folder / f"{prefix}{view:03}.png")


def write_llff(folder: Path, **photos: tuple[int, int]) -> Path:
    """Photos of the given sizes by the names of their folders; images at full size where nothing is given."""
    for name, size in (photos or {"images": FULL}).items():
        write_photos(folder / name, size, "IMG_" if name == "images" else "image")
    np.save(folder / "poses_bounds.npy", table())
    return folder


def test_painted_points_are_where_the_cameras_see_them(tmp_path):
    scene = load_scene(write_llff(tmp_path / "fern"))
    require_points_at_their_pixels(scene, scene.train, POINTS)
    require_points_at_their_pixels(scene, scene.test, POINTS)
    assert scene.test.names == ("IMG_000.png", "IMG_008.png") and len(scene.train) == 7
    said = "poses_bounds.npy (LLFF): 9 photos of images, no points, so 50,000 random ones within the views at depths"
    assert len(scene.notes) == 1 and scene.notes[0].endswith(f"{said} of 2 to 10")


@pytest.mark.parametrize("size", [(30, 20), (30, 21), (29, 20)])
def test_reduced_copies_alone(tmp_path, size):
    """A side may be rounded either way; a factor counts from the full size, down to that of the copies."""
    folder = write_llff(tmp_path / "fern", images_4=(30, 20), images_8=(15, 10))
    scene = load_scene(folder)
    require_points_at_their_pixels(scene, scene.train, POINTS)
    assert "photos of images_4," in scene.notes[0] and scene.train.names[0] == "image001.png"
    np.testing.assert_allclose(scene.train.cameras.Ks[0], [[22.5, 0, 15], [0, 22.5, 10], [0, 0, 1]])
    for factor, expected in ((2, (30, 20)), (4, (30, 20)), (8, (15, 10))):
        assert tuple(load_scene(folder, factor=factor).train.cameras.sizes[0]) == expected
    for file in (folder / "images_4").iterdir():
        Image.new("RGB", size).save(file)
    width, height = size
    expected_K = [[22.5 * width / 30, 0, width / 2], [0, 22.5 * height / 20, height / 2], [0, 0, 1]]
    np.testing.assert_allclose(load_scene(folder).train.cameras.Ks[0], expected_K, rtol=1e-6)


def test_points_are_seeded_and_within_the_views_and_bounds(tmp_path):
    scene = load_scene(write_llff(tmp_path / "fern"))
    assert scene.points.equal(load_scene(tmp_path / "fern").points) and len(scene.points) == 50_000
    points = scene.frame.restore_points(scene.points.numpy())
    seen = np.zeros(len(points), dtype=bool)
    for view in range(VIEWS):
        (right, up, backward), center = axes_and_center(view)
        offsets = points - center
        depths = -offsets @ backward
        across, along = FOCAL * offsets @ right / depths, FOCAL * offsets @ up / depths
        seen |= (np.abs(across) < 60.001) & (np.abs(along) < 40.001) & (depths > 1.999) & (depths < 10.001)
    assert seen.all()
    # Even in 1/depth: half of them lie nearer than the harmonic mean of the bounds.
    assert np.mean(-points[:, 2] < 2 / (1 / 2.4 + 1 / FAR)) == pytest.approx(0.5, abs=0.05)


def with_value(row, column, value):
    def change(rows: np.ndarray) -> np.ndarray:
        rows[row, column] = value
        return rows

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda rows: rows[:, :15], "not a readable table: 9x15 where N x 17 numbers .* imgs2poses.py"),
        (lambda rows: rows.astype(object), "not a readable table"),
        (lambda rows: rows[:8], "has 8 poses but .*images has 9 photos: .*take out those without"),
        (with_value(3, 8, np.inf), "the pose in row 3 has numbers that are not finite: write it again"),
        (lambda rows: rows[:, [1, 0, *range(2, 17)]], "the pose in row 0 is not a rotation"),
        (with_value(2, 14, np.nan), "row 2 has no positive height, width and focal length"),
        (with_value(1, 15, 5e-324), "row 1 has .* bounds"),
        (with_value(slice(None), 9, 60.0), "IMG_000.png is 120x80 but its camera is 60x80"),
    ],
)
def test_what_is_refused(tmp_path, change, words):
    folder = write_llff(tmp_path / "fern")
    np.save(folder / "poses_bounds.npy", change(table()))
    assert_refused(words, load_scene, folder)


def test_damaged_files(tmp_path):
    """A header that announces more than there is, an archive, a pickle, bytes cut: refused in little memory."""
    file = write_llff(tmp_path / "fern") / "poses_bounds.npy"
    content, huge, zipped = file.read_bytes(), io.BytesIO(), io.BytesIO()
    np.lib.format.write_array_header_1_0(huge, {"descr": "<f8", "fortran_order": False, "shape": (2**40, 17)})
    np.savez(zipped, table())
    for data in (huge.getvalue() + content[128:], zipped.getvalue(), b"", b"\x80\x04", content[:60], content[:-1]):
        file.write_bytes(data)
        error = outcome_within(2**25, load_scene, file.parent)
        assert isinstance(error, InputError) and "not a readable table" in str(error)
