"""What a run may take: Gaussians, bytes of the device, seconds of training. Pure functions; `calibration` and `pacing`
carry them out.

Memory. The peak of a run on a GPU is taken to be ``fixed + per_gaussian * N``, all of it torch's own allocations (the
CUDA context comes on top, with its 0.3 to 0.6 GiB). With K views an iteration, degree-d harmonics (B bands above 0) and
lambda images of S pixels an iteration:

- per Gaussian: 14 + 3 B parameters, two moments of each, a step count and 7 statistics, all of it twice, for an event
  of density control makes the new arrays beside the old; and for each of the K views `VIEW_BYTES`;
- fixed: photos and maps, or their windows of 2 K views; `SAMPLE_BYTES` for each of lambda S samples; `IMAGE_BYTES` for
  each pixel of the largest photo, which is rendered whole at the start and in evaluations.

Time. The cost of an iteration is ``base + per_gaussian * N``. Where fewer iterations fit than are configured, the run
is that much shorter; where these would be fewer than `FEWEST_SHARE` of the configured ones, Gaussians are given up for
them. Where more fit than are configured, and than look at the photos often enough (`plan.looks`), an iteration gets
more pixels (lambda) until these fill the time, and only then there are more iterations: those overfit the photos
(docs/budgets.md). While it trains, the number of iterations left follows the cost measured (`TimePlan`), so that all
that goes by progress (learning rates, sampling, density control) ends with the time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from turbogs_plugin.config.configuration import Config, resolve
from turbogs_plugin.error_maps import MAP_BYTES
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.offload import SETS
from turbogs_plugin.scene.photos import PHOTO_BYTES

CAPS = {"error_driven": "max_gaussians", "mcmc": "cap_max"}
"""Kinds of density control that keep a cap -> its name there. With `none` the initial model is all there is."""

WHOLE_VIEWS = ("dense",)
"""Pixel samplers that take every pixel of a view, whatever the rate: to these, lambda says nothing."""

VIEW_BYTES = 230
"""Of a Gaussian in a view: the rasterizer's instance, radius and gradient record, and its share of the pairs. Measured
on an H200: 213 between 150 and 600 thousand Gaussians (docs/results/h200/bench-step.json)."""
SAMPLE_BYTES = 400
"""Of a sample: draw, colours, gradients, errors, masks of pairs, scratch. Measured there: 320 to 400."""
IMAGE_BYTES = 120
"""Of a pixel of a whole render."""
FEWEST_GAUSSIANS = 1000
"""Fewer are no model of a capture."""

FEWEST_SHARE = 0.3
"""Of the configured iterations; a shorter schedule gets fewer Gaussians instead."""
EXPECTED_GROWTH = 12.0
"""Final Gaussians per initial one, before anything is known of the scene: 17 on fox, 12 on caliterra."""
TOLERANCE = 0.1
"""So many more or fewer iterations, as a share of the configured ones, are as good as those."""
RAISES = 3
"""How often lambda is raised and the cost measured again, at most."""
MARK_SHARE = 0.03
"""Of the time, between two looks at the clock; towards the end, half of what is left."""


def with_cap(config: Config, cap: int) -> Config:
    """The configuration with never more Gaussians than `cap`, or what it already has if that is less.

    Raises:
        InputError: its density control keeps no cap.
    """
    kind = config.density["type"]
    if kind != "none" and kind not in CAPS:
        raise InputError(f"density.type {kind} keeps no cap on Gaussians: use one of {', '.join([*CAPS, 'none'])}")
    mapping = config.to_mapping()
    if kind != "none":
        present = mapping["density"][CAPS[kind]]
        mapping["density"][CAPS[kind]] = min(present, cap) if present else cap
        if mapping["density"].get("target_gaussians"):
            mapping["density"]["target_gaussians"] = min(mapping["density"]["target_gaussians"], cap)
    present = config.budget.max_gaussians
    mapping["budget"]["max_gaussians"] = min(present, cap) if present else cap
    return resolve(mapping)


def growth_cap(config: Config, initial: int) -> int:
    """The cap that the density control keeps; 0: none. A model that does not grow has its initial number."""
    kind = config.density["type"]
    if kind == "none":
        return initial
    return config.density[CAPS[kind]] if kind in CAPS else 0


def expected_gaussians(initial: int, cap: int) -> float:
    """How many there will be at the end, before anything is known of the scene. A `cap` of 0 is none."""
    return max(initial, min(EXPECTED_GROWTH * initial, cap or math.inf))


def most_views(config: Config, num_views: int) -> int:
    """K where it is largest, of a scene with so many training views."""
    return min(num_views, config.schedule.get("max_views", config.schedule.get("views", num_views)))


def images_per_iteration(config: Config, num_views: int) -> float:
    """So many images' worth of pixels does an iteration look at: lambda of its views; all of them with a pixel sampler
    that takes whole views, at the largest K."""
    views = most_views(config, num_views)
    if config.pixel_sampler["type"] in WHOLE_VIEWS:
        return views
    return min(views, config.schedule.get("pixel_budget", views))


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
    mapping = config.to_mapping()
    mapping["schedule"]["pixel_budget"] = pixel_budget
    return resolve(mapping)


def chosen_points(count: int, cap: int, others: int) -> slice | np.ndarray:
    """Which of `count` points a model begins with: all, or as many as leave room for `others` under a cap.

    Args:
        cap: 0: none.

    Raises:
        InputError: there is no room.
    """
    if not cap or count + others <= cap:
        return slice(None)
    if cap <= others:
        raise InputError(f"--max-gaussians {cap} leaves no room beside the {others} of the backdrop: allow more")
    return np.linspace(0, count - 1, cap - others).round().astype(np.int64)


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
    def of(cls, config: Config, pixels: int, test_pixels: int, largest: int, num_views: int) -> MemoryDemand:
        """The demand of a configuration whose places of maps and photos are decided.

        Args:
            pixels, test_pixels: of all training photos, of all test photos.
            largest: pixels of the largest photo.
            num_views: V.
        """
        views = most_views(config, num_views)
        window = SETS * views * largest
        photos = window + SETS * largest if config.plan.photos_on == "host" else pixels + test_pixels
        maps = window if config.plan.maps_on == "host" else pixels
        samples = math.ceil(images_per_iteration(config, num_views) * largest)
        bands = (config.train.sh_degree + 1) ** 2 - 1
        numbers = 14 + 3 * bands
        return cls(
            fixed=PHOTO_BYTES * photos + MAP_BYTES * maps + SAMPLE_BYTES * samples + IMAGE_BYTES * largest,
            per_gaussian=2 * (3 * 4 * numbers + 4 + 7 * 4) + VIEW_BYTES * views,
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


@dataclass(frozen=True)
class IterationCost:
    """Seconds of an iteration with N Gaussians: ``base + per_gaussian * N``."""

    base: float
    per_gaussian: float

    @classmethod
    def through(cls, small: tuple[int, float], large: tuple[int, float]) -> IterationCost:
        """The line through two measurements (Gaussians, seconds); neither part is negative."""
        (few, seconds_few), (many, seconds_many) = small, large
        slope = (seconds_many - seconds_few) / max(1, many - few)
        slope = min(max(0.0, slope), seconds_many / max(1, many))
        return cls(seconds_many - slope * many, slope)

    def at(self, gaussians: float) -> float:
        return self.base + self.per_gaussian * gaussians

    def times(self, factor: float) -> IterationCost:
        return IterationCost(factor * self.base, factor * self.per_gaussian)


def fit_to_time(
    seconds: float,
    cost: IterationCost,
    initial: int,
    cap: int,
    iterations: int,
    refine_share: float,
    keeps_cap: bool = True,
) -> tuple[int, int]:
    """How long a schedule, and how many Gaussians, before training.

    Args:
        seconds: left for iterations.
        initial: Gaussians at the start; their number is expected to rise along a line until the end of density control,
            to `expected_gaussians`.
        cap: never more Gaussians; 0: none.
        iterations: configured.
        refine_share: of the iterations, those with density control.
        keeps_cap: whether the density control would keep a smaller cap.

    Returns:
        (iterations, cap): the cap is the given one where at least `FEWEST_SHARE` of the configured iterations fit, or
        where no other would be kept.
    """
    growing = 0.5 * refine_share  # share of the run that the initial number counts for

    def mean(final: float) -> float:
        return growing * initial + (1.0 - growing) * final

    final = expected_gaussians(initial, cap)
    fitting = seconds / max(1e-9, cost.at(mean(final)))
    fewest = FEWEST_SHARE * iterations
    if fitting >= fewest or not keeps_cap:
        return max(1, int(fitting)), cap
    if cost.per_gaussian > 0:
        wanted = (seconds / fewest - cost.base) / cost.per_gaussian  # the mean number that leaves time for so many
        final = min(final, max(initial, (wanted - growing * initial) / (1.0 - growing)))
    return max(1, int(seconds / max(1e-9, cost.at(mean(final))))), math.ceil(final)


def pixels_for_time(
    configured: float, largest: float, iterations: int, raises: int, fitting: Callable[[float], int]
) -> float:
    """The lambda with which about the configured number of iterations fills the time.

    The cost of an iteration grows more slowly than lambda, so that raising lambda by the ratio of the iterations that
    fit to those wanted never raises it too far, but again and again not far enough.

    Args:
        configured, largest: the range of lambda.
        iterations: wanted.
        raises: at most.
        fitting: how many iterations fit with a lambda; it is asked for the configured one first.

    Returns:
        The configured lambda unless more iterations fit with it than wanted; of those tried and costing none of the
        iterations wanted, beyond `TOLERANCE`, the one with which their number is nearest.
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


