"""What a run takes of the device's memory.

The peak of a run on a GPU is taken to be ``fixed + per_gaussian * N``, all of it torch's own allocations (the CUDA
context comes on top, with its 0.3 to 0.6 GiB). With K views an iteration, degree-d harmonics (B bands above 0) and
lambda images of S pixels an iteration:

- per Gaussian: 14 + 3 B parameters, two moments of each, a step count and 8 statistics, all of it twice, for an event
  of density control makes the new arrays beside the old (the mean of the last iterations is 14 + 3 B,
  and goes before an event); and for each of the K views `VIEW_BYTES`;
- fixed: photos and maps, or their windows of 2 K views; `SAMPLE_BYTES` for each of lambda S samples; `IMAGE_BYTES` for
  each pixel of the largest photo, which is rendered whole at the start and in evaluations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.error_maps import MAP_BYTES
from turbogs_plugin.errors import InputError
from turbogs_plugin.plan.caps import FEWEST_GAUSSIANS
from turbogs_plugin.plan.pixels import most_images, most_views
from turbogs_plugin.scene.offload import SETS
from turbogs_plugin.scene.photos import PHOTO_BYTES

VIEW_BYTES = 230
"""Bytes of a Gaussian in a view: the rasterizer's instance, radius and gradient record, and its share of the
intersections. Measured on an H200: 213 between 150 and 600 thousand Gaussians (docs/results/h200/bench-step.json)."""
SAMPLE_BYTES = 400
"""Bytes of a sample: draw, colours, gradients, errors, masks of intersections, scratch. Measured there: 320 to 400."""
IMAGE_BYTES = 120
"""Bytes of a pixel of a whole render."""


@dataclass(frozen=True)
class MemoryDemand:
    """Bytes of the device at the peak of a run, as the module's text counts them: ``fixed + per_gaussian * N``.

    Args:
        per_image: of an image of samples; lambda of these are counted in `fixed`.
    """

    fixed: int
    per_gaussian: int
    per_image: int

    @classmethod
    def of(
        cls, config: Config, train_sizes: np.ndarray, test_sizes: np.ndarray, photo_bytes: int = PHOTO_BYTES
    ) -> MemoryDemand:
        """The demand of a configuration whose places of maps and photos are decided.

        Args:
            train_sizes, test_sizes: [V, 2] (width, height) of the training photos, and of the test photos, if any.
            photo_bytes: of a pixel of a photo.
        """
        train, test = train_sizes.prod(axis=1), test_sizes.prod(axis=1)
        pixels, test_pixels = int(train.sum()), int(test.sum())
        largest = int(max(train.max(), test.max(initial=0)))
        num_views = len(train)
        views = most_views(config, num_views)
        window = SETS * views * largest
        photos = window + SETS * largest if config.train.photos_place == "host" else pixels + test_pixels
        maps = window if config.train.maps_place == "host" else pixels
        samples = math.ceil(most_images(config, num_views) * largest)
        bands = (config.train.sh_degree + 1) ** 2 - 1
        numbers = 14 + 3 * bands
        return cls(
            fixed=photo_bytes * photos + MAP_BYTES * maps + SAMPLE_BYTES * samples + IMAGE_BYTES * largest,
            per_gaussian=2 * (3 * 4 * numbers + 4 + 8 * 4) + VIEW_BYTES * views,
            per_image=SAMPLE_BYTES * largest,
        )

    def gaussians(self, limit: int) -> int:
        """How many fit in `limit` bytes.

        Raises:
            InputError: fewer than `FEWEST_GAUSSIANS`, naming the limit that fits so many.
        """
        count = (limit - self.fixed) // self.per_gaussian
        if count < FEWEST_GAUSSIANS:
            least = self.fixed + FEWEST_GAUSSIANS * self.per_gaussian
            raise InputError(
                f"--max-memory {limit / 2**20:.0f}MiB leaves no room for a model: {FEWEST_GAUSSIANS} Gaussians take "
                f"{math.ceil(least / 2**20)}MiB here. Allow that, or use a larger --factor, a smaller "
                "schedule.max_views or schedule.pixel_budget"
            )
        return count

    def more_images(self, limit: int, gaussians: float) -> float:
        """How much lambda may rise within `limit` bytes, beside so many Gaussians."""
        return max(0.0, limit - self.fixed - gaussians * self.per_gaussian) / self.per_image
