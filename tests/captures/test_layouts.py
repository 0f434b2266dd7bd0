"""Captures laid out as their makers publish them, with files that are not read lying about.

Each shows painted points, so that photos, intrinsics and poses must belong together.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers.painted import painted_photo, require_points_at_their_pixels
from helpers.refusals import assert_refused
from PIL import Image

from turbogs_plugin.captures import load_scene
from turbogs_plugin.captures.load import holds_photos_alone, other_poses
from turbogs_plugin.scene import Scene
from turbogs_plugin.scene.geometry import look_at

POINTS = np.array([[0.3, 0.0, 0.1], [-0.2, 0.25, -0.3], [0.0, -0.4, 0.35]])
VIEWS = 9


def pose_of(view: int) -> np.ndarray:
    """[3, 4] world to camera: 4 from the origin, looking at it, all a bit askew."""
    turn, tilt = 0.15 * (view - 4), 0.1 * (view % 3)
    center = 4.0 * np.array([np.sin(turn) * np.cos(tilt), np.sin(tilt), np.cos(turn) * np.cos(tilt)])
    return look_at(center, np.zeros(3), np.array([-0.05, 1.0, 0.0]))[:3]


def write_model(folder: Path, cameras: list[pycolmap.Camera], names: list[str], suffix: str = ".bin") -> None:
    """View i has camera ``i % len(cameras)``."""
    model = pycolmap.Reconstruction()
    for number, camera in enumerate(cameras, start=1):
        camera.camera_id = number
        model.add_camera_with_trivial_rig(camera)
    for view, name in enumerate(names):
        image = pycolmap.Image(name, np.zeros((3, 2)), camera_id=view % len(cameras) + 1, image_id=view + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose_of(view)))
    for index, point in enumerate(POINTS):
        elements = [pycolmap.TrackElement(1, index), pycolmap.TrackElement(2, index)]
        model.add_point3D(point, pycolmap.Track(elements), np.full(3, 90, dtype=np.uint8))
    folder.mkdir(parents=True)
    (model.write_binary if suffix == ".bin" else model.write_text)(folder)


def write_photos(folder: Path, cameras: list[pycolmap.Camera], names: list[str], reduction: float = 1) -> None:
    for view, name in enumerate(names):
        camera = cameras[view % len(cameras)]
        size = (round(camera.width / reduction), round(camera.height / reduction))
        pose = pose_of(view)
        seen = camera.img_from_cam(POINTS @ pose[:, :3].T + pose[:, 3])
        places = seen * np.divide(size, (camera.width, camera.height))
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(painted_photo(size, places)).save(folder / name)


def pinhole(width: int, height: int, focal: float) -> pycolmap.Camera:
    params = [focal, 1.01 * focal, 0.5 * width + 1.0, 0.5 * height - 1.0]
    return pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params)


def require_painted(scene: Scene) -> None:
    for views in (scene.train, scene.test):
        require_points_at_their_pixels(scene, views, POINTS)


NAMES = [f"_DSC{8670 + view}.png" for view in range(VIEWS)]


@pytest.mark.parametrize("kept", [(1, 2, 4, 8), (4, 8), (8,)])
def test_mip_nerf_360(tmp_path, kept):
    """images, images_2, ... beside sparse/0; those of full size, which take 10 GB, often gone."""
    camera = [pinhole(240, 160, 200.0)]
    write_model(tmp_path / "garden/sparse/0", camera, NAMES)
    for reduction in kept:
        write_photos(tmp_path / f"garden/images_{reduction}".removesuffix("_1"), camera, NAMES, reduction)
    for factor in {kept[0], 1}:
        scene = load_scene(tmp_path / "garden", factor)
        require_painted(scene)
        assert scene.train.cameras.sizes[0].tolist() == [240 // kept[0], 160 // kept[0]]
    assert "sparse/0 (binary): 9 images, 3 points" in scene.notes[0]
    if kept[0] > 1:
        assert f"intrinsics rescaled from 240x160 to {240 // kept[0]}x{160 // kept[0]}" in " ".join(scene.notes)
    if kept == (4, 8):
        assert load_scene(tmp_path / "garden", 8).train.cameras.sizes[0].tolist() == [30, 20]


def write_nerfstudio(folder: Path, cameras: list[pycolmap.Camera], names: list[str], **content) -> None:
    """transforms.json of `ns-process-data`, each frame with intrinsics of its own, and sparse_pc.ply."""
    frames = []
    for view, name in enumerate(names):
        pose, camera = np.eye(4), cameras[view % len(cameras)]
        pose[:3] = pose_of(view)
        to_world = np.linalg.inv(pose) @ np.diag([1.0, -1.0, -1.0, 1.0])
        own = dict(zip(("fl_x", "fl_y", "cx", "cy"), camera.params.tolist(), strict=True))
        size = {"w": camera.width, "h": camera.height}
        frames.append({"file_path": name, "transform_matrix": to_world.tolist(), "colmap_im_id": view, **own, **size})
    everything = {"camera_model": "OPENCV", "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "frames": frames}
    everything |= {"applied_transform": np.eye(4)[:3].tolist(), "ply_file_path": "sparse_pc.ply", **content}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "transforms.json").write_text(json.dumps(everything))
    names = (*(f"float {axis}" for axis in "xyz"), "uint8 red", "uint8 green", "uint8 blue")
    header = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(f"property {name}\n" for name in names)
    rows = "".join(f"{x} {y} {z} 9 8 7\n" for x, y, z in POINTS)
    (folder / "sparse_pc.ply").write_text(f"{header}end_header\n{rows}")


@pytest.mark.parametrize("model", ["colmap/sparse/0", "colmap_sparse/0", "colmap_text", ""])
def test_nerfstudio_and_instant_ngp(tmp_path, model):
    """images, images_2, ..., and often COLMAP's own folder, or one that colmap2nerf.py names."""
    camera, names = [pinhole(240, 160, 200.0)], [f"frame_{view + 1:05d}.png" for view in range(VIEWS)]
    write_nerfstudio(tmp_path / "poster", camera, [f"images/{name}" for name in names])
    write_photos(tmp_path / "poster/images", camera, names)
    write_photos(tmp_path / "poster/images_4", camera, names, 4)
    if model:
        write_model(tmp_path / "poster" / model, camera, names, ".txt" if "text" in model else ".bin")
    else:
        shutil.copytree(tmp_path / "poster", tmp_path / "reduced", ignore=shutil.ignore_patterns("images"))
        assert load_scene(tmp_path / "reduced").train.cameras.sizes[0].tolist() == [60, 40]
    for factor in (1, 4):
        scene = load_scene(tmp_path / "poster", factor)
        require_painted(scene)
        assert scene.train.cameras.sizes[0].tolist() == [240 // factor, 160 // factor] and len(scene.points) == 3
        if not model:
            assert scene.point_colors.tolist() == [[9, 8, 7]] * 3
            np.testing.assert_allclose(scene.frame.restore_points(scene.points.numpy()), POINTS, atol=1e-6)
    assert ("transforms.json not used" in scene.notes) == bool(model)


@pytest.mark.parametrize("trouble", ["photos", "damaged", "incomplete"])
def test_a_model_that_cannot_be_read_gives_way_to_other_poses_and_is_said(tmp_path, trouble):
    folder, camera = tmp_path / "fern", [pinhole(240, 160, 200.0)]
    write_photos(folder / "images", camera, NAMES)
    write_nerfstudio(folder, camera, [f"images/{name}" for name in NAMES])
    model = folder / "sparse/0"
    write_model(model, camera, [f"raw-{name}" for name in NAMES] if trouble == "photos" else NAMES)
    if trouble == "damaged":
        (model / "images.bin").write_bytes(b"short")
    elif trouble == "incomplete":
        (model / "images.bin").unlink()
    scene = load_scene(folder)
    require_painted(scene)
    reason = {"damaged": f"{model / 'images.bin'} is damaged: ", "incomplete": f"{model} has no images.bin: "}
    said = reason.get(trouble, f"{model} names 9 photos, of which 9 are missing")
    assert "transforms.json" in scene.notes[0] and scene.notes[1].startswith(f"not used: {said}")


@pytest.mark.parametrize("kind", ["colmap", "transforms"])
def test_one_camera_a_photo_upright_and_lying(tmp_path, kind):
    sizes = [(96 + view, 64 - view) if view % 2 else (64 + view, 96 - view) for view in range(VIEWS)]
    cameras = [pinhole(*size, 80.0 + view) for view, size in enumerate(sizes)]
    write_photos(tmp_path / "room/images", cameras, NAMES)
    if kind == "colmap":
        write_model(tmp_path / "room/sparse/0", cameras, NAMES)
    else:
        write_nerfstudio(tmp_path / "room", cameras, [f"images/{name}" for name in NAMES])
    scene = load_scene(tmp_path / "room")
    require_painted(scene)
    assert scene.train.cameras.sizes.tolist() == [list(size) for size in sizes[1:8]]


@pytest.mark.parametrize(
    ("files", "words"),
    [
        (["opensfm/reconstruction.json"], "reconstruction.json is not read, .* of OpenSfM or ODM: ns-process-data"),
        (["poses_bounds.npy"], "poses_bounds.npy is not read, .* of LLFF: take the sparse/0"),
        (["transforms_colmap.json"], "colmap.json is not read, .* of nerfstudio: name it transforms.json, or give the"),
        (["scene/transforms.json"], "scene/transforms.json is not read, .* give the folder that it lies in"),
        (["sensors/trajectories.txt"], "trajectories.txt is not read, .* of Kapture"),
        (["cameras.xml"], "cameras.xml is not read, .* of Metashape"),
        (["corrected_cameras/1.json"], "1.json is not read, .* of Polycam"),
        (["images/1.xmp"], "1.xmp is not read, .* of RealityScan"),
        (["1_initial/params/p_calibrated_camera_parameters.txt"], "p_.*.txt is not read, .* or Pix4D"),
        (["distorted/sparse/0/cameras.bin"], "cameras.bin is not read, .* of COLMAP: move its folder to sparse/0"),
        ([], "3 photos and nothing that .*: find the cameras, then use SCENE:  turbogs reconstruct .* SCENE$"),
    ],
)
def test_cameras_of_other_programs_are_named(tmp_path, files, words):
    write_photos(tmp_path / "images", [pinhole(60, 40, 50.0)], NAMES[:3])
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_text("{}")
    assert_refused(words, load_scene, tmp_path)
    assert holds_photos_alone(tmp_path) and other_poses(tmp_path) == other_poses(tmp_path / "images")


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("1.RAF", r"1 file is of a kind that is not read \(1.RAF\): convert to JPEG"),
        ("1.insv", "it is of a 360 degree camera: export flat views"),
        ("1.mp4", "it is a video: take photos out of it, as by  ffmpeg"),
        ("1.r3d", "'ns-process-data record3d' makes a capture of it"),
        ("a.tar", "unpack it"),
        ("1.usdz", "1.usdz cannot be read as photos"),
    ],
)
def test_files_that_no_capture_has_are_named(tmp_path, file, words):
    (tmp_path / file).write_bytes(b"x")
    assert_refused(f"nor photos; .*{words}", load_scene, tmp_path)
