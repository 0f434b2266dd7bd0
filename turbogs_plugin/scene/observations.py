"""Where photos show the points of a reconstruction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Observations:
    """Where V photos show points.

    Args:
        pixels: [O, 2] float64; the centre of the first pixel is (0.5, 0.5).
        view_ids: [O] int64, ascending.
        point_ids: [O] int64.
    """

    pixels: np.ndarray
    view_ids: np.ndarray
    point_ids: np.ndarray

    def __len__(self) -> int:
        return len(self.pixels)

    def of_views(self, views: np.ndarray, ratios: np.ndarray) -> Observations:
        """Those of some views, which become the first, second, ...; in pixels of photos of another size.

        Args:
            views: [W] int64, ascending.
            ratios: [W, 2], their new width and height over those before.
        """
        starts, ends = (np.searchsorted(self.view_ids, views, side) for side in ("left", "right"))
        rows = np.concatenate([np.arange(*ends_of) for ends_of in zip(starts, ends, strict=True)] or [starts])
        now = np.repeat(np.arange(len(views)), ends - starts)
        return Observations(self.pixels[rows] * ratios[now], now, self.point_ids[rows])
