"""Set-up of the sparse swap before the loop: views and pixels a step, and the error maps."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral
from typing import Any

import torch

from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.errors import require
from turbogs_plugin.gsplat_bridge.density_swap import TUNED
from turbogs_plugin.gsplat_bridge.host import IN_IMAGES, require_options
from turbogs_plugin.gsplat_bridge.host_views import masks_of, read_items
from turbogs_plugin.strategies.schedule import SinusoidalSchedule
from turbogs_plugin.types import SamplingBudget

TUNED_SCHEDULE = SinusoidalSchedule(**TUNED["schedule"])
"""The schedule of views and rate with the settings of `configs/turbogs.yaml`."""

DEFAULT_VIEWS = 4
"""Views a step where a trainer leaves it open. Between the 3 and 10 of turbogs' schedule; a quarter of one view's
pixels alone is less than stock sees."""


def sparse_budget(num_views: int, batch_size: int | None = None, options: Any = None) -> SamplingBudget:
    """Views and rate of every step of a gsplat trainer with sparse pixels; prints in one line what it chose.

    The rule: a step sees as many pixels as one whole image has, which is what a stock trainer sees at batch 1, spread
    over its K views: ``rate = pixel_budget / K``, with the pixel_budget of `configs/turbogs.yaml`, which is 1. At batch
    1 every pixel is drawn, and nothing is lost against stock. The rate is never less than the least of turbogs'
    schedule, ``pixel_budget / max_views``; batches larger than that see more than one image.

    Args:
        num_views: V, training views.
        batch_size: K, where the trainer has settled it; None takes `DEFAULT_VIEWS`, or V if that is less. Give the
            data loader `views` of the result.
        options: of the trainer, as gsplat's `Config`: those that need whole images are refused.

    Raises:
        InputError: a number below 1, a batch of more views than there are, or such an option.
    """
    require_options(options, IN_IMAGES, "sparse pixels, which are no images")
    whole = "a whole number, 1 or more"
    require(isinstance(num_views, Integral) and num_views >= 1, "num_views", num_views, whole)
    if batch_size is not None:
        allowed = f"{whole} and at most num_views ({num_views})"
        require(isinstance(batch_size, Integral) and 1 <= batch_size <= num_views, "batch_size", batch_size, allowed)
    views = int(min(DEFAULT_VIEWS, num_views) if batch_size is None else batch_size)  # loaders refuse numpy's integers
    pixels = TUNED_SCHEDULE.pixel_budget
    rate = min(1.0, max(pixels / views, pixels / TUNED_SCHEDULE.max_views))
    reason = "no batch_size is given" if batch_size is None else f"batch_size is {batch_size}"
    print(f"sparse_budget: {views} views a step, {rate:.0%} of the pixels of each ({reason}).")
    return SamplingBudget(views, rate)


def maps_of_photos(
    trainset: Sequence[dict[str, Any]], device: torch.device | str = "cpu", white: float = 255.0
) -> ErrorMaps:
    """Error maps of a trainer's training views, which start from the errors of a black prediction.

    Args:
        trainset: V items, numbered as the trainer's image_id, each with "image" [H, W, 3], 0 .. `white`. Where they
            have a "mask" [H, W] too, samplers draw only where it is True.
        white: the largest value of a photo; gsplat's data sets have 255.

    Raises:
        InputError: as `read_items`.
    """
    items = read_items(trainset, "trainset", white, lambda image: image.to(device).sum(dim=-1) / 255.0)
    return ErrorMaps.from_images([item["image"] for item in items], masks_of(items, "trainset"))
