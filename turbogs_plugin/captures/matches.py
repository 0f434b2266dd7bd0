"""Matches of two photos: places that SIFT features take for one point."""

from __future__ import annotations

import numpy as np

from turbogs_plugin.captures.undistort import load_pycolmap
from turbogs_plugin.scene.scene import PosedImages

LONG_SIDE, FEATURES = 640, 800  # pixels of a photo's longer side to which it is reduced, and its features, at most
RATIO = 0.8  # of the distances of the nearest and the second descriptor, at most (Lowe, 2004)
EPIPOLAR_SHARE = 3e-3
"""A match agrees with two cameras that are nearer to its epipolar line than this share of the photos' longer side."""
STILL = 2e-3  # by which a match moves at least, at a focal length of 1: what stands still is a mark, or the ground

Pair = tuple[int, int, np.ndarray, np.ndarray]  # two photos, and [N, 3] rays (z = 1) of their matches in each


def matches(views: PosedImages, one: int, other: int) -> Pair:
    """Two photos with the features of unmasked pixels that are nearest to each other."""
    pycolmap = load_pycolmap()
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    options = pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=1)
    options.sift.max_num_features, options.sift.first_octave = FEATURES, 0
    rays, descriptors = [], []
    for view in (one, other):
        photo = views.photos.image(view).cpu().numpy().mean(axis=2) * 255
        step = -(-max(photo.shape) // LONG_SIDE)
        height, width = (side // step for side in photo.shape)
        photo = photo[: height * step, : width * step].reshape(height, step, width, step).mean(axis=(1, 3))
        points, found = pycolmap.FeatureExtractor.create(options).extract_from_uint8_array(photo.astype(np.uint8))
        pixels = np.array([(point.x * step, point.y * step, 1.0) for point in points]).reshape(-1, 3)
        described = np.asarray(found.data, dtype=np.float32).reshape(-1, 128)
        if (mask := views.mask(view)) is not None:
            columns, lines, _ = pixels.astype(np.int64).T
            pixels, described = (each[mask.cpu().numpy()[lines, columns]] for each in (pixels, described))
        rays.append(pixels @ np.linalg.inv(views.cameras.Ks[view].cpu().double().numpy()).T)
        descriptors.append(described)
    if min(map(len, rays)) < 2:
        return one, other, rays[0][:0], rays[1][:0]
    first, second = (each / np.maximum(np.linalg.norm(each, axis=1, keepdims=True), 1e-9) for each in descriptors)
    gaps = np.sqrt(np.maximum(2.0 - 2.0 * first @ second.T, 0.0))  # [N, M]
    nearest, (least, second_least) = gaps.argmin(axis=1), np.partition(gaps, 1, axis=1)[:, :2].T
    told = (gaps.argmin(axis=0)[nearest] == np.arange(len(gaps))) & (least < RATIO * second_least)
    told &= np.abs(rays[0] - rays[1][nearest]).max(axis=1) > STILL
    return one, other, rays[0][told], rays[1][nearest[told]]


def rigid(pair: Pair) -> np.ndarray:
    """[N] bool: the matches that two cameras in some place agree with, as many as these can be."""
    pycolmap = load_pycolmap()
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=1, height=1, params=[1.0, 0.0, 0.0])
    options = pycolmap.RANSACOptions(max_error=0.5 * EPIPOLAR_SHARE, max_num_trials=1000, random_seed=0)
    found = pycolmap.estimate_essential_matrix(*(rays[:, :2] for rays in pair[2:]), camera, camera, options)
    return np.zeros(len(pair[2]), dtype=bool) if found is None else found["inlier_mask"]


def epipolar_distances(relative: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """[N] Sampson distances of matches from the epipolar lines of two cameras, at a focal length of 1; 0 for cameras in
    one place, which have no lines.

    Args:
        relative: [4, 4], from the first camera to the second.
        first, second: [N, 3], the matches on the cameras' image planes, z = 1.
    """
    if not relative[:3, 3].any():
        return np.zeros(len(first))
    pycolmap = load_pycolmap()
    essential = pycolmap.essential_matrix_from_pose(pycolmap.Rigid3d(relative[:3]))
    return np.sqrt(pycolmap.compute_squared_sampson_error(first[:, :2], second[:, :2], essential))
