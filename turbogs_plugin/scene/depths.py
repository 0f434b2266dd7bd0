"""Depths that a capture knows at pixels of its photos: d* of Algorithm 1, by which a loss may pull rendered depths."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.errors import InputError
from turbogs_plugin.types import Cameras, PixelSamples
from turbogs_plugin.types.cameras import Observations

CELL = 4
"""Side in pixels of a cell, all of which has the depth of the point that the photo shows in it. On a surface turned
away by an angle a that is off by at most ``4 sqrt(2) tan(a) / focal length`` of itself; at an edge by any amount."""
Maps = Callable[[int, np.ndarray], np.ndarray | None]
"""What gives the inverse depths of the cells of a view, 0 for none, from those [h, w] that points tell; or None."""
FARTHEST_MATCH = 2.0
"""Pixels between a point and where a photo shows it, along an axis, beyond which the pair tells no depth."""


@dataclass(frozen=True)
class InverseDepths:
    """Inverse depths of V training views, along their cameras' axes: one for each cell of `CELL` x `CELL` pixels.

    Args:
        cells: [Y] float32, row by row and view after view, over the scene's unit; 0 where none is known.
        starts: [V] int64, the first cell of each view.
        share: of all pixels those whose depth is known, above 0.
    """

    cells: Tensor
    starts: Tensor
    share: float

    @classmethod
    def of(
        cls, cameras: Cameras, shown: Observations | None, points: Tensor, maps: Maps | None = None
    ) -> InverseDepths:
        """Depths of the points [M, 3] where `shown` has them in photos of these cameras, of several in a cell the
        nearest; elsewhere what `maps` give. Raises `InputError`: no depth is known."""
        shapes = -(-cameras.sizes // CELL)  # [V, 2]
        starts = np.concatenate([[0], np.cumsum(shapes.prod(axis=1))])
        cells = np.zeros(starts[-1], dtype=np.float32)
        places = points.cpu().double().numpy()
        viewmats, Ks = (getattr(cameras, name).cpu().double().numpy() for name in ("viewmats", "Ks"))
        for view, (width, height) in enumerate(shapes):
            own = cells[starts[view] : starts[view + 1]].reshape(height, width)
            if shown is not None:
                rows = slice(*np.searchsorted(shown.view_ids, (view, view + 1)))
                _tell(own, viewmats[view], Ks[view], places[shown.point_ids[rows]], shown.pixels[rows])
            if maps is not None and (given := maps(view, own)) is not None:
                np.copyto(own, given, where=own == 0, casting="same_kind")
        share = np.count_nonzero(cells) * CELL**2 / cameras.sizes.prod(axis=1).sum()
        if not share:
            lacking = "this capture does not say where photos show its points, nor has it depth maps"
            raise InputError(f"loss.depth_weight: {lacking}: set it to 0")
        return cls(torch.from_numpy(cells), torch.from_numpy(starts[:-1]), min(1.0, float(share)))

    def to(self, device: torch.device | str) -> InverseDepths:
        return InverseDepths(self.cells.to(device), self.starts.to(device), self.share)

    def at(self, samples: PixelSamples) -> Tensor:
        """[P] float32: inverse depths at the samples; 0 where none is known. In empty slots anything."""
        views, slots = torch.as_tensor(samples.view_ids, device=self.cells.device), samples.view_of_slot()
        widths = torch.as_tensor(-(-samples.sizes[:, 0] // CELL), device=self.cells.device)
        x, y = (samples.coordinates() // CELL).unbind(dim=1)
        return self.cells[self.starts[views][slots] + y * widths[slots] + x]


def _tell(cells: np.ndarray, viewmat: np.ndarray, K: np.ndarray, points: np.ndarray, pixels: np.ndarray) -> None:
    """Set the inverse depths of a view's cells [h, w] where it shows these points [O, 3], at these pixels [O, 2]."""
    points = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    with np.errstate(all="ignore"):  # points may lie in a camera
        inverse = 1.0 / points[:, 2]
        away = np.abs((points * inverse[:, None]) @ K[:2].T - pixels)
    x, y = np.floor(pixels / CELL).astype(np.int64).T
    told = (x >= 0) & (y >= 0) & (x < cells.shape[1]) & (y < cells.shape[0])
    told &= (inverse > 0) & (away <= FARTHEST_MATCH).all(axis=1)
    np.maximum.at(cells, (y[told], x[told]), inverse[told].astype(np.float32))


@dataclass(frozen=True)
class DepthPair:
    """d and d* of an iteration: depths rendered at its samples [P], 0 for none, and the depths that are known."""

    rendered: Tensor
    known: InverseDepths
