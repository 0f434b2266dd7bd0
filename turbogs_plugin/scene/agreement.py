"""Agreement of a scene's cameras, points and photos. Where they contradict each other, a training runs to its end and
has learnt nothing, so it is refused before its first iteration."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.geometry import evenly, seen
from turbogs_plugin.scene.scene import PosedImages, Scene

SHORTEST_LENS = 0.05
"""Focal length over the photo's width below which it is no number of pixels: a view of 169 degrees or more."""
LEAST_MIDDLE, MOST_MIDDLE = 0.27, 0.9  # principal points of photos of this size lie between, in one axis at least
MOST_POINTS, MOST_PHOTOS, MOST_PIXELS = 20_000, 16, 4096
"""Points, photos, and pixels of a photo that are examined, evenly spread."""
FEWEST_PLACES = 50
"""Places of points in the examined photos, or points if these are fewer, below which the cameras look elsewhere."""
CELLS = 40
"""Cells over a photo's width. The nearest point of a cell is taken for visible, the points behind it for hidden."""
LEAST_LIKENESS, DOUBTED, GAIN, LIKENESS, FEWEST_COLORS = 0.2, 0.3, 0.05, 0.4, 500
"""Likeness below which photos do not show the points; below which they do not if other photos' poses have as much; a
likeness that explains it, and places that tell. Five captures have 0.51 to 0.82, a gain of 0.37 to 0.80; with inverse
poses 0.08 at most, with shuffled photos 0.28 and no gain."""
REORDER = "reorder the quaternions that they are made of: COLMAP's files have w, x, y, z, and scipy x, y, z, w"
ONE_PLACE = 1e-3  # extents: cameras nearer to each other than this stand in one place
OTHER_AXES = np.diag([1.0, -1.0, -1.0, 1.0])  # x right, y down, z forward to x right, y up, z backward, and back
QUARTER = np.eye(4)[[1, 0, 2, 3]] * [[-1.0], [1.0], [1.0], [1.0]]  # a turn of the camera about its axis
UPRIGHT = "turn the photos to how the cameras were found (an EXIF orientation is not followed), and write w and h"
OTHER_AXES_REMEDY = 'write "axes": "opencv" into transforms.json, or multiply columns 2 and 3 of each pose by -1'
INVERT = "invert each pose's matrix (camera to world is taken for world to camera, or the other way round)"


def require_agreement(scene: Scene) -> None:
    """Raise `InputError`, with the likely cause and the remedy, for a scene on which no training can work, by a bounded
    number of its pixels and points."""
    if cause := _contradiction(scene):
        raise InputError(f"'{scene.name}': {cause}; scene.force=true trains all the same")


def off_middle(principal: np.ndarray) -> str:
    """The cause and the remedy where principal points [2], in shares of width and height, are of another size."""
    if not ((principal < LEAST_MIDDLE).all() or (principal > MOST_MIDDLE).all()):
        return ""
    place = f"principal points are at {principal[0]:.2g}, {principal[1]:.2g} of the photos' width and height"
    return f"{place}, not near .5: write the photos' size (w, h), and pixels of it from the upper left corner"


