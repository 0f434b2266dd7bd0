"""Photos of lenses with distortion, turned into those of a pinhole camera in the same place.

Only a lens's projection is used, never its inverse: a rectangle of the pinhole's image plane is grown about the middle
of the photo for as long as all of it is seen there, and the map from it to the photo is kept on a lattice. So a pinhole
image has no pixel without a source, whatever the model of the lens.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial, reduce
from typing import TYPE_CHECKING

import numpy as np
import torch
import torch.nn.functional as F

from turbogs_plugin.errors import InputError

if TYPE_CHECKING:
    import pycolmap

Projection = Callable[[np.ndarray], np.ndarray]
"""[N, 2] float64 points at depth 1 before the camera -> [N, 2] pixels of the photo (the first one's centre is at 0.5),
NaN where there is none."""
Test = Callable[[np.ndarray], np.ndarray]
"""[R, 4] rectangles -> [R] bool."""

WIDEST_ANGLE = math.radians(60.0)
"""No side of the pinhole image is farther off the axis: a fisheye's rim would become a smear."""
LARGEST_GROWTH = 2.0
"""The pinhole image has at most this many times the sides of the photo (COLMAP's `max_scale`)."""
LATTICE = 129
"""Nodes of a map along either side. Between them it is linear: off by less than 0.05 pixels in strong distortion."""
SIDE_POINTS, CANDIDATES, ROUNDS = 33, 17, 4
"""Points of a side that are looked at; rectangles tried in a round; rounds, each within a step of the one before."""
GROWTH = ([0, 1, 2, 3], [0, 2], [1, 3], [0], [1], [2], [3])
"""Sides (left, top, right, bottom) that a rectangle grows to in turn: with the photo's proportions at first."""
SMALLEST_SHARE = 0.1
"""A pinhole image that covers less of the photo's width or height is not one of a lens."""
EDGE, LATTICE_EDGE = 0.02, 0.5
"""Pixels by which a rectangle's outline, and a node of the map, may leave the photo: they are between points seen."""
ROWS_AT_ONCE = 256


@dataclass(frozen=True, eq=False)
class Lens:
    """A camera with distortion and the pinhole camera that takes its place.

    Args:
        model: name of the camera model, as COLMAP has it.
        photo_size: (width, height) of the photos that it was calibrated on.
        size: (width, height) of the pinhole's images.
        K: [3, 3] float64, intrinsics of the pinhole.
        sources: [LATTICE, LATTICE, 2] float32: where in the photo the pinhole's image comes from, at nodes that span it
            from edge to edge; x and y are -1 .. 1 from edge to edge of the photo, so photos of any size will do.
    """

    model: str
    photo_size: tuple[int, int]
    size: tuple[int, int]
    K: np.ndarray
    sources: np.ndarray

    def size_of(self, photo_size: tuple[int, int]) -> tuple[int, int]:
        """(width, height) of the pinhole's image for photos of another size than those that it was calibrated on."""
        ratios = np.divide(photo_size, self.photo_size)
        width, height = np.floor(self.size * ratios + 0.5).astype(np.int64).tolist()
        return max(width, 1), max(height, 1)

    def undistort(self, photo: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """The pinhole's image, bilinearly.

        Args:
            photo: [h, w, C] uint8, of any size with the proportions of `photo_size`.
            size: (width, height) of the result, with the proportions of the pinhole's.

        Returns:
            [height, width, C] uint8.
        """
        width, height = size
        planes = torch.from_numpy(np.ascontiguousarray(photo.transpose(2, 0, 1), dtype=np.float32))[None]
        across, down = _weights(width), _weights(height)
        result = np.empty((height, width, photo.shape[2]), dtype=np.uint8)
        for first in range(0, height, ROWS_AT_ONCE):  # a whole map would take more than the photo
            rows = slice(first, first + ROWS_AT_ONCE)
            lines = _between(self.sources, down[0][rows], down[1][rows, None, None])  # [R, LATTICE, 2]
            grid = _between(lines.transpose(1, 0, 2), across[0], across[1][:, None, None])  # [width, R, 2]
            grid = torch.from_numpy(np.ascontiguousarray(grid.transpose(1, 0, 2)))[None]
            band = F.grid_sample(planes, grid, padding_mode="border", align_corners=False)[0]
            result[rows] = band.add_(0.5).to(torch.uint8).permute(1, 2, 0).numpy()
        return result


def _weights(pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """The node before each pixel's centre, int64, and how far on it lies towards the next one, float32."""
    places = (np.arange(pixels) + 0.5) * ((LATTICE - 1) / pixels)
    before = np.minimum(places.astype(np.int64), LATTICE - 2)
    return before, (places - before).astype(np.float32)


def _between(nodes: np.ndarray, before: np.ndarray, share: np.ndarray) -> np.ndarray:
    start = nodes[before]
    return start + share * (nodes[before + 1] - start)


def lens_of_camera(camera: pycolmap.Camera, owner: str) -> Lens:
    """The lens of a camera of any of COLMAP's models.

    Args:
        owner: names the camera in messages.

    Raises:
        InputError: parameters that are not those of a lens; a panorama, which no pinhole camera can show.
    """
    model = camera.model.name
    if not camera.is_perspective():
        raise InputError(
            f"{owner} is {model}, a panorama: cut it into perspective photos and reconstruct these "
            "(pycolmap's example panorama_sfm.py does both)"
        )
    if not np.isfinite(camera.params).all():
        raise _no_lens(model, owner)

    def project(points: np.ndarray) -> np.ndarray:
        return camera.img_from_cam(np.concatenate([points, np.ones((len(points), 1))], axis=1))

    return make_lens(model, (camera.width, camera.height), project, owner)


def brown_projection(
    focal: Sequence[float], center: Sequence[float], radial: Sequence[float], p1: float, p2: float
) -> Projection:
    """OpenCV's model with any number of radial coefficients, all in the numerator as Metashape and nerfstudio have it.

    COLMAP's models go to the third one, or put the fourth in a denominator (FULL_OPENCV).
    """

    def project(points: np.ndarray) -> np.ndarray:
        x, y = points.T
        squared = x * x + y * y
        stretch = 1.0 + reduce(lambda rest, k: (rest + k) * squared, reversed(radial), 0.0)
        bent_x = x * stretch + 2.0 * p1 * x * y + p2 * (squared + 2.0 * x * x)
        bent_y = y * stretch + 2.0 * p2 * x * y + p1 * (squared + 2.0 * y * y)
        return np.stack([focal[0] * bent_x + center[0], focal[1] * bent_y + center[1]], axis=1)

    return project


def make_lens(model: str, photo_size: tuple[int, int], project: Projection, owner: str) -> Lens:
    """The largest pinhole image about the photo's middle that the photo fills, as fine as the photo is on its axis.

    Raises:
        InputError: the projection is not that of a lens.
    """
    with np.errstate(all="ignore"):
        axis, right, down = project(np.array([[0.0, 0.0], [1e-5, 0.0], [0.0, 1e-5]]))
        focal = np.array([right[0] - axis[0], down[1] - axis[1]]) / 1e-5
        sides = np.array(photo_size, dtype=np.float64)
        if not (np.isfinite([*axis, *focal]).all() and (focal > 0).all()):
            raise _no_lens(model, owner)
        middle = (0.5 * sides - axis) / focal
        reach = 0.5 * LARGEST_GROWTH * sides / focal
        widest = math.tan(WIDEST_ANGLE)
        seed = np.concatenate([middle, middle])
        limit = np.clip(np.concatenate([middle - reach, middle + reach]), -widest, widest)
        inside, upright = (partial(test, project=project, sides=sides) for test in (_inside, _upright))
        rectangle = seed
        for sides_grown in GROWTH:
            target = rectangle.copy()
            target[sides_grown] = limit[sides_grown]
            rectangle = _furthest(rectangle, target, inside, upright)
        width, height = np.floor(focal * (rectangle[2:] - rectangle[:2]) + 1e-3).astype(np.int64).tolist()
        if not min(width, height) >= 1:
            raise _no_lens(model, owner)
        corner = 0.5 * (rectangle[:2] + rectangle[2:] - np.array([width, height]) / focal)
        x = np.linspace(corner[0], corner[0] + width / focal[0], LATTICE)
        y = np.linspace(corner[1], corner[1] + height / focal[1], LATTICE)
        nodes = project(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
        least, most = (np.array([end(side) for side in nodes.T]) for end in (np.min, np.max))
        fits = (least >= -LATTICE_EDGE) & (most <= sides + LATTICE_EDGE) & (most - least >= SMALLEST_SHARE * sides)
        nodes = nodes.reshape(LATTICE, LATTICE, 2)
        if not fits.all() or not (_turn(nodes[:-1, 1:] - nodes[:-1, :-1], nodes[1:, :-1] - nodes[:-1, :-1]) > 0).all():
            raise _no_lens(model, owner)
    K = np.array([[focal[0], 0.0, -focal[0] * corner[0]], [0.0, focal[1], -focal[1] * corner[1]], [0.0, 0.0, 1.0]])
    return Lens(model, photo_size, (width, height), K, (2.0 * nodes / sides - 1.0).astype(np.float32))


@cache
def _outline() -> np.ndarray:
    """[4, 2 * B] float64: a rectangle (x0, y0, x1, y1) times this is the B points of its outline, x and y in turn."""
    share = np.linspace(0.0, 1.0, SIDE_POINTS)
    zero, one = np.zeros_like(share), np.ones_like(share)
    weights = np.zeros((4, 4 * SIDE_POINTS, 2))
    for axis, ends in enumerate(((share, share, zero, one), (zero, one, share, share))):
        weights[axis + 2, :, axis] = np.concatenate(ends)
        weights[axis, :, axis] = 1.0 - weights[axis + 2, :, axis]
    return weights.reshape(4, -1)


def _inside(rectangles: np.ndarray, project: Projection, sides: np.ndarray) -> np.ndarray:
    """[R] bool: the outline of each of the [R, 4] rectangles (x0, y0, x1, y1) lies in the photo."""
    points = rectangles @ _outline()
    pixels = project(points.reshape(-1, 2)).reshape(points.shape)
    furthest = np.tile(sides + EDGE, points.shape[1] // 2)
    return ((pixels >= -EDGE) & (pixels <= furthest)).all(axis=1)


def _upright(rectangles: np.ndarray, project: Projection, sides: np.ndarray) -> np.ndarray:
    """[R] bool: the outline of each of the [R, 4] rectangles is seen, and nowhere mirrored."""
    points = rectangles @ _outline()
    steps = np.tile(1e-5 * np.eye(2), points.shape[1] // 2)
    moved = np.stack([points, points + steps[0], points + steps[1]])
    here, right, down = project(moved.reshape(-1, 2)).reshape(3, len(rectangles), -1, 2)
    return (_turn(right - here, down - here) > 0).all(axis=1)


def _turn(x_step: np.ndarray, y_step: np.ndarray) -> np.ndarray:
    """Positive where [..., 2] steps to the right and down in the pinhole's image keep their sense in the photo."""
    return x_step[..., 0] * y_step[..., 1] - x_step[..., 1] * y_step[..., 0]


def _furthest(start: np.ndarray, end: np.ndarray, inside: Test, upright: Test) -> np.ndarray:
    """The last [4] rectangle from `start` to `end` before the first that the photo does not fill."""
    shares = np.linspace(0.0, 1.0, CANDIDATES)[1:, None]
    if not inside(start + shares[0] ** np.arange(1, ROUNDS + 1)[:, None] * (end - start)).any():
        return start  # as the rounds would find: after the first growths few sides have room
    folds = True  # between rectangles that are upright none is mirrored
    for _ in range(ROUNDS):
        rectangles = start + shares * (end - start)
        ok = inside(rectangles)
        if folds:
            tried = len(ok) if ok.all() else int(np.argmin(ok)) + 1
            straight = upright(rectangles[:tried])
            ok[:tried] &= straight
        if ok.all():
            return end
        first = int(np.argmin(ok))
        folds = folds and not straight[first]
        start, end = (rectangles[first - 1] if first else start), rectangles[first]
    return start


def _no_lens(model: str, owner: str) -> InputError:
    return InputError(
        f"{owner} is {model} with parameters that are not those of a lens: nothing of its photos can be undistorted; "
        "reconstruct the capture again"
    )


def undistortion_note(lenses: Sequence[Lens | None]) -> str:
    """What was done to the photos of these lenses, one each, in one line; empty where nothing was."""
    if not (bent := [lens for lens in lenses if lens is not None]):
        return ""
    different = {id(lens): lens for lens in bent}
    first = bent[0]
    photo, image = ("x".join(map(str, size)) for size in (first.photo_size, first.size))
    more = f", and {len(different) - 1} more cameras" if len(different) > 1 else ""
    return f"{len(bent)} photos undistorted: {first.model} {photo} -> PINHOLE {image}{more}"
