"""A scene whose photos have cameras of their own (`turbogs_plugin.captures.bundle_adjustment`).

Training photos and points are refined together. Test photos keep the cameras that they were given, as errors are to be
compared with other programs' errors, which are by the given ones. Beside them they get refined ones, by where they show
the points that training starts from, however that is set: errors by these are of the model alone, not of the camera.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.captures.bundle_adjustment import (
    Pinholes,
    Refinement,
    of_these_photos,
    refine_alone,
    refine_together,
)
from turbogs_plugin.captures.load import load_scene
from turbogs_plugin.scene.scene import Observations, PosedViews, Scene
from turbogs_plugin.types import Cameras


@dataclass(frozen=True)
class RefinedCameras:
    """Cameras of a scene by where its photos show its points.

    Args:
        together: training cameras and points.
        test_cameras: as the capture gives them.
        test_observations: where the test photos show points.
    """

    together: Refinement
    test_cameras: Pinholes
    test_observations: Observations

    def of(self, scene: Scene, training: bool = True) -> Scene:
        """The scene with these cameras.

        Args:
            scene: as it was loaded.
            training: False: training cameras and points stay, and only the test photos get cameras beside theirs.

        Returns:
            The scene, whose `reprojection_error` is by the cameras that are trained with.
        """
        together, points = self.together, scene.points.double().numpy()
        scene = replace(scene, reprojection_error=together.before)
        if training and together.count:
            points = together.points
            scene = replace(
                scene,
                train=replace(scene.train, cameras=_cameras(together.cameras, scene.train.cameras)),
                points=torch.from_numpy(points).float(),
                reprojection_error=together.after,
                notes=(*scene.notes, together.text("training cameras")),
            )
        beside = refine_alone(self.test_cameras, points, self.test_observations, together.spread)
        return replace(scene, test=replace(scene.test, refined=_cameras(beside, scene.test.cameras)))


def find_cameras(train: PosedViews, test: PosedViews, points: Tensor) -> RefinedCameras | None:
    """Cameras that agree better with where photos show the scene's points [M, 3]; None where the capture does not say
    that, or it does not fit."""
    places = points.double().numpy()
    shown, tested = (_usable(views, places) for views in (train, test))
    if shown is None or tested is None:
        return None
    together = refine_together(_pinholes(train.cameras), places, shown)
    return RefinedCameras(together, _pinholes(test.cameras), tested)


def with_cameras(scene: Scene, found: RefinedCameras | None, training: bool = True) -> Scene:
    """The scene as `RefinedCameras.of` gives it; as it is where none were found."""
    return scene if found is None else found.of(scene, training)


def refine_cameras(scene: Scene, training: bool = True) -> Scene:
    """The scene with the cameras that `find_cameras` finds; `training` as in `RefinedCameras.of`."""
    return with_cameras(scene, find_cameras(scene.train.posed, scene.test.posed, scene.points), training)


def load_and_find(
    path: str | Path,
    factor: int = 1,
    test_every: int = 8,
    progress: Callable[[int, int], object] | None = None,
    find: bool = True,
) -> tuple[Scene, RefinedCameras | None]:
    """A scene, and the cameras that `find_cameras` finds while its photos are decoded.

    Args:
        path, factor, test_every, progress: as for `load_scene`.
        find: False: no cameras are looked for.

    Raises:
        InputError: as `load_scene`.
    """
    found: list[RefinedCameras | None] = []
    meanwhile = (lambda *posed: found.append(find_cameras(*posed))) if find else None
    scene = load_scene(path, factor, test_every, progress, meanwhile)
    return scene, found[0] if found else None


def _usable(views: PosedViews, points: np.ndarray) -> Observations | None:
    """Observations of the views; None where there are none, or they belong to other photos."""
    observations = views.observations
    if observations is None or not len(observations):
        return None
    return observations if of_these_photos(_pinholes(views.cameras), points, observations) else None


def _pinholes(cameras: Cameras) -> Pinholes:
    """Cameras as float64 arrays."""
    viewmats, Ks = (matrices.cpu().double().numpy() for matrices in (cameras.viewmats, cameras.Ks))
    return Pinholes.of(viewmats, Ks, cameras.sizes)


def _cameras(pinholes: Pinholes, like: Cameras) -> Cameras:
    """The pinholes, of the images, type and device of other cameras."""
    viewmats, Ks = (matrices.cpu().double().numpy().copy() for matrices in (like.viewmats, like.Ks))
    viewmats[:, :3, :3], viewmats[:, :3, 3] = pinholes.rotations, pinholes.translations
    Ks[:, [0, 1], [0, 1]], Ks[:, :2, 2] = pinholes.focal, pinholes.centers
    return Cameras(torch.from_numpy(viewmats).to(like.viewmats), torch.from_numpy(Ks).to(like.Ks), like.sizes)
