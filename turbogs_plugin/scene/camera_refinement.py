"""A scene whose photos have cameras of their own (`turbogs_plugin.scene.bundle_adjustment`).

Training photos and points are refined together. Test photos keep the cameras that they were given, as errors are to be
compared with those of other programs, which have no others. Beside them they get refined ones, by where they show the
points that training starts from, however that is set: errors by these are of the model alone, and not of the camera.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from turbogs_plugin.scene.bundle_adjustment import Pinholes, refine_alone, refine_together, reprojection_errors
from turbogs_plugin.scene.load import PosedImages, Scene
from turbogs_plugin.scene.observations import Observations
from turbogs_plugin.types import Cameras

FARTHEST_MATCH = 0.02
"""Of the photos' width: where half of the points are farther than that from where photos show them, the photos are not
those that were reconstructed, and nothing is refined."""


def refine_cameras(scene: Scene, training: bool = True) -> Scene:
    """The scene with refined training cameras and points, and with refined cameras beside those of its test photos.

    Args:
        scene: as it was loaded.
        training: False: training cameras and points stay, and only the test photos get cameras beside theirs.

    Returns:
        The same scene, where its capture does not say where photos show the points, or that does not fit.
    """
    train, test, points = scene.train, scene.test, scene.points.double().numpy()
    shown, tested = _usable(scene, train), _usable(scene, test)
    if shown is None or tested is None:
        return scene
    given = _pinholes(train.cameras)
    refined = refine_together(given, points, shown)
    if training and (refined.cameras.focal != given.focal).any():
        before = np.median(reprojection_errors(given, points, shown))
        after = np.median(reprojection_errors(refined.cameras, refined.points, shown))
        points = refined.points
        scene = replace(
            scene,
            train=replace(train, cameras=_cameras(refined.cameras, train.cameras)),
            points=torch.from_numpy(points).float(),
            notes=(*scene.notes, refinement_text("training cameras", given, refined.cameras, before, after)),
        )
    beside = refine_alone(_pinholes(test.cameras), points, tested, refined.spread)
    return replace(scene, test=replace(test, refined=_cameras(beside, test.cameras)))


def refinement_text(called: str, given: Pinholes, refined: Pinholes, before: float, after: float) -> str:
    """What a refinement did, in a line.

    Args:
        called: what the cameras are.
        before, after: medians of `reprojection_errors`, in pixels.
    """
    count = int((refined.focal != given.focal).any(axis=1).sum())
    return (
        f"{count} of {len(given.focal)} {called} refined, each with a lens of its own: points are {after:.2f} pixels "
        f"from where photos show them, {before:.2f} before (medians)"
    )


def _usable(scene: Scene, views: PosedImages) -> Observations | None:
    """Where the views show the scene's points; None where that is not known, or is of other photos."""
    observations = views.observations
    if observations is None or not len(observations):
        return None
    errors = reprojection_errors(_pinholes(views.cameras), scene.points.double().numpy(), observations)
    width = float(np.median(views.cameras.sizes[:, 0]))
    return observations if np.median(errors) <= FARTHEST_MATCH * width else None


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
