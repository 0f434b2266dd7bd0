"""Captures on a disk: of COLMAP, and with a transforms.json."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pycolmap
from helpers.painted import axes_of
from PIL import Image

TARGET = np.array([3.0, -1.0, 2.0])
"""What the cameras of `write_transforms` look at."""


def rotation(angle: float) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])


def write_capture(
    folder: Path,
    *,
    views: int = 9,
    cameras: tuple[tuple[str, int, int, list[float]], ...] = (("PINHOLE", 40, 24, [50.0, 52.0, 21.0, 11.0]),),
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    scale: float = 1.0,
    model: str = "sparse/0",
    suffix: str = ".bin",
    nested: bool = False,
    num_points: int = 20,
) -> Path:
    """A capture whose view i has camera ``i % len(cameras)`` at ``scale * (i, 0, -5) + shift``, turned a little, and
    photos whose pixel (x, y) is (6x, 6y, 20i)."""
    reconstruction = pycolmap.Reconstruction()
    for number, (kind, width, height, params) in enumerate(cameras, start=1):
        reconstruction.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=number, model=kind, width=width, height=height, params=params)
        )
    random = np.random.default_rng(0)
    for view in range(views):
        number = view % len(cameras)
        name = (f"left/{view % 2}/" if nested else "") + f"photo{view:02d}.png"
        turn = rotation(0.1 * view)
        center = scale * np.array([view, 0.0, -5.0]) + shift
        pose = pycolmap.Rigid3d(np.concatenate([turn, -(turn @ center)[:, None]], axis=1))
        image = pycolmap.Image(name, np.zeros((num_points, 2)), camera_id=number + 1, image_id=view + 1)
        reconstruction.add_image_with_trivial_frame(image, pose)
        width, height = cameras[number][1:3]
        x, y = np.meshgrid(np.arange(width), np.arange(height))
        path = folder / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        pixels = np.stack([6 * x, 6 * y, np.full_like(x, 20 * view)], axis=-1).astype(np.uint8)
        Image.fromarray(pixels).save(path)
    for point in range(num_points):
        track = pycolmap.Track([pycolmap.TrackElement(1, point), pycolmap.TrackElement(2, point)])
        xyz = scale * random.normal(size=3) + shift
        number = reconstruction.add_point3D(xyz, track, np.array([point, 2, 3], dtype=np.uint8))
    (folder / model).mkdir(parents=True)
    {".bin": reconstruction.write_binary, ".txt": reconstruction.write_text}[suffix](folder / model)
    return folder


def camera_to_world(angle: float) -> np.ndarray:
    """OpenGL's: x right, y up, z backward; on a ring of radius 4 about the target, looking at it, z up."""
    center = TARGET + np.array([4 * math.cos(angle), 4 * math.sin(angle), 1.0])
    backward = (center - TARGET) / np.linalg.norm(center - TARGET)
    pose = np.eye(4)
    pose[:3] = np.c_[axes_of(backward).T, center]
    return pose


def write_transforms(folder: Path, views: int = 9, mode: str = "RGB", **content) -> Path:
    """Photos images/f0.png .. of 20x10, one colour each, and a transforms.json; a None in `content` drops it."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for view in range(views):
        color = (10 * view, 200, 30, 128) if mode == "RGBA" else (10 * view, 200, 30)
        Image.new(mode, (20, 10), color).save(folder / "images" / f"f{view}.png")
        pose = np.round(camera_to_world(0.5 * view), 7).tolist()
        frames.append({"file_path": f"./images/f{view}.png", "transform_matrix": pose})
    everything = {"w": 20, "h": 10, "fl_x": 25.0, "fl_y": 26.0, "cx": 9.5, "cy": 5.5, "frames": frames} | content
    kept = {key: value for key, value in everything.items() if value is not None}
    (folder / "transforms.json").write_text(json.dumps(kept), encoding="utf-8-sig")  # with a mark at the beginning
    return folder
