"""A scene whose photos have cameras of their own (`turbogs_plugin.captures.bundle_adjustment`).

Training photos and points are refined together. Test photos keep the cameras that they were given, as errors are to be
compared with other programs' errors, which are by the given ones. Beside them they get refined ones, by where they show
the points that training starts from, however that is set: errors by these are of the model alone, not of the camera.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from turbogs_plugin.captures.bundle_adjustment import Pinholes, of_these_photos, refine_alone, refine_together
from turbogs_plugin.scene.scene import Scene
from turbogs_plugin.types import Cameras


class RefinedCameras(NamedTuple):
    """Cameras and points of a scene by where its photos show its points."""

    train: Cameras  # to train with
    points: Tensor  # [M, 3] float32, to start from
    test: Cameras  # of the test photos beside theirs
    reprojection_error: float  # of the training cameras, as `Scene` has it
    notes: tuple[str, ...]


def find_cameras(scene: Scene, training: bool = True) -> RefinedCameras | None:
    """Cameras that agree better with where photos show the scene's points; None where the capture does not say that, or
    says it of other photos. Without `training`, training cameras and points stay, and only the test photos get cameras
    beside theirs."""
    places = scene.points.double().numpy()
    given, tested = _pinholes(scene.train.cameras), _pinholes(scene.test.cameras)
    shown, seen = scene.train.observations, scene.test.observations
    if not (shown and seen and of_these_photos(given, places, shown) and of_these_photos(tested, places, seen)):
        return None
    together = refine_together(given, places, shown)
    train, points, error = scene.train.cameras, scene.points, together.before
    notes: tuple[str, ...] = ()
    if training and together.count:
        places, error, notes = together.points, together.after, (together.text("training cameras"),)
        train, points = _cameras(together.cameras, train), torch.from_numpy(places).float()
    beside = refine_alone(tested, places, seen, together.spread)
    return RefinedCameras(train, points, _cameras(beside, scene.test.cameras), error, notes)


def with_cameras(scene: Scene, found: RefinedCameras | None) -> Scene:
    """The scene with these cameras; as it is where none were found."""
    if found is None:
        return scene
    return replace(
        scene,
        train=replace(scene.train, cameras=found.train),
        test=replace(scene.test, refined=found.test),
        points=found.points,
        reprojection_error=found.reprojection_error,
        notes=(*scene.notes, *found.notes),
    )


def refine_cameras(scene: Scene, training: bool = True) -> Scene:
    """The scene with the cameras of `find_cameras`, whose argument `training` is."""
    return with_cameras(scene, find_cameras(scene, training))


def _pinholes(cameras: Cameras) -> Pinholes:
    """Cameras as float64 arrays."""
    return Pinholes.of(cameras.viewmats.cpu().double().numpy(), cameras.Ks.cpu().double().numpy(), cameras.sizes)


def _cameras(pinholes: Pinholes, like: Cameras) -> Cameras:
    """The pinholes, of the images, type and device of other cameras."""
    viewmats, Ks = (matrices.cpu().double().numpy().copy() for matrices in (like.viewmats, like.Ks))
    viewmats[:, :3, :3], viewmats[:, :3, 3] = pinholes.rotations, pinholes.translations
    Ks[:, [0, 1], [0, 1]], Ks[:, :2, 2] = pinholes.focal, pinholes.centers
    return Cameras(torch.from_numpy(viewmats).to(like.viewmats), torch.from_numpy(Ks).to(like.Ks), like.sizes)
