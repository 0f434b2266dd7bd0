"""Further points to start from, where photos show something and the capture has no point.

A reconstruction has points where photos have texture that several of them share: few at the edges of a capture, where
one or two photos look, and none on a plain wall. What is learnt there must grow in from elsewhere, at depths that one
photo does not tell. So each photo is cut into cells, and a cell without a point gets one at the depth that the cells
around it suggest.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.masks import PixelMasks
from turbogs_plugin.scene.photos import Photos
from turbogs_plugin.scene.poses import evenly
from turbogs_plugin.types import Cameras

REACH = 6
"""An empty cell goes by the cells with points that are at most so many cells away. Where there are none it stays empty:
sky, for instance."""
LEAST_CELLS = 3
"""So many of these there must be."""
NEARER = 0.25
"""The depth of a cell with points is that of the one at this rank among them, the nearest first: of several surfaces
behind each other the photo shows a near one."""
BEYOND = 1.25
"""A suggested depth is at most so many times the farthest that it goes by, and at least the nearest over this."""
OPAQUE = 128
"""Least alpha, of 255, of a pixel that shows something."""
MOST_VIEWS, MOST_POINTS = 256, 200_000
"""Of more views, so many are filled, evenly spread; of more points, about so many are looked at."""


def filled_points(
    points: Tensor, cameras: Cameras, photos: Photos, cells: int, masks: PixelMasks | None = None
) -> tuple[Tensor, Tensor]:
    """Points for the empty cells of the photos, and their colours. The same for the same arguments on any machine.

    A photo is cut into square cells, `cells` of them along its longer side. An empty cell's inverse depth is that of a
    plane through the inverse depths of the cells around it, by least squares with weights (distance + 1/2)^-4 in cells:
    of a plane in space the inverse depth is a plane in the image. One photo comes after the other, and what one got
    counts as points for the next.

    Args:
        points: [M, 3] float32, those of the capture.
        cameras, photos: of the training views, in the same coordinates.
        masks: which pixels count; None: all.

    Returns:
        [F, 3] float32 points and [F, 3] uint8 colours, on the CPU.
    """
    viewmats, Ks = (value.cpu().double().numpy() for value in (cameras.viewmats, cameras.Ks))
    known = points[:: max(1, len(points) // MOST_POINTS)].cpu().double().numpy()
    found, colors = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.uint8)]
    for view in evenly(len(photos), MOST_VIEWS):
        viewmat, K, size = viewmats[view], Ks[view], photos.sizes[view]
        side = size.max() / cells
        in_camera = np.concatenate([known, *found]) @ viewmat[:3, :3].T + viewmat[:3, 3]
        inverse_depths = _inverse_depths(in_camera, K, size, side)
        suggested = _suggested(inverse_depths)
        rows, columns = ((inverse_depths == 0) & (suggested > 0)).nonzero()
        middles = np.minimum((np.column_stack([columns, rows]) + 0.5) * side, size - 0.5)
        shown, seen = _colors(photos, view, middles.astype(np.int64), masks)
        rays = np.column_stack([(middles - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones(len(middles))])
        places = rays / suggested[rows, columns, None]
        found.append(((places - viewmat[:3, 3]) @ viewmat[:3, :3])[seen])
        colors.append(shown[seen])
    return torch.from_numpy(np.concatenate(found)).float(), torch.from_numpy(np.concatenate(colors))


def _inverse_depths(in_camera: np.ndarray, K: np.ndarray, size: np.ndarray, side: float) -> np.ndarray:
    """[rows, columns]: the inverse depth of each cell of an image; 0 where it has no point.

    Args:
        in_camera: [M, 3] points in the camera's coordinates.
        size: [2] (width, height).
    """
    columns, rows = (math.ceil(length / side) for length in size)
    depths = in_camera[:, 2]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        places = (in_camera @ K.T)[:, :2] / depths[:, None]
        inside = (depths > 0) & ((places >= 0) & (places < size)).all(axis=1)
    columns_of, rows_of = (places[inside] // side).astype(np.int64).T
    cells, inverse = rows_of * columns + columns_of, 1.0 / depths[inside]
    order = np.lexsort((-inverse, cells))  # cell after cell, in each the nearest first
    present, firsts, counts = np.unique(cells[order], return_index=True, return_counts=True)
    grid = np.zeros(rows * columns)
    grid[present] = inverse[order[firsts + (NEARER * (counts - 1)).astype(np.int64)]]
    return grid.reshape(rows, columns)


def _suggested(inverse_depths: np.ndarray) -> np.ndarray:
    """[rows, columns]: what the cells around each one suggest as its inverse depth; 0 where there are too few.

    Args:
        inverse_depths: [rows, columns], 0 where a cell has none.
    """
    along = np.arange(-REACH, REACH + 1.0)
    y, x = (part.ravel() for part in np.meshgrid(along, along, indexing="ij"))
    distances = np.hypot(x, y)
    weights = np.where(distances <= REACH, (distances + 0.5) ** -4.0, 0.0)
    powers = np.stack([np.ones_like(x), x, y])  # [3, window]
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(inverse_depths, REACH), (len(along), len(along)))
    values = windows.reshape(-1, len(x))  # [cells, window]
    present = (values > 0) * (distances <= REACH)
    normal = (present @ (weights * powers[:, None] * powers).reshape(9, -1).T).reshape(-1, 3, 3)
    # A slight pull towards a plane that faces the camera settles cells in one line, and keeps the system regular.
    normal[:, [1, 2], [1, 2]] += 1e-3 * normal[:, :1, 0]
    enough = present.sum(axis=1) >= LEAST_CELLS
    normal[~enough] = np.eye(3)
    plane = np.linalg.solve(normal, (values @ (weights * powers).T)[..., None])[:, 0, 0]
    nearest = np.where(present, values, 0.0).max(axis=1)
    farthest = np.where(present, values, np.inf).min(axis=1)
    plane = np.clip(plane, farthest / BEYOND, nearest * BEYOND)
    return np.where(enough, plane, 0.0).reshape(inverse_depths.shape)


def _colors(photos: Photos, view: int, pixels: np.ndarray, masks: PixelMasks | None) -> tuple[np.ndarray, np.ndarray]:
    """[E, 3] uint8 colours of pixels of a view, and [E] bool, whether these show something and are not masked.

    Args:
        pixels: [E, 2] (x, y).
    """
    flat = torch.from_numpy(pixels[:, 1] * int(photos.sizes[view, 0]) + pixels[:, 0])
    stored = photos.stored[(flat + int(photos.offsets[view])).to(photos.stored.device)].cpu()
    seen = stored[:, 3] >= OPAQUE if photos.transparent else torch.ones(len(stored), dtype=torch.bool)
    if masks is not None:
        seen &= masks.image(view).reshape(-1).cpu()[flat]
    return stored[:, :3].numpy(), seen.numpy()
