"""Numbers about a scene and a machine that decisions rest on, from a bounded number of its pixels and points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from turbogs_plugin.error_maps import MAP_BYTES
from turbogs_plugin.plan.exposures import LUMINANCE, compare_exposures
from turbogs_plugin.plan.sight import Sight
from turbogs_plugin.scene import PosedImages, Scene
from turbogs_plugin.scene.host_arrays import free_host_bytes
from turbogs_plugin.scene.photos import PHOTO_BYTES
from turbogs_plugin.tiles import TILE_PIXELS
from turbogs_plugin.types import TILE_SIZE

FLAT_DEVIATION = 0.01
"""Standard deviation of luminance (0 .. 1) below which a tile has no texture: 2.5 of 255 steps, a camera's noise."""
TILES_AT_MOST = 6400
"""Tiles examined, over all photos."""
TILES_PER_PHOTO = 64
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
        extent: radius of the scene in the capture's own unit.
        baseline: median distance of a training camera to its nearest, over the median depth of the points it sees.
        flat_tiles: share of the photos' 16x16 tiles without texture (`FLAT_DEVIATION`).
        exposure_spread, exposure_jumps, exposure_views: how far photos differ in brightness and white balance, in stops
            (`compare_exposures`): all from their mean; each from its neighbours; and of how many photos this is.
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
    flat_tiles: float
    exposure_spread: float
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
    exposure_jumps: float = 0.0
    exposure_views: int = 0


@torch.no_grad()
def gather_facts(
    scene: Scene,
    device: torch.device,
    *,
    memory_limit: int | None = None,
    time_budget: float | None = None,
    processes: int = 1,
) -> SceneFacts:
    """The facts of a scene, to be trained on a device.

    Args:
        scene: on any device; photos that are already on `device` count as free memory, for they are planned here.
        device: where training is to be.
        memory_limit: bytes of the device that must not be exceeded.
        time_budget: seconds.
        processes: that will train together.
    """
    views, sizes = scene.train, scene.train.cameras.sizes
    order = np.lexsort((sizes[:, 0], sizes.prod(axis=1)))  # of equally many pixels, upright ones first
    pixels, test_pixels = int(sizes.prod(axis=1).sum()), int(scene.test.cameras.sizes.prod(axis=1).sum())
    sight = Sight.of(views, scene.points)
    exposures = compare_exposures(views, sight)
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
        flat_tiles=flat_tile_share(views),
        exposure_spread=exposures.spread,
        exposure_jumps=exposures.jumps,
        exposure_views=int(exposures.compared.sum()),
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
    )


def flat_tile_share(views: PosedImages) -> float:
    """Share of whole 16x16 tiles whose luminance deviates less than `FLAT_DEVIATION`, of tiles spread evenly. Those
    with masked pixels are left out."""
    colors, offsets = views.photos.stored, views.photos.offsets
    per_photo = max(1, min(TILES_PER_PHOTO, TILES_AT_MOST // len(views)))
    within = np.arange(TILE_SIZE)
    places = []
    for view, (width, height) in enumerate(views.photos.sizes.tolist()):
        columns, rows = width // TILE_SIZE, height // TILE_SIZE
        if columns * rows:
            tiles = np.unique(np.linspace(0, columns * rows - 1, per_photo).astype(np.int64))
            y = (tiles // columns * TILE_SIZE)[:, None, None] + within[:, None]
            x = (tiles % columns * TILE_SIZE)[:, None, None] + within
            inside = (y * width + x).reshape(len(tiles), -1)
            if views.masks is not None:
                inside = inside[views.masks.image(view).reshape(-1).numpy()[inside].all(axis=1)]
            places.append(int(offsets[view]) + inside)
    flat = torch.from_numpy(np.concatenate(places or [np.zeros((0, TILE_PIXELS), dtype=np.int64)]))  # [T, 256]
    if not len(flat):
        return 0.0
    pixels = colors[flat.to(colors.device)][..., :3].float()  # [T, 256, 3], transparent colours on black
    luminance = pixels @ (torch.from_numpy(LUMINANCE).to(colors.device) / 255.0)
    return float((luminance.std(dim=1, correction=0) < FLAT_DEVIATION).float().mean())


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
