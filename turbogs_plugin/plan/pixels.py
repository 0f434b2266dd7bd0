"""How many pixels an iteration has: lambda images of them, more where a time budget leaves room for that."""

from __future__ import annotations

import math
from collections.abc import Callable

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.tiles import TILE_PIXELS

WHOLE_VIEWS = ("dense",)
"""Pixel samplers that take every pixel of a view, whatever the rate: to these, lambda says nothing."""

TOLERANCE = 0.1
"""So many more or fewer iterations, as a share of the configured ones, are as good as those."""
RAISES = 3
"""How often lambda is raised and the cost measured again, at most."""


def most_views(config: Config, num_views: int) -> int:
    """K where it is largest, of a scene with so many training views."""
    return min(num_views, config.schedule.get("max_views", config.schedule.get("views", num_views)))


def images_per_iteration(config: Config, num_views: int) -> float:
    """Pixels per iteration, in images: lambda; with a pixel sampler that takes whole views the largest K."""
    views = most_views(config, num_views)
    if config.pixel_sampler["type"] in WHOLE_VIEWS:
        return views
    return min(views, config.schedule.get("pixel_budget", views))


def most_images(config: Config, num_views: int) -> float:
    """`images_per_iteration`, where pixels of a tile are drawn in multiples: at the K that makes the most of it."""
    images, views = images_per_iteration(config, num_views), most_views(config, num_views)
    share = config.pixel_sampler.get("multiple", 1) / TILE_PIXELS
    if share == 1 / TILE_PIXELS or config.pixel_sampler["unit"] != "pixel":
        return images
    fewest = min(views, config.schedule.get("min_views", views))
    return max(count * share * max(1, round(images / count / share)) for count in range(fewest, views + 1))


def pixel_budget_range(config: Config, num_views: int) -> tuple[float, float]:
    """(lambda as configured, the largest that adds a pixel): the rate, lambda / K, is at most 1.

    The two are equal where more pixels cannot be asked for: the pixel sampler takes all, or the schedule has no lambda.
    """
    views = most_views(config, num_views)
    configured = config.schedule.get("pixel_budget", views)
    if config.pixel_sampler["type"] in WHOLE_VIEWS:
        return configured, configured
    return configured, max(configured, float(views))


def with_pixel_budget(config: Config, pixel_budget: float) -> Config:
    """The configuration with another lambda."""
    return config.changed(schedule={"pixel_budget": pixel_budget})


def pixels_for_time(
    configured: float, largest: float, iterations: int, raises: int, fitting: Callable[[float], int]
) -> float:
    """The lambda with which about the configured number of iterations fills the time.

    Lambda is raised by the ratio of the iterations that fit to those wanted. The cost of an iteration grows more slowly
    than lambda, so that this is never too far, but often not far enough: it is repeated.

    Args:
        configured, largest: the range of lambda.
        iterations: wanted.
        raises: at most.
        fitting: how many iterations fit with a lambda; it is asked for the configured one first.

    Returns:
        The configured lambda if no more iterations fit with it than wanted. Else, of those tried with which enough
        iterations fit (within `TOLERANCE`), the one that comes nearest to the number wanted.
    """
    enough, most = (1.0 - TOLERANCE) * iterations, (1.0 + TOLERANCE) * iterations
    pixel_budget, fits = configured, fitting(configured)
    best, excess = configured, abs(fits - iterations)
    for _ in range(raises):
        if fits <= most or pixel_budget >= largest:
            break
        raised = min(largest, pixel_budget * fits / iterations)
        pixel_budget = max(configured, math.floor(1000 * raised) / 1000)  # for readers; never beyond the largest
        fits = fitting(pixel_budget)
        if fits >= enough and abs(fits - iterations) < excess:
            best, excess = pixel_budget, abs(fits - iterations)
    return best
