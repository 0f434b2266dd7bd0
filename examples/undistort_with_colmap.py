"""Undistort a capture by COLMAP beforehand, to compare with the photos that TurboGS undistorts as it loads them.

    python examples/undistort_with_colmap.py CAPTURE OUT
    turbogs train OUT --out RUN

CAPTURE has a ``transforms.json`` of nerfstudio or instant-ngp with OpenCV's k1, k2, p1, p2. OUT becomes a COLMAP scene
with pinhole cameras, the same poses, and no points, so that either training starts from the same random ones. Frames
whose photo does not exist are left out.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from pathlib import Path

import numpy as np
import pycolmap


def main(capture: Path, out: Path) -> None:
    if not (capture / "transforms.json").is_file():
        sys.exit(f"{capture} has no transforms.json: give a capture of nerfstudio or instant-ngp")
    content = json.loads((capture / "transforms.json").read_text())
    size = {"width": round(content["w"]), "height": round(content["h"])}
    params = [content.get(key, 0.0) for key in ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")]
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(pycolmap.Camera(model="OPENCV", camera_id=1, params=params, **size))
    frames = sorted(
        (frame for frame in content["frames"] if (capture / frame["file_path"]).is_file()),
        key=lambda frame: frame["file_path"],
    )
    folder = os.path.commonpath([os.path.dirname(frame["file_path"]) for frame in frames])
    for number, frame in enumerate(frames, start=1):
        world_from_camera = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL to OpenCV
        rotation = pycolmap.Rotation3d(world_from_camera[:3, :3].T)
        pose = pycolmap.Rigid3d(rotation, -rotation.matrix() @ world_from_camera[:3, 3])
        name = os.path.relpath(frame["file_path"], folder)
        image = pycolmap.Image(name, np.zeros((0, 2)), camera_id=1, image_id=number)
        reconstruction.add_image_with_trivial_frame(image, pose)
    with tempfile.TemporaryDirectory() as model:
        reconstruction.write(model)
        pycolmap.undistort_images(out, model, capture / folder, jpeg_quality=98)
    print(f"{out}: {len(frames)} photos; train with  turbogs train {out} --out RUN")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: undistort_with_colmap.py CAPTURE OUT")
    main(Path(sys.argv[1]), Path(sys.argv[2]))