@dataclass
class TimePlan:
    """The length of a run that is to end after a time, again and again fitted to what iterations cost.

    Args:
        seconds: when to end, on the clock of training.
        iterations, refine_until: of the schedule as planned so far.
        cost: how it depends on the number of Gaussians; only ratios of it count.
        cap: never more Gaussians; 0: none.
    """

    seconds: float
    iterations: int
    refine_until: int
    cost: IterationCost = field(default_factory=lambda: IterationCost(1.0, 0.0))
    cap: int = 0

    def __post_init__(self) -> None:
        self._refine_share = min(1.0, self.refine_until / self.iterations)
        self._last: tuple[int, float, int] | None = None
        self._now = 0.0  # seconds of an iteration, of late

    def start(self, iteration: int, seconds: float, gaussians: int) -> None:
        """Where training stands as it begins or goes on."""
        self._last = (iteration, seconds, gaussians)
        if self._now == 0.0:
            self._now = max(0.0, self.seconds - seconds) / max(1, self.iterations - iteration)

    def replan(self, iteration: int, seconds: float, gaussians: int) -> None:
        """Fit `iterations` and `refine_until` to where training stands.

        Density control that is over stays over.
        """
        before, started, fewer = self._last
        if iteration > before:
            latest = (seconds - started) / (iteration - before)
            self._now = latest if before == 0 else 0.5 * (self._now + latest)
            growth = (gaussians - fewer) / (iteration - before)
            self._last = (iteration, seconds, gaussians)
            left = max(0.0, self.seconds - seconds)
            cost = max(1e-9, self._now * self._rise(iteration, gaussians, growth))
            self.iterations = iteration + int(left / cost + 0.5)  # to the nearest, so half of one late or early
            if iteration < self.refine_until:
                self.refine_until = max(iteration, round(self._refine_share * self.iterations))

    def next_mark(self, iteration: int, seconds: float) -> int:
        """The finished iteration after which to look at the clock again."""
        stretch = min(MARK_SHARE * self.seconds, 0.5 * max(0.0, self.seconds - seconds))
        return min(self.iterations, iteration + max(1, int(stretch / max(1e-9, self._now))))

    def state_dict(self) -> dict[str, Any]:
        return {
            "iterations": self.iterations,
            "refine_until": self.refine_until,
            "cost": asdict(self.cost),
            "iteration_seconds": self._now,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.iterations, self.refine_until = state["iterations"], state["refine_until"]
        self.cost = IterationCost(**state["cost"])
        self._now = state["iteration_seconds"]

    def _rise(self, iteration: int, gaussians: int, growth: float) -> float:
        """Mean cost of the iterations left, in units of the present cost, if the number goes on to grow as of late."""
        left, growing = self.iterations - iteration, self.refine_until - iteration
        if growing <= 0 or left <= 0:
            return 1.0
        final = gaussians + max(0.0, growth) * growing
        final = max(gaussians, min(final, self.cap)) if self.cap else final
        mean = final - 0.5 * (final - gaussians) * growing / left
        return max(1.0, self.cost.at(mean) / max(1e-12, self.cost.at(gaussians)))
