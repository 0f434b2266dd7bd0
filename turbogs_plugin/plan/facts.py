"""Numbers about a scene and a machine that decisions rest on, from a bounded number of its pixels and points."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch

from turbogs_plugin.device import free_bytes
from turbogs_plugin.error_maps import MAP_BYTES
from turbogs_plugin.plan.photo_gains import PhotoGains, compare_exposures
from turbogs_plugin.scene import Scene
from turbogs_plugin.scene.host_arrays import free_host_bytes
from turbogs_plugin.scene.photos import PHOTO_BYTES


@dataclass(frozen=True)
class SceneFacts:
    """Numbers that the plan knows.

    Args:
        direction_concentration: norm of the mean unit viewing direction of the training cameras; 1: all look the same
            way, 0: all around.
        photo_bytes: of all photos, training and test.
        map_bytes: of the training views' error and age maps.
        device_bytes, host_bytes: memory free for this run, on the device at most `budget.max_memory`; on a CPU both are
            the same memory.
        transparent: training photos have an alpha.
        processes: number of those that will train one model together.
        gains: how far training photos differ in brightness and white balance; None where no setting asks for it.
        reprojection_error: a median in pixels, see `Scene`; None: not known.
        far_points: the distance from the cameras' mean that one point in a hundred exceeds, in sizes of the scene: the
            extent, or the points' median distance where that is more; 0: no points, or drawn ones.
    """

    train_views: int
    direction_concentration: float
    photo_bytes: int
    map_bytes: int
    device: str
    device_bytes: int
    host_bytes: int
    transparent: bool = False
    processes: int = 1
    gains: PhotoGains | None = field(default=None, compare=False)
    reprojection_error: float | None = None
    far_points: float = 0.0


@torch.no_grad()
def gather_facts(
    scene: Scene,
    device: torch.device,
    memory_limit: int | None = None,
    processes: int = 1,
    with_exposures: bool = False,
) -> SceneFacts:
    """The facts of a scene, to be trained on a device.

    Args:
        scene: in host memory.
        memory_limit: bytes of the device that must not be exceeded.
        with_exposures: compare the photos' exposures, which takes longer than all else here.
    """
    views = scene.train
    pixels, test_pixels = (int(part.cameras.sizes.prod(axis=1).sum()) for part in (scene.train, scene.test))
    host_free = free_host_bytes()
    free = free_bytes(device) if device.type == "cuda" else host_free
    distances = (scene.points - views.cameras.centers.mean(dim=0)).norm(dim=1).numpy()
    known = len(distances) > 0 and not scene.drawn_points
    middle, far = np.quantile(distances, (0.5, 0.99)) if known else (0.0, 0.0)
    return SceneFacts(
        train_views=len(views),
        direction_concentration=float(views.cameras.directions.double().mean(dim=0).norm()),
        photo_bytes=(PHOTO_BYTES + views.photos.transparent) * (pixels + test_pixels),
        map_bytes=MAP_BYTES * pixels,
        device=device.type,
        device_bytes=min(free, free if memory_limit is None else memory_limit),
        host_bytes=host_free,
        transparent=views.photos.transparent,
        processes=processes,
        gains=compare_exposures(views, scene.points) if with_exposures else None,
        reprojection_error=scene.reprojection_error,
        far_points=float(far / max(scene.extent, middle)),
    )
