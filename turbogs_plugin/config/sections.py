"""The sections of a configuration that are no strategy's: what they hold, their defaults, and what is refused."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from turbogs_plugin.config.units import parse_bytes, parse_color, parse_seconds
from turbogs_plugin.errors import require, require_not_negative

LONGEST_TIME = 100 * 3600.0
"""Seconds of a time budget: the iterations that fit can be counted (less than 2^31) even where one takes 0.2 ms."""

Auto = Literal["auto"]
"""A value that leaves the setting to the plan of a run, which looks at scene and machine (`turbogs_plugin.plan`)."""

Place = Literal["auto", "device", "host"]
"""Where large tensors are: on the device, or in pinned memory of the host, from where a window of them travels."""


@dataclass
class SceneConfig:
    """Which photos.

    Args:
        path: the capture's folder; the command line sets it.
        factor: photos are scaled down by this.
        test_every: every n-th image in name order tests.
    """

    path: str = ""
    factor: int = 1
    test_every: int = 8

    def __post_init__(self) -> None:
        require(self.factor >= 1, "factor", self.factor, "at least 1")
        require(self.test_every >= 2, "test_every", self.test_every, "at least 2")


@dataclass
class TrainConfig:
    """The run itself.

    Args:
        iterations: T. A number leaves all other settings as they are. ``auto``: as many as `epochs` take, 30,000 at
            most, and all settings that count iterations (`turbogs_plugin.config.scaling`) are scaled from
            `base_iterations`.
        epochs: passes over the training photos: iterations times images per iteration, divided by training views. Used
            where `iterations` is ``auto``, and where a time budget allows for more.
        base_iterations: the length for which the settings that count iterations are written. Used where `iterations`
            is ``auto``.
        batch_for: number of processes that the settings of a batch are written for: views and pixels of an iteration,
            learning rates and the decays of moments. ``auto``: they are written for one, and scaled to those that train
            together (`turbogs_plugin.config.scaling.with_batch_for`).
        refine_until: tau_until, the last iteration of densification, which also ends the annealing of the sampling.
        seed: of all randomness.
        device: auto (CUDA where there is one), cpu, or cuda.
        maps_place, photos_place: where error and age maps, and where the photos are. It changes no result.
        init: what training starts from: ``points`` of the capture; ``random`` points, in a cube about what the cameras
            look at; or a model's file, a .ply, gsplat's .pt, a checkpoint or a run's folder. A model is taken as it is:
            all its bands are in use from the start, and `initial_opacity` and `initial_size` change nothing.
        sh_degree: highest degree of the spherical harmonics.
        sh_interval: iterations between two bands; the run starts with band 0, but for a model's file.
        refine_cameras: train with cameras that agree better with the points that photos show: each photo has a pose,
            focal lengths and a principal point of its own (`captures.camera_refinement`). Nothing where the capture
            does not say which photos show a point, as COLMAP does. Test photos keep their cameras.
        initial_opacity, initial_size: of the Gaussians that training starts with; the size in mean distances to the
            three nearest points. 3DGS has 0.1 and 1, gsplat's MCMC preset 0.5 and 0.1.
        background: colour that shows through the model: ``black``, ``white``, another that Pillow knows, as
            ``rgb(51, 102, 153)``; or ``random``, another one each iteration, so that nothing dark is taken for empty.
            ``auto``: random where photos are transparent, else black. Transparent photos are composited on it.
        backdrop: start with a far sphere of Gaussians in the photos' mean colour behind the scene.
        exposure: learn an affine colour for each training photo, for captures whose exposure or white balance changes
            from photo to photo (`turbogs_plugin.engine.exposures`). Test photos are compared with that of the training
            photos before and after them (`turbogs_plugin.train.interpolated_exposures`). ``auto``: where photos differ,
            but little from those before and after them.
        dropout: share of the Gaussians that each iteration leaves out, drawn anew each time, until
            `trainer.DROPOUT_UNTIL` of the run. ``auto``: where points are a median of 0.4 pixels or more from
            where photos show them.
        distant_size: largest standard deviation of a Gaussian beyond 2 scene extents, over its distance from the
            cameras (`restrain_distant`). 0: no bound.
        camera_clearance: a change of the set of Gaussians also removes those that stand nearer to a training camera
            than the capture's points do (`turbogs_plugin.model.clearance`). Nothing where it has no points of its own.
        average_last: share of the iterations, at the end of the run and since the last change of the set of Gaussians,
            whose mean the model becomes (`turbogs_plugin.train.parameter_mean`). 0: it stays that of the last one.
        evaluate_at: when to evaluate, as fractions of T; the start and the end are always evaluated.
        checkpoint_every: iterations between checkpoints; the end always has one. 0: only the end.
    """

    iterations: int | Auto = 5000
    epochs: float = 60.0
    base_iterations: int = 5000
    batch_for: int | Auto = 1
    refine_until: int = 3500
    seed: int = 0
    device: str = "auto"
    maps_place: Place = "auto"
    photos_place: Place = "auto"
    init: str = "points"
    refine_cameras: bool = False
    sh_degree: int = 3
    sh_interval: int = 1000
    initial_opacity: float = 0.1
    initial_size: float = 1.0
    background: str = "black"
    backdrop: bool | Auto = False
    exposure: bool | Auto = False
    dropout: float | Auto = 0.0
    distant_size: float = 0.0
    camera_clearance: bool = False
    average_last: float = 0.0
    evaluate_at: tuple[float, ...] = (0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
    checkpoint_every: int = 10_000

    def __post_init__(self) -> None:
        for name in ("iterations", "base_iterations"):
            value = getattr(self, name)
            require(value == "auto" or 1 <= value < 2**31, name, value, "within 1 .. 2^31 - 1")
        require(math.isfinite(self.epochs) and self.epochs > 0, "epochs", self.epochs, "a finite number above 0")
        require(self.batch_for == "auto" or self.batch_for >= 1, "batch_for", self.batch_for, "at least 1")
        require(self.refine_until >= 0, "refine_until", self.refine_until, "at least 0")
        require(0 <= self.seed < 2**31, "seed", self.seed, "within 0 .. 2^31 - 1")
        require(self.device in ("auto", "cpu", "cuda"), "device", self.device, "auto, cpu or cuda")
        named = bool(self.init.strip())
        require(named, "init", self.init, "points, random, or the file of a model (.ply, .pt) or a run's folder")
        require(0 <= self.sh_degree <= 3, "sh_degree", self.sh_degree, "within 0 .. 3")
        if self.background not in ("auto", "random"):
            parse_color(self.background)
        require(self.sh_interval >= 1, "sh_interval", self.sh_interval, "at least 1")
        require(0 < self.initial_opacity < 1, "initial_opacity", self.initial_opacity, "more than 0 and less than 1")
        require(0 < self.initial_size <= 100, "initial_size", self.initial_size, "more than 0 and at most 100")
        require(self.dropout == "auto" or 0 <= self.dropout < 1, "dropout", self.dropout, "at least 0, less than 1")
        require_not_negative(self, "distant_size")
        require(0 <= self.average_last <= 1, "average_last", self.average_last, "within 0 .. 1")
        for value in self.evaluate_at:
            require(0 < value <= 1, "evaluate_at", value, "fractions within (0, 1]")
        require(self.checkpoint_every >= 0, "checkpoint_every", self.checkpoint_every, "at least 0")

    @property
    def written_iterations(self) -> int:
        """The length of run that the settings which count iterations are written for."""
        return self.base_iterations if self.iterations == "auto" else self.iterations

    @property
    def starts_from_model(self) -> bool:
        """Whether `init` names a model's file."""
        return self.init not in ("points", "random")

    def evaluation_iterations(self) -> set[int]:
        """Counts of finished iterations after which to evaluate."""
        return {0, self.iterations, *(max(1, round(part * self.iterations)) for part in self.evaluate_at)}

    def sh_degree_at(self, iteration: int) -> int:
        """Degree of the bands in use at an iteration."""
        return self.sh_degree if self.starts_from_model else min(self.sh_degree, iteration // self.sh_interval)


@dataclass
class MapsConfig:
    """The error maps. `beta`: EMA weight of a new error."""

    beta: float = 0.4

    def __post_init__(self) -> None:
        require(0 < self.beta <= 1, "beta", self.beta, "within (0, 1]")


@dataclass
class ReportConfig:
    """The report.

    Args:
        lpips_weights: a local file with the backbone's weights (torchvision's VGG16), or null: LPIPS is not computed.
        strips: test views shown as pictures, at most.
        tensorboard: also write the history and those pictures for TensorBoard, at each evaluation, into the run's
            folder; needs the extra ``tensorboard``.
    """

    lpips_weights: str | None = None
    strips: int = 8
    tensorboard: bool = False

    def __post_init__(self) -> None:
        require(self.strips >= 0, "strips", self.strips, "at least 0")


@dataclass
class BudgetConfig:
    """What the run may take besides Gaussians, whose cap is the density control's `max_gaussians`.

    Args:
        max_memory: of the device, for instance 2GiB; empty: no limit.
        time: seconds of training to end after, for instance 20s or 2m; empty: `train.iterations` decide.
    """

    max_memory: str = ""
    time: str = ""

    def __post_init__(self) -> None:
        self.memory_bytes()
        require((self.seconds() or 0.0) <= LONGEST_TIME, "time", self.time, "at most 100h")

    def memory_bytes(self) -> int | None:
        """`max_memory`, or None for no limit. Raises `InputError` where it is no amount."""
        return parse_bytes(self.max_memory) if self.max_memory else None

    def seconds(self) -> float | None:
        """`time`, or None for no limit. Raises `InputError` where it is no amount."""
        return parse_seconds(self.time) if self.time else None
