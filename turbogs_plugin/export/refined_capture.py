"""A COLMAP capture whose photos each have a refined camera of their own (`turbogs export SCENE --cameras`).

Any trainer takes it that reads principal points. A trainer that takes the middle of each photo for its principal point
(3DGS's own, LiteGS) would see the photos shifted, some by many pixels. Cameras are refined from all photos here, also
from those that a trainer keeps for testing.
"""

from __future__ import annotations

import re
import shlex
import tempfile
from pathlib import Path

import numpy as np

from turbogs_plugin.captures.bundle_adjustment import FARTHEST_MATCH, Pinholes, of_these_photos, refine_together
from turbogs_plugin.captures.capture import Capture
from turbogs_plugin.captures.colmap import find_model, read_colmap, write_whole
from turbogs_plugin.captures.colmap_files import ColmapModel, read_model
from turbogs_plugin.captures.mask_files import FOLDER as MASKS
from turbogs_plugin.captures.undistort import load_pycolmap
from turbogs_plugin.errors import InputError
from turbogs_plugin.files import require_writable

LINKED = re.compile(rf"(images|{MASKS})(_\d+)?")
"""Folders of photos, reduced photos and masks, which the new capture has links to."""


def write_refined(scene: Path, out: Path) -> str:
    """Write a COLMAP capture with the refined cameras and points of another: ``sparse/0``, and links to its photos, to
    reduced copies (``images_2``, ...) and masks. Points, colours, features and tracks stay, under their identifiers.

    Returns:
        Lines for the user: what is unusual about the capture, if anything is; how many cameras were refined, with the
        median errors in pixels before and after; where it was written.

    Raises:
        InputError: the capture has no reconstruction or lacks photos; photos show none of its points, or show them
            elsewhere; its cameras have distortion; `out` exists, or cannot be written.
    """
    load_pycolmap()  # where it is absent, that is said first
    if out.exists():
        raise InputError(f"--out '{out}' exists: choose a new folder")
    require_writable(out, f"--out '{out}'")
    found = find_model(scene) if scene.is_dir() else None
    if found is None:
        remedy = f"make one of its photos by  turbogs reconstruct {shlex.quote(str(scene))} --out SCENE"
        raise InputError(f"{scene} has no COLMAP reconstruction (cameras, images and points3D in sparse/0): {remedy}")
    capture = read_colmap(scene, *found)
    if bent := [lens.camera.model.name for lens in capture.lenses if lens is not None]:
        some = f"{len(bent)} of {len(capture.names)} cameras have distortion ({bent[0]})"
        remedy = "undistort the capture first by 'colmap image_undistorter', then use what that writes"
        raise InputError(f"{found[0]}: {some}, and refined cameras are pinholes: {remedy}")
    if not (observations := capture.observations):
        remedy = "give a reconstruction as COLMAP wrote it, with points and tracks"
        raise InputError(f"{found[0]} has no points that its photos show, by which cameras are refined: {remedy}")
    if capture.photo_folder.resolve() in out.resolve().parents:
        raise InputError(f"--out '{out}' would lie among the photos of '{capture.photo_folder}': choose another folder")
    given = Pinholes.of(capture.viewmats, capture.Ks, capture.sizes)
    if not of_these_photos(given, capture.points, observations):
        trouble = f"half of its points are over {FARTHEST_MATCH:.0%} of a photo's width from where photos show them"
        raise InputError(f"{found[0]}: {trouble}: reconstruct the photos again")
    refined = refine_together(given, capture.points, observations)
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".") as temporary:
        folder = Path(temporary) / "capture"
        (folder / "sparse/0").mkdir(parents=True)
        linked = {entry.name: entry for entry in scene.iterdir() if LINKED.fullmatch(entry.name) and entry.is_dir()}
        try:
            for name, source in ({"images": capture.photo_folder} | linked).items():
                (folder / name).symlink_to(source.resolve(), target_is_directory=True)
            _write(read_model(*found), capture, refined.cameras, refined.points, folder / "sparse/0", out)
        except OSError as error:
            remedy = "make room there, or choose a disk that takes links"
            raise InputError(f"--out '{out}' cannot be written: {remedy}") from error
        folder.rename(out)
    return "\n".join([*capture.notes[1:], refined.text("cameras"), f"scene  {out}"])


def _write(
    model: ColmapModel, capture: Capture, cameras: Pinholes, points: np.ndarray, folder: Path, called: Path
) -> None:
    """Write the reconstruction of which a capture is, with refined cameras, and points [M, 3] in the order of their
    identifiers. Errors as of `write_whole`, with its arguments `folder` and `called`."""
    pycolmap = load_pycolmap()
    reconstruction, finite = pycolmap.Reconstruction(), np.isfinite(model.points["xyz"]).all(axis=1)
    numbers, colors = model.points["id"][finite], model.points["color"][finite]
    for number, place, color in zip(numbers.tolist(), points, colors, strict=True):
        reconstruction.add_point3D_with_id(number, pycolmap.Point3D(xyz=place, color=color))
    images = {image.name.replace("\\", "/"): image for image in model.images}
    for view, (name, (width, height)) in enumerate(zip(capture.names, capture.sizes.tolist(), strict=True)):
        number, features = images[name].number, images[name].features  # the number is the camera's, too
        params = [*cameras.focal[view], *cameras.centers[view]]
        camera = pycolmap.Camera(camera_id=number, model="PINHOLE", width=width, height=height, params=params)
        reconstruction.add_camera_with_trivial_rig(camera)
        pose = pycolmap.Rigid3d(np.c_[cameras.rotations[view], cameras.translations[view]])
        image = pycolmap.Image(name, keypoints=features["pixel"], camera_id=number, image_id=number)
        reconstruction.add_image_with_trivial_frame(image, pose)
        for place in np.flatnonzero(np.isin(features["point"], numbers)).tolist():
            reconstruction.add_observation(features["point"][place], pycolmap.TrackElement(number, place))
    reconstruction.update_point_3d_errors()
    write_whole(reconstruction, folder, called)
