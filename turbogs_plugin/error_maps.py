"""Persistent error and age of every pixel of every training view (paper section 3.3).

The maps of all views lie end to end in one array ("flat pixels"), so views may differ in size. Ages are kept as
the iteration of the last visit ("stamps"): the same ages as the paper's counters at the cost of the sampled pixels
alone. The mean error of a view is kept incrementally; as errors are stored in half precision and their sums in double,
those sums are exact and do not drift.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.types import PixelSamples, Step

AGE_MAX = 32767
"""Ages saturate here, in iterations."""


@dataclass
class ErrorMaps:
    """Error and age of X flat pixels in V views.

    Args:
        sizes: [V, 2] int64 numpy array (width, height).
        device: where the maps live.
        beta: EMA weight of a new error.
    """

    sizes: np.ndarray
    device: torch.device | str = "cpu"
    beta: float = 0.4
    errors: Tensor = field(init=False)  # [X] float16
    stamps: Tensor = field(init=False)  # [X] int16, iteration of the last visit minus `stamp_base`
    view_sums: Tensor = field(init=False)  # [V] float64, sum of `errors` in each view
    stamp_base: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        self.offsets = np.concatenate([[0], np.cumsum(self.sizes.prod(axis=1))])  # [V + 1]
        pixels = int(self.offsets[-1])
        self.errors = torch.zeros(pixels, dtype=torch.float16, device=self.device)
        self.stamps = torch.zeros(pixels, dtype=torch.int16, device=self.device)
        self.view_sums = torch.zeros(len(self.sizes), dtype=torch.float64, device=self.device)

    def flat_pixels(self, samples: PixelSamples) -> Tensor:
        """[P] int64: flat pixel of each slot; an empty slot gets the first pixel of its view."""
        starts = torch.as_tensor(self.offsets[list(samples.view_ids)], device=samples.pixel_ids.device)
        return starts[samples.view_of_slot()] + samples.pixel_ids.long().clamp(min=0)

    def initialise(self, view_id: int, errors: Tensor) -> None:
        """Set the errors of one whole view. `errors`: [H * W] float; non-finite ones count as zero."""
        raise NotImplementedError

    def update(self, samples: PixelSamples, pixel_errors: Tensor, step: Step) -> None:
        """EMA of the errors, stamps and view sums at the samples; non-finite errors change nothing.
        `pixel_errors`: [P] float."""
        raise NotImplementedError

    def ages(self, view_id: int, step: Step) -> Tensor:
        """[H * W] int32: iterations since each pixel of a view was last sampled, saturated at `AGE_MAX`."""
        raise NotImplementedError

    def view_means(self) -> np.ndarray:
        """[V] float64 on the host: mean error of each view."""
        return self.view_sums.cpu().numpy() / self.sizes.prod(axis=1)
