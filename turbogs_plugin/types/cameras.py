"""Where photos were taken from, and colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

Color = tuple[float, float, float]
"""Red, green and blue, 0 .. 1."""

BLACK: Color = (0.0, 0.0, 0.0)
WHITE: Color = (1.0, 1.0, 1.0)


@dataclass
class Cameras:
    """C pinhole cameras; their images may differ in size.

    Args:
        viewmats: [C, 4, 4] float, world to camera (x right, y down, z forward).
        Ks: [C, 3, 3] float, intrinsics in pixels; the centre of the first pixel is (0.5, 0.5).
        sizes: [C, 2] int64 numpy array (width, height), on the host so that shapes cost no synchronisation.
    """

    viewmats: Tensor
    Ks: Tensor
    sizes: np.ndarray
    _sliced: tuple | None = field(init=False, repr=False, compare=False, default=None)

    def __len__(self) -> int:
        return self.viewmats.shape[0]

    def select(self, view_ids: Sequence[int]) -> Cameras:
        """The cameras of these views, in this order."""
        # Stacked, not indexed: so no index has to be copied to the device.
        viewmats, Ks = (torch.stack([matrices[view] for view in view_ids]) for matrices in self._matrices())
        return Cameras(viewmats, Ks, self.sizes[np.asarray(view_ids, dtype=np.int64)])

    def _matrices(self) -> tuple[Sequence[Tensor], Sequence[Tensor]]:
        """The matrices of each camera, views of `viewmats` and `Ks`. They are kept, as slicing them in each iteration
        takes the host longer than stacking them. Where gradients flow they belong to one graph, and are not kept."""
        if self.viewmats.requires_grad or self.Ks.requires_grad:
            return self.viewmats, self.Ks
        if self._sliced is None or self._sliced[0] is not self.viewmats or self._sliced[1] is not self.Ks:
            self._sliced = self.viewmats, self.Ks, self.viewmats.unbind(), self.Ks.unbind()
        return self._sliced[2:]

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Cameras:
        return Cameras(self.viewmats.to(device, dtype), self.Ks.to(device, dtype), self.sizes)

    @property
    def centers(self) -> Tensor:
        """[C, 3] camera centres in the world."""
        rotations, translations = self.viewmats[:, :3, :3], self.viewmats[:, :3, 3]
        return -(rotations.transpose(1, 2) @ translations[:, :, None])[:, :, 0]

    @property
    def directions(self) -> Tensor:
        """[C, 3] unit viewing directions in the world."""
        return torch.nn.functional.normalize(self.viewmats[:, 2, :3], dim=-1)