def _contradiction(scene: Scene) -> str:
    """The cause and the remedy of `require_agreement`; empty where nothing contradicts."""
    views = scene.train
    lens = float(np.median(views.cameras.Ks[:, 0, 0].cpu().numpy() / views.cameras.sizes[:, 0]))
    if lens < SHORTEST_LENS:
        return f"focal lengths are {lens:.2g} of the photos' width: write intrinsics in pixels, not in shares of it"
    if cause := off_middle(np.median(views.cameras.Ks[:, :2, 2].cpu().numpy() / views.cameras.sizes, axis=0)):
        return cause
    pixels = [_pixels(views, view_id) for view_id in evenly(len(views), MOST_PHOTOS)]
    if views.photos.transparent and not any(part[:, 3].any() for part in pixels):
        return "all photos are transparent everywhere (alpha 0): write them without alpha"
    if not any(np.ptp(part, axis=0).any() for part in pixels):
        return "each photo has one colour throughout: bring back the photos that the cameras are of"
    if (views.cameras.centers - views.cameras.centers[0]).norm(dim=1).max() < ONE_PLACE:
        return "all cameras are in one place, from where photos tell no depth: give poses with the cameras' places"
    if scene.drawn_points:
        return ""  # nothing says where the scene is
    poses = scene.frame.restore_poses(views.cameras.viewmats.cpu().numpy())  # [V, 4, 4]
    places, correlation = likeness(scene, poses)
    what = "the cameras see no points"
    rolled = likeness(scene, np.roll(poses, len(poses) // 2, axis=0))[1] if correlation < DOUBTED else 0.0
    if places >= FEWEST_COLORS and correlation < max(LEAST_LIKENESS, min(DOUBTED, rolled + GAIN)):
        what = "photos do not show the points where the cameras see them"
    elif places >= min(FEWEST_PLACES, len(scene.points)):
        return ""
    for other, remedy in likely_poses(poses):
        if likeness(scene, other)[1] >= LIKENESS:
            return f"{what}, and with other poses they do: {remedy}"
    return f"{what}: {scene.doubt or 'poses, intrinsics, points and photos must be of one solve and in one frame'}"


def likely_poses(poses: np.ndarray) -> Iterator[tuple[np.ndarray, str]]:
    """Poses that a mistake of the kinds that scripts make has turned into `poses` ([V, 4, 4] world to camera, in the
    capture's coordinates), each with the remedy."""
    inverse = np.linalg.inv(poses)
    yield OTHER_AXES @ poses, f"{OTHER_AXES_REMEDY} (its axes are others)"
    yield inverse, INVERT
    yield OTHER_AXES @ inverse @ OTHER_AXES, INVERT
    yield inverse @ OTHER_AXES, f'{INVERT}, and write "axes": "opencv" into transforms.json'
    for turns in (1, 2, 3):
        yield np.linalg.matrix_power(QUARTER, turns) @ poses, UPRIGHT
    for first in (1, -1):
        yield _reordered(poses, first), REORDER
        for axes in (np.eye(4), OTHER_AXES):
            yield np.linalg.inv(_reordered(inverse @ axes, first) @ axes), REORDER


def _reordered(poses: np.ndarray, first: int) -> np.ndarray:
    """The poses with another order of their quaternions: the numbers are moved by `first` places."""
    from scipy.spatial.transform import Rotation

    reordered = poses.copy()
    quats = np.roll(Rotation.from_matrix(poses[:, :3, :3]).as_quat(), first, axis=1)
    reordered[:, :3, :3] = Rotation.from_quat(quats).as_matrix()
    return reordered


def likeness(scene: Scene, poses: np.ndarray) -> tuple[int, float]:
    """Number of points visible in the examined photos, 0 where most show none; and the correlation of their colours
    with the photos', NaN where either are alike. `poses`: [V, 4, 4] world to camera, in the capture's coordinates."""
    views, rows = scene.train, evenly(len(scene.points), MOST_POINTS)
    points = scene.frame.restore_points(scene.points[rows].double().cpu().numpy())  # [M, 3]
    own = scene.point_colors[rows].cpu().numpy().astype(np.float64)  # [M, 3]
    shown: list[np.ndarray] = []
    for view_id in evenly(len(views), MOST_PHOTOS):
        size = views.cameras.sizes[view_id]
        ids, pixels, depths = seen(points, poses[view_id], views.cameras.Ks[view_id].double().cpu().numpy(), size)
        (columns, lines), width = pixels.astype(np.int64).T, size[0]
        cells = columns * CELLS // width + (CELLS + 1) * (lines * CELLS // width)
        nearest = np.full(cells.max(initial=0) + 1, np.inf)
        np.minimum.at(nearest, cells, depths)
        visible = depths <= 1.05 * nearest[cells]
        photo = _pixels(views, view_id, 1)[(lines * width + columns)[visible], :3].astype(np.float64)
        pair = np.stack([own[ids[visible]], photo])  # [2, N, 3]
        shown.append(pair - pair.mean(axis=1, keepdims=True) if visible.any() else pair)
    first, second = np.concatenate(shown, axis=1)
    with np.errstate(invalid="ignore"):
        correlation = (first * second).sum() / np.sqrt((first**2).sum() * (second**2).sum())
    return len(first) * (2 * sum(pair.shape[1] > 0 for pair in shown) >= len(shown)), float(correlation)


def _pixels(views: PosedImages, view_id: int, step: int | None = None) -> np.ndarray:
    """[N, 3 or 4] uint8: every `step`-th pixel of a photo; None: `MOST_PIXELS` of them."""
    photos = views.photos
    photos.fetch([view_id])
    start, end = photos.offsets[view_id : view_id + 2].tolist()
    return photos.colors[start : end : step or max(1, (end - start) // MOST_PIXELS)].cpu().numpy()
