"""COLMAP reconstructions, binary or text, read through pycolmap."""

from __future__ import annotations

import itertools
import signal
import threading
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.capture import Capture, check_photo_name
from turbogs_plugin.scene.colmap_check import check_binary_model

if TYPE_CHECKING:
    import pycolmap

MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0")
"""Where a scene's reconstruction may lie, in order of preference."""

FILES = ("cameras", "images", "points3D")


def load_pycolmap() -> ModuleType:
    """The module: other kinds of captures need neither its time to load nor its presence.

    SIGTERM keeps the handler that Python knows of: pycolmap brings one that prints a trace of C++.
    """
    import pycolmap

    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)
    return pycolmap


def find_model(scene: Path) -> tuple[Path, str] | None:
    """The scene's reconstruction and its suffix, '.bin' or '.txt'; None where there is none."""
    for folder in (scene / name for name in MODEL_FOLDERS):
        for suffix in (".bin", ".txt"):
            if all((folder / f"{file}{suffix}").is_file() for file in FILES):
                return folder, suffix
    return None


def read_colmap(scene: Path, model: Path, suffix: str) -> Capture:
    """Read a reconstruction whose photos are in ``scene/images``.

    Args:
        scene: the scene's folder.
        model, suffix: as `find_model` gives them.

    Raises:
        InputError: files that are damaged, inconsistent, or of a camera model with distortion.
    """
    if suffix == ".bin":
        check_binary_model(model)
    pycolmap = load_pycolmap()
    reconstruction = pycolmap.Reconstruction()
    try:
        (reconstruction.read_binary if suffix == ".bin" else reconstruction.read_text)(model)
    except Exception as error:  # pycolmap raises whatever C++ threw
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{model} is not a COLMAP reconstruction: {reason}; copy or reconstruct it again") from error

    images = sorted((image for image in reconstruction.images.values() if image.has_pose), key=lambda image: image.name)
    names = tuple(check_photo_name(image.name, model) for image in images)
    for name, following in itertools.pairwise(names):
        if name == following:
            raise InputError(f"{model} has two images named '{name}'")
    viewmats = np.tile(np.eye(4), (len(images), 1, 1))
    intrinsics = np.tile(np.eye(3), (len(images), 1, 1))
    sizes = np.zeros((len(images), 2), dtype=np.int64)
    for i, image in enumerate(images):
        camera = reconstruction.cameras[image.camera_id]
        viewmats[i, :3] = image.cam_from_world().matrix()
        intrinsics[i] = pinhole_intrinsics(camera, scene, model)
        sizes[i] = min(camera.width, 2**31), min(camera.height, 2**31)

    points = [point for _, point in sorted(reconstruction.points3D.items())]
    capture = Capture(
        names=names,
        photo_folder=scene / "images",
        viewmats=viewmats,
        Ks=intrinsics,
        sizes=sizes,
        points=np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3),
        point_colors=np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3),
    )
    capture.check(model)
    return capture


def pinhole_intrinsics(camera: pycolmap.Camera, scene: Path, model: Path) -> np.ndarray:
    """[3, 3] float64 of a PINHOLE or SIMPLE_PINHOLE camera; `InputError` for the others."""
    if camera.model.name == "PINHOLE":
        fx, fy, cx, cy = camera.params
    elif camera.model.name == "SIMPLE_PINHOLE":
        fx, cx, cy = camera.params
        fy = fx
    else:
        raise InputError(
            f"camera {camera.camera_id} of {model} is {camera.model.name}, a model with lens distortion: undistort "
            f"with 'colmap image_undistorter --image_path {scene / 'images'} --input_path {model} --output_path NEW' "
            "and train on NEW"
        )
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
