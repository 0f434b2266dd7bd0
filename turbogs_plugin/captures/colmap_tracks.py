"""Where the images of a COLMAP reconstruction show its points.

pycolmap makes an object of every feature; a capture has millions of them. So they are taken from ``images.bin`` itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from turbogs_plugin.captures.colmap_check import features_of_images
from turbogs_plugin.captures.undistort import Lens
from turbogs_plugin.scene.scene import Observations

if TYPE_CHECKING:
    import pycolmap

NO_POINT = np.uint64(2**64 - 1)


def read_observations(
    reconstruction: pycolmap.Reconstruction,
    file: Path,
    images: Sequence[pycolmap.Image],
    lenses: dict[int, Lens | None],
    point_ids: np.ndarray,
    called: Path | None = None,
) -> Observations:
    """Those of some images, in pixels of their pinhole cameras.

    Args:
        reconstruction: as it was read.
        file: its ``images.bin``.
        images: the views, in their order.
        lenses: camera id -> its lens; None of a pinhole.
        point_ids: [M] uint64, ascending: the points' identifiers.
        called: as in `features_of_images`.
    """
    features = dict(features_of_images(file, called=called))
    parts = [(np.zeros((0, 2)), np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))]
    for view, image in enumerate(images):
        shown = features[image.image_id]
        shown = shown[shown["point"] != NO_POINT]
        pixels, lens = shown["pixel"].astype(np.float64), lenses[image.camera_id]
        if lens is not None and len(pixels):
            rays = reconstruction.cameras[image.camera_id].cam_from_img(pixels)
            pixels = rays * lens.K[[0, 1], [0, 1]] + lens.K[:2, 2]
        points = np.searchsorted(point_ids, shown["point"])
        known = np.isfinite(pixels).all(axis=1)
        parts.append((pixels[known], np.full(known.sum(), view), points[known]))
    return Observations(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))
