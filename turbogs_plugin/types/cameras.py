"""Cameras of photos, where these show points, and colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

Color = tuple[float, float, float]
"""Red, green and blue, 0 .. 1."""

BLACK: Color = (0.0, 0.0, 0.0)
WHITE: Color = (1.0, 1.0, 1.0)


class Cameras:
    """C pinhole cameras; their images may differ in size.

    Args:
        viewmats: [C, 4, 4] float, world to camera (x right, y down, z forward).
        Ks: [C, 3, 3] float, intrinsics in pixels; the centre of the first pixel is (0.5, 0.5).
        sizes: [C, 2] int64 numpy array (width, height), on the host so that shapes cost no synchronisation.

    Attributes:
        viewmats, Ks, sizes: as given, or the selected rows of them after `select`.
    """

    def __init__(self, viewmats: Tensor, Ks: Tensor, sizes: np.ndarray) -> None:
        self.sizes = sizes
        # Rows of selected cameras in the two tensors, which then belong to the cameras that they were selected from.
        self._rows: tuple[int, ...] | None = None
        self._viewmats, self._Ks = viewmats, Ks

    def __repr__(self) -> str:
        return f"{len(self)} cameras of {' or '.join(f'{w}x{h}' for w, h in np.unique(self.sizes, axis=0)[:3])}"

    def __len__(self) -> int:
        return self._viewmats.shape[0] if self._rows is None else len(self._rows)

    @property
    def viewmats(self) -> Tensor:
        self._stack()
        return self._viewmats

    @property
    def Ks(self) -> Tensor:
        self._stack()
        return self._Ks

    def select(self, view_ids: Sequence[int]) -> Cameras:
        """The cameras of these views, in this order; `range` for a run of them. Nothing is launched on a device.

        The selected cameras share memory with the present ones until their `viewmats` or `Ks` are read, which makes a
        copy. Where gradients flow to the present cameras, the copy is made at once.
        """
        own = range(len(self)) if self._rows is None else self._rows
        chosen = Cameras(self._viewmats, self._Ks, self.sizes[np.asarray(view_ids, dtype=np.int64)])
        chosen._rows = tuple([own[view] for view in view_ids])
        if self._viewmats.requires_grad or self._Ks.requires_grad:
            chosen._stack()
        return chosen

    def by_row(self) -> tuple[Tensor, Tensor, Sequence[int]]:
        """(viewmats [V, 4, 4], Ks [V, 3, 3], C rows): where the matrices of each camera lie, for code that reads them
        there and needs no tensor of these cameras alone. Nothing may be written to them."""
        return self._viewmats, self._Ks, range(len(self)) if self._rows is None else self._rows

    def _stack(self) -> None:
        """Give selected cameras matrices of their own."""
        rows = self._rows
        if rows is not None:
            # Stacked, not indexed: so no index has to be copied to the device.
            viewmats, Ks = (torch.stack([of[row] for row in rows]) for of in (self._viewmats, self._Ks))
            self._viewmats, self._Ks, self._rows = viewmats, Ks, None

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Cameras:
        return Cameras(self.viewmats.to(device, dtype), self.Ks.to(device, dtype), self.sizes)

    @property
    def centers(self) -> Tensor:
        """[C, 3] camera centres in the world."""
        rotations, translations = self.viewmats[:, :3, :3], self.viewmats[:, :3, 3]
        return -(rotations * translations[:, :, None]).sum(dim=1)  # a product of matrices would start cuBLAS

    @property
    def directions(self) -> Tensor:
        """[C, 3] unit viewing directions in the world."""
        return torch.nn.functional.normalize(self.viewmats[:, 2, :3], dim=-1)


@dataclass(frozen=True)
class Observations:
    """Places where V photos show points; the centre of a photo's first pixel is (0.5, 0.5)."""

    pixels: np.ndarray  # [O, 2] float64
    view_ids: np.ndarray  # [O] int64, ascending
    point_ids: np.ndarray  # [O] int64

    def __len__(self) -> int:
        return len(self.pixels)

    def of_views(self, views: np.ndarray, ratios: np.ndarray) -> Observations:
        """The observations by some views ([W] int64, ascending), which become the first, second, ...; in pixels of
        photos of another size, by the `ratios` [W, 2] of width and height."""
        starts, ends = (np.searchsorted(self.view_ids, views, side) for side in ("left", "right"))
        rows = np.concatenate([np.arange(*ends_of) for ends_of in zip(starts, ends, strict=True)] or [starts])
        now = np.repeat(np.arange(len(views)), ends - starts)
        return Observations(self.pixels[rows] * ratios[now], now, self.point_ids[rows])
