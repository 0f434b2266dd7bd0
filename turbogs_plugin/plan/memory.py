"""The cap on Gaussians, which is the `max_gaussians` of the density control and nowhere else; and the device memory of
a run, with the cap that keeps a limit of it.

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
import torch

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.error_maps import MAP_BYTES
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene import Scene
from turbogs_plugin.scene.offload import SETS
from turbogs_plugin.scene.photos import PHOTO_BYTES
from turbogs_plugin.tiles import TILE_PIXELS
from turbogs_plugin.types import Step

FEWEST_GAUSSIANS = 1000
"""Smallest number of Gaussians that can be a model of a capture."""
VIEW_BYTES = 200
"""Bytes of a Gaussian in a view: the rasterizer's instance, radius and gradient record, and its share of the
intersections. Measured on an H200: 183 between 150 and 600 thousand Gaussians."""
SAMPLE_BYTES = 280
"""Bytes of a sample: draw, colours, gradients, errors, masks of intersections, scratch. Measured there: 150 to 240."""
IMAGE_BYTES = 120
"""Bytes of a pixel of a whole render."""
WHOLE_VIEWS = ("dense",)
"""Pixel samplers that take every pixel of a view, whatever lambda."""


def cap_of(config: Config) -> int:
    """Most Gaussians of the finished model; 0: no cap."""
    return config.density.get("max_gaussians", 0)


def with_cap(config: Config, cap: int) -> Config:
    """The configuration with this cap. Raises `InputError` where its density control keeps none."""
    if "max_gaussians" not in config.density:
        raise InputError(f"density.type {config.density['type']} keeps no cap: its class needs a field max_gaussians")
    return config.changed(density={"max_gaussians": cap})


def most_views(config: Config, num_views: int) -> int:
    """Largest K of a schedule, of a scene with this number of training views."""
    return min(num_views, config.schedule.get("max_views", config.schedule.get("views", num_views)))


def images_per_iteration(config: Config, num_views: int) -> float:
    """Pixels per iteration, in images: lambda; with a pixel sampler that takes whole views the largest K."""
    views = most_views(config, num_views)
    if config.pixel_sampler["type"] in WHOLE_VIEWS:
        return views
    return min(views, config.schedule.get("pixel_budget", views))


def most_images(config: Config, num_views: int) -> float:
    """Largest `images_per_iteration` over K, where pixels of a tile are drawn in multiples."""
    images, views = images_per_iteration(config, num_views), most_views(config, num_views)
    share = config.pixel_sampler.get("multiple", 1) / TILE_PIXELS
    if share == 1 / TILE_PIXELS or config.pixel_sampler["unit"] != "pixel":
        return images
    fewest = min(views, config.schedule.get("min_views", views))
    return max(count * share * max(1, round(images / count / share)) for count in range(fewest, views + 1))


@dataclass(frozen=True)
class MemoryDemand:
    """Bytes of the device at the peak of a run: ``fixed + per_gaussian * N``."""

    fixed: int
    per_gaussian: int

    @classmethod
    def of(
        cls, config: Config, train_sizes: np.ndarray, test_sizes: np.ndarray, photo_bytes: int = PHOTO_BYTES
    ) -> MemoryDemand:
        """The demand of a configuration whose places of maps and photos are decided, with photos of these sizes [V, 2]
        (width, height) to train and test on, and this number of bytes of a photo's pixel."""
        train, test = train_sizes.prod(axis=1), test_sizes.prod(axis=1)
        photos, maps = int(train.sum() + test.sum()), int(train.sum())
        largest, views = int(max(train.max(), test.max(initial=0))), most_views(config, len(train))
        if config.train.pixels_place == "host":
            maps = SETS * views * largest
            photos = maps + SETS * largest
        samples = math.ceil(most_images(config, len(train)) * largest)
        numbers = 14 + 3 * ((config.train.sh_degree + 1) ** 2 - 1)
        return cls(
            fixed=photo_bytes * photos + MAP_BYTES * maps + SAMPLE_BYTES * samples + IMAGE_BYTES * largest,
            per_gaussian=2 * (3 * 4 * numbers + 4 + 8 * 4) + VIEW_BYTES * views,
        )

    def gaussians(self, limit: int) -> int:
        """Number of Gaussians that fit in `limit` bytes. Raises `InputError` for fewer than `FEWEST_GAUSSIANS`, naming
        the limit that fits them."""
        count = (limit - self.fixed) // self.per_gaussian
        if count < FEWEST_GAUSSIANS:
            least = self.fixed + FEWEST_GAUSSIANS * self.per_gaussian
            raise InputError(
                f"--max-memory {limit / 2**20:.0f}MiB leaves no room for a model: {FEWEST_GAUSSIANS} Gaussians take "
                f"{math.ceil(least / 2**20)}MiB here. Allow that, or use a larger --factor, a smaller "
                "schedule.max_views or schedule.pixel_budget"
            )
        return count


def hold_to_limit(config: Config, device: torch.device) -> None:
    """Hold torch to the configuration's limit of device memory, if it has one, for the rest of the process. Raises
    `InputError` where the device is no GPU."""
    limit = config.budget.memory_bytes()
    if limit is not None:
        if device.type != "cuda":
            raise InputError("--max-memory limits the memory of a GPU, and this run would be on a CPU: leave it out")
        total = torch.cuda.get_device_properties(device).total_memory
        torch.cuda.set_per_process_memory_fraction(min(1.0, limit / total))


def room_note(config: Config, scene: Scene, free: int) -> str:
    """A line where the initial Gaussians, or as many as the cap allows, take more than the `free` bytes of the device,
    with the number that fits; empty where they fit, and where a limit of memory is kept instead."""
    demand, cap, growth = _demand(config, scene), cap_of(config), _growth(config)
    first = 0 if config.train.starts_from_model else min(len(scene.points), cap or len(scene.points))
    most = int((free - demand.fixed) / demand.per_gaussian / growth)
    if config.budget.memory_bytes() is not None or most >= max(first, cap, FEWEST_GAUSSIANS):
        return ""
    count = first if first > most else max(cap, FEWEST_GAUSSIANS)
    remedy = f"--max-gaussians {most}" if most >= FEWEST_GAUSSIANS else "train.pixels_place=host or a larger --factor"
    needed = demand.fixed + int(growth * count) * demand.per_gaussian
    return (
        f"{count:,} Gaussians take {needed / 2**30:.1f} GiB of the GPU, of which {free / 2**30:.1f} GiB are free, as "
        f"estimated: {remedy} would fit"
    )


def _demand(config: Config, scene: Scene) -> MemoryDemand:
    sizes = (scene.train.cameras.sizes, scene.test.cameras.sizes)
    return MemoryDemand.of(config, *sizes, photo_bytes=scene.train.photos.stored.shape[1])


def _growth(config: Config) -> float:
    """Most Gaussians on the way over those of the finished model."""
    step = Step(0, config.train.written_iterations, config.train.refine_until)
    return config.build("density").growth_room(step)


def within_memory(config: Config, scene: Scene) -> Config:
    """The configuration whose largest number of Gaussians fits into its limit of memory, if it has one. The places of
    maps and photos are decided in it. Raises `InputError` where no model fits, naming the limit that would do."""
    limit = config.budget.memory_bytes()
    if limit is None:
        return config
    fitting = max(1, int(_demand(config, scene).gaussians(limit) / _growth(config)))
    return with_cap(config, min(fitting, cap_of(config) or fitting))
