"""Numbers about a scene and a machine that decisions rest on, from a bounded number of its pixels and points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from turbogs_plugin.error_maps import MAP_BYTES
from turbogs_plugin.plan.exposures import compare_exposures
from turbogs_plugin.plan.sight import Sight
from turbogs_plugin.scene import PosedImages, Scene
from turbogs_plugin.scene.host_arrays import free_host_bytes
from turbogs_plugin.scene.photos import PHOTO_BYTES

MODEL_BYTES_PER_GAUSSIAN = 3 * 4 * 59
"""59 single-precision numbers at degree 3, with two moments each."""


@dataclass(frozen=True)
class SceneFacts:
    """What the plan knows.

    Args:
        scene: name of the capture.
        train_views, test_views: V and the number of test views.
        smallest_photo, largest_photo: (width, height) of the training photos with the fewest and most pixels.
        points: M, of the reconstruction.
        reprojection_error: a median in pixels, see `Scene`; None: not known.
        extent: radius of the scene in the capture's own unit.
        baseline: median distance of a training camera to its nearest, over the median depth of the points it sees.
        exposure_spread, exposure_rest, exposure_views: how far photos differ in brightness and white balance, in stops
            (`compare_exposures`): all from their mean; each from the photos before and after; and of how many photos
            this is, None where no setting asks for it.
        direction_concentration: norm of the mean unit viewing direction of the training cameras; 1: all look the same
            way, 0: all around.
        photo_bytes: of all photos, training and test.
        map_bytes: of the training views' error and age maps.
        model_bytes: of one Gaussian a point with an optimizer's two moments.
        device: cpu or cuda.
        device_free_bytes, host_free_bytes: memory free for this run; on a CPU both are the same memory.
        memory_limit: bytes of the device that the run was told not to exceed, or None.
        time_budget: seconds that the run was told to take, or None.
        transparent: training photos have an alpha.
        processes: that will train one model together.
    """

    scene: str
    train_views: int
    test_views: int
    smallest_photo: tuple[int, int]
    largest_photo: tuple[int, int]
    points: int
    extent: float
    baseline: float
    direction_concentration: float
    photo_bytes: int
    map_bytes: int
    model_bytes: int
    device: str
    device_free_bytes: int
    host_free_bytes: int
    memory_limit: int | None = None
    time_budget: float | None = None
    transparent: bool = False
    processes: int = 1
    exposure_spread: float = 0.0
    exposure_rest: float = 0.0
    exposure_views: int | None = None
    reprojection_error: float | None = None


@torch.no_grad()
def gather_facts(
    scene: Scene,
    device: torch.device,
    *,
    memory_limit: int | None = None,
    time_budget: float | None = None,
    processes: int = 1,
    with_exposures: bool = False,
) -> SceneFacts:
    """The facts of a scene, to be trained on a device.

    Args:
        scene: on any device; photos that are already on `device` count as free memory, for they are planned here.
        device: where training is to be.
        memory_limit: bytes of the device that must not be exceeded.
        time_budget: seconds.
        processes: that will train together.
        with_exposures: compare those of the photos, which takes longer than all else here.
    """
    views, sizes = scene.train, scene.train.cameras.sizes
    order = np.lexsort((sizes[:, 0], sizes.prod(axis=1)))  # of equally many pixels, upright ones first
    pixels, test_pixels = int(sizes.prod(axis=1).sum()), int(scene.test.cameras.sizes.prod(axis=1).sum())
    sight = Sight.of(views, scene.points)
    exposures = compare_exposures(views, sight) if with_exposures else None
    host_free = free_host_bytes()
    return SceneFacts(
        scene=scene.name,
        train_views=len(views),
        test_views=len(scene.test),
        smallest_photo=tuple(sizes[order[0]].tolist()),
        largest_photo=tuple(sizes[order[-1]].tolist()),
        points=len(scene.points),
        extent=scene.extent * scene.frame.scale,
        baseline=_baseline(views, sight, scene.extent),
        direction_concentration=float(views.cameras.directions.double().mean(dim=0).norm()),
        photo_bytes=(PHOTO_BYTES + views.photos.transparent) * (pixels + test_pixels),
        map_bytes=MAP_BYTES * pixels,
        model_bytes=MODEL_BYTES_PER_GAUSSIAN * len(scene.points),
        device=device.type,
        device_free_bytes=_free_device_bytes(device, scene) if device.type == "cuda" else host_free,
        host_free_bytes=host_free,
        memory_limit=memory_limit,
        time_budget=time_budget,
        transparent=views.photos.transparent,
        processes=processes,
        exposure_spread=exposures.spread if exposures else 0.0,
        exposure_rest=exposures.rest if exposures else 0.0,
        exposure_views=int(exposures.compared.sum()) if exposures else None,
        reprojection_error=scene.reprojection_error,
    )


def _baseline(views: PosedImages, sight: Sight, extent: float) -> float:
    if len(views) < 2:
        return 0.0
    depth = sight.depths[sight.inside].median() if sight.inside.any() else torch.tensor(extent)
    return float(sight.distances.amin(dim=1).median() / depth)


def _free_device_bytes(device: torch.device, scene: Scene) -> int:
    free, _ = torch.cuda.mem_get_info(device)
    free += torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    ours = (views.photos.stored for views in (scene.train, scene.test))
    return free + sum(colors.numel() for colors in ours if colors.device.type == "cuda")
