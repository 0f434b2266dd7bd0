"""Axes of cameras in captures without points: a file in OpenCV's axes (y down, z forward) that is read as OpenGL's has
each camera look the other way, its photo mirrored. No point tells it, but features of neighbouring photos do."""

from __future__ import annotations

import numpy as np

from turbogs_plugin.captures.colmap import load_pycolmap
from turbogs_plugin.errors import InputError
from turbogs_plugin.reconstruct.solver import EPIPOLAR_SHARE, epipolar_distances
from turbogs_plugin.scene.agreement import OTHER_AXES, OTHER_AXES_REMEDY
from turbogs_plugin.scene.geometry import camera_centers, evenly
from turbogs_plugin.scene.scene import PosedImages, Scene

PAIRS, LONG_SIDE, FEATURES = 5, 640, 800
"""Pairs of photos, the pixels of the longer side to which they are reduced, and features of each, at most."""
RATIO = 0.8  # of the distances of the nearest and the second descriptor, at most (Lowe, 2004)
FEWEST_MATCHES, SHARE, FACTOR = 40, 0.5, 3
"""Matches that tell; and the share of them that agrees with other axes, and its ratio to the share that agrees with the
given ones, where these are wrong. Of seven captures .77 to .99 agree with the right axes, at most .18 with others."""


def require_axes(scene: Scene) -> None:
    """Refuse a scene whose photos agree with OpenCV's axes alone: `InputError` with the remedy."""
    matches, given, other = axes_votes(scene.train)
    if matches >= FEWEST_MATCHES and other > SHARE * matches and other > FACTOR * given:
        votes = f"{other} of {matches} matches of neighbouring photos agree with OpenCV's axes, {given} with these"
        raise InputError(f"'{scene.name}': {votes}: {OTHER_AXES_REMEDY}; scene.force=true trains all the same")


def axes_votes(views: PosedImages) -> tuple[int, int, int]:
    """Matches of neighbouring photos, and those of one point before both cameras: as given, and with `OTHER_AXES`."""
    viewmats = views.cameras.viewmats.cpu().double().numpy()
    centers, votes = camera_centers(viewmats), np.zeros(3, dtype=np.int64)
    for first in evenly(len(views), PAIRS):
        distances = np.linalg.norm(centers - centers[first], axis=1)
        distances[(distances < 1e-6) | (viewmats[:, 2, :3] @ viewmats[first, 2, :3] < 0.8)] = np.inf  # 37 degrees
        second = int(distances.argmin())
        if np.isfinite(distances[second]):
            rays = _matches(views, first, second)
            relative = viewmats[second] @ np.linalg.inv(viewmats[first])
            votes += [len(rays[0]), *(_agreeing(axes @ relative @ axes, *rays) for axes in (np.eye(4), OTHER_AXES))]
    return tuple(votes.tolist())


def _agreeing(relative: np.ndarray, first: np.ndarray, second: np.ndarray) -> int:
    """How many matches, [N, 3] rays (z = 1), two cameras that are `relative` [4, 4] to each other see as one point."""
    turned, shift = first @ relative[:3, :3].T, relative[:3, 3]
    # Depths a and b with a turned + shift = b second, by least squares; of parallel rays neither is positive.
    aa, ab, bb = (turned**2).sum(axis=1), (turned * second).sum(axis=1), (second**2).sum(axis=1)
    a, b = (second @ shift) * ab - (turned @ shift) * bb, (second @ shift) * aa - (turned @ shift) * ab
    return int(((a > 0) & (b > 0) & (epipolar_distances(relative, first, second) < EPIPOLAR_SHARE)).sum())


def _matches(views: PosedImages, *pair: int) -> tuple[np.ndarray, np.ndarray]:
    """[N, 3] rays (z = 1) of each of two photos, by SIFT features that are nearest to each other."""
    pycolmap = load_pycolmap()
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    options = pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=1)
    options.sift.max_num_features, options.sift.first_octave = FEATURES, 0
    rays, descriptors = [], []
    for view in pair:
        photo = views.photos.image(view).cpu().numpy().mean(axis=2) * 255
        step = -(-max(photo.shape) // LONG_SIDE)
        height, width = (side // step for side in photo.shape)
        photo = photo[: height * step, : width * step].reshape(height, step, width, step).mean(axis=(1, 3))
        points, found = pycolmap.FeatureExtractor.create(options).extract_from_uint8_array(photo.astype(np.uint8))
        pixels = np.array([(point.x * step, point.y * step, 1.0) for point in points]).reshape(-1, 3)
        rays.append(pixels @ np.linalg.inv(views.cameras.Ks[view].cpu().double().numpy()).T)
        descriptors.append(np.asarray(found.data, dtype=np.float32).reshape(-1, 128))
    if min(map(len, rays)) < 2:
        return rays[0][:0], rays[1][:0]
    first, second = (each / np.maximum(np.linalg.norm(each, axis=1, keepdims=True), 1e-9) for each in descriptors)
    gaps = np.sqrt(np.maximum(2.0 - 2.0 * first @ second.T, 0.0))  # [N, M]
    nearest, (one, two) = gaps.argmin(axis=1), np.partition(gaps, 1, axis=1)[:, :2].T
    told = (gaps.argmin(axis=0)[nearest] == np.arange(len(gaps))) & (one < RATIO * two)
    return rays[0][told], rays[1][nearest[told]]
