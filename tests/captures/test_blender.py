"""NeRF-synthetic captures: transforms_train.json, _val, _test, and RGBA photos named without a suffix."""

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.painted import axes_of, painted_photo, require_points_at_their_pixels, seen_by
from helpers.refusals import assert_refused
from PIL import Image

from turbogs_plugin.captures import load_scene, write_demo_capture

SIZE, ANGLE = (60, 40), 0.7
POINTS = np.array([[0.3, 0.0, 0.1], [-0.2, 0.25, -0.3], [0.0, -0.4, 0.35]])
SCALED = np.diag([2, 2, 2, 1]).tolist()
SPLIT = {"train": 6, "val": 2, "test": 4}


def camera_to_world(turn: float, height: float) -> np.ndarray:
    """[4, 4], as Blender has it: x right, y up, z backward; 4 from the origin, looking at it, z up."""
    backward = np.array([math.cos(turn) * math.cos(height), math.sin(turn) * math.cos(height), math.sin(height)])
    pose = np.eye(4)
    pose[:3] = np.c_[axes_of(backward).T, 4.0 * backward]
    return pose


def write_blender(folder: Path, split: dict[str, int] = SPLIT) -> Path:
    """train/r_0.png, ... and the file of each split. Where nothing is painted, photos are white and transparent."""
    for number, (part, count) in enumerate(split.items()):
        (folder / part).mkdir(parents=True)
        frames = []
        for view in range(count):
            pose = camera_to_world(0.9 * view + 0.3 * number, 0.4 + 0.1 * number)
            focal = 0.5 * SIZE[0] / math.tan(0.5 * ANGLE)
            photo = painted_photo(SIZE, seen_by(pose[:3, :3].T, pose[:3, 3], POINTS, focal, SIZE))
            alpha = np.where(photo.any(axis=2), 255, 0)[:, :, None].astype(np.uint8)
            rgba = np.concatenate([np.where(alpha > 0, photo, 255).astype(np.uint8), alpha], axis=2)
            Image.fromarray(rgba).save(folder / part / f"r_{view}.png")
            frames.append({"file_path": f"./{part}/r_{view}", "rotation": 0.1, "transform_matrix": pose.tolist()})
        (folder / f"transforms_{part}.json").write_text(json.dumps({"camera_angle_x": ANGLE, "frames": frames}))
    return folder


def test_painted_points_are_where_the_cameras_see_them_and_the_split_is_its_own(tmp_path):
    scene = load_scene(write_blender(tmp_path / "lego"))
    require_points_at_their_pixels(scene, scene.train, POINTS)
    require_points_at_their_pixels(scene, scene.test, POINTS)
    assert scene.train.names == tuple(f"train/r_{view}.png" for view in range(6))
    assert scene.test.names == tuple(f"test/r_{view}.png" for view in range(4))
    assert scene.notes == (
        f"{tmp_path}/lego/transforms_train.json (NeRF-synthetic, with transforms_test.json): "
        "10 photos, by its own split 6 for training, 4 for testing",
        "50,000 random points are drawn about what the cameras look at, as the capture has none",
        "transparent photos are composited on a background (train.background)",
    )


def test_without_test_photos_those_for_validation_are_tested_and_without_these_every_8th(tmp_path):
    folder = write_blender(tmp_path / "lego")
    shutil.rmtree(folder / "test")
    (folder / "train/r_1.png").unlink()
    scene = load_scene(folder)
    assert scene.test.names == ("r_0.png",) and len(scene.train) == 4
    gone = "train/r_1, test/r_0, test/r_1, test/r_2, test/r_3"
    assert scene.notes[1] == f"5 of 10 images are left out, their photos do not exist: {gone}"
    (folder / "transforms_test.json").unlink()
    assert load_scene(folder).test.names == ("val/r_0.png", "val/r_1.png")
    (folder / "transforms_val.json").unlink()
    assert load_scene(folder).test.names == ("r_0.png",)


def test_reduced_photos_mix_with_black(tmp_path):
    """The hidden white of transparent pixels does not bleed into their neighbours."""
    scene = load_scene(write_blender(tmp_path / "lego"), factor=2)
    photo = scene.train.photos.image(0) * 255
    assert tuple(photo.shape) == (20, 30, 3)
    assert sorted(photo.amax(dim=2).flatten().tolist())[-4:] == pytest.approx([0, 64, 64, 64], abs=1)
    focal = 0.25 * SIZE[0] / math.tan(0.5 * ANGLE)
    np.testing.assert_allclose(scene.train.cameras.Ks[0], [[focal, 0, 15], [0, focal, 10], [0, 0, 1]], rtol=1e-6)


def test_which_kind_is_taken_of_several(tmp_path):
    """COLMAP, transforms.json, NeRF-synthetic, in this order; what is passed over is named."""
    folder = write_blender(tmp_path / "all", {"train": 6, "val": 3, "test": 4})
    assert "(NeRF-synthetic, " in load_scene(folder).notes[0]
    shutil.copy(folder / "transforms_val.json", folder / "transforms.json")
    scene = load_scene(folder)
    assert scene.train.names == ("r_1.png", "r_2.png")
    passed_over = "transforms_train.json, transforms_test.json not used"
    assert scene.notes[1] == passed_over
    demo = write_demo_capture(tmp_path / "demo", views=4, width=32, height=24)
    for part in ("sparse", "images"):
        shutil.copytree(demo / part, folder / part)
    scene = load_scene(folder)
    assert scene.notes[1] == f"transforms.json, {passed_over}" and scene.train.cameras.sizes[0].tolist() == [32, 24]


def frame(**values):
    return lambda content: content["frames"][2].update(values)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda content: content.update(camera_angle_x=3.2), "neither fl_x nor a camera_angle_x in 0 .. pi"),
        (lambda content: content.update(frames=content["frames"][:2]), "2 training images: at least 3"),
        (frame(file_path="./train/r_1"), "names the photo train/r_1 twice"),
        (frame(file_path="./test/r_1"), "names the photo test/r_1 twice"),
        (lambda content: [f.update(transform_matrix=SCALED) for f in content["frames"]], "r_0' is not a rotation"),
    ],
)
def test_what_is_refused(tmp_path, change, words):
    file = write_blender(tmp_path / "lego") / "transforms_train.json"
    change(content := json.loads(file.read_text()))
    file.write_text(json.dumps(content))
    assert_refused(words, load_scene, file.parent)
