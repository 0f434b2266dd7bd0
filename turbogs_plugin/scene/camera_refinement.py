"""A scene whose photos have cameras of their own (`turbogs_plugin.scene.bundle_adjustment`).

Training photos and points are refined together. Test photos keep the cameras that they were given, as errors are to be
compared with those of other programs, which have no others. Beside them they get refined ones, by where they show the
points that training starts from, however that is set: errors by these are of the model alone, and not of the camera.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from turbogs_plugin.scene.bundle_adjustment import Pinholes, of_these_photos, refine_alone, refine_together
from turbogs_plugin.scene.load import PosedImages, Scene
from turbogs_plugin.scene.observations import Observations
from turbogs_plugin.types import Cameras


def refine_cameras(scene: Scene, training: bool = True) -> Scene:
    """The scene with refined training cameras and points, and with refined cameras beside those of its test photos.

    Args:
        scene: as it was loaded.
        training: False: training cameras and points stay, and only the test photos get cameras beside theirs.

    Returns:
        It has a `reprojection_error`, that of the cameras that are trained with. The same scene, where its capture does
        not say where photos show the points, or that does not fit.
    """
    train, test, points = scene.train, scene.test, scene.points.double().numpy()
    shown, tested = _usable(train, points), _usable(test, points)
    if shown is None or tested is None:
        return scene
    refined = refine_together(_pinholes(train.cameras), points, shown)
    scene = replace(scene, reprojection_error=refined.before)
    if training and refined.count:
        points = refined.points
        scene = replace(
            scene,
            train=replace(train, cameras=_cameras(refined.cameras, train.cameras)),
            points=torch.from_numpy(points).float(),
            reprojection_error=refined.after,
            notes=(*scene.notes, refined.text("training cameras")),
        )
    beside = refine_alone(_pinholes(test.cameras), points, tested, refined.spread)
    return replace(scene, test=replace(test, refined=_cameras(beside, test.cameras)))


def _usable(views: PosedImages, points: np.ndarray) -> Observations | None:
    """Where the views show points; None where that is not known, or is of other photos."""
    observations = views.observations
    if observations is None or not len(observations):
        return None
    return observations if of_these_photos(_pinholes(views.cameras), points, observations) else None


def _pinholes(cameras: Cameras) -> Pinholes:
    """The same cameras."""
    viewmats, Ks = (matrices.cpu().double().numpy() for matrices in (cameras.viewmats, cameras.Ks))
    return Pinholes.of(viewmats, Ks, cameras.sizes)


def _cameras(pinholes: Pinholes, like: Cameras) -> Cameras:
    """The pinholes, of the images, type and device of other cameras."""
    viewmats, Ks = (matrices.cpu().double().numpy().copy() for matrices in (like.viewmats, like.Ks))
    viewmats[:, :3, :3], viewmats[:, :3, 3] = pinholes.rotations, pinholes.translations
    Ks[:, [0, 1], [0, 1]], Ks[:, :2, 2] = pinholes.focal, pinholes.centers
    return Cameras(torch.from_numpy(viewmats).to(like.viewmats), torch.from_numpy(Ks).to(like.Ks), like.sizes)
