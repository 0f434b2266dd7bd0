"""The sections of a configuration that are no strategy's: what they hold, their defaults, and what is refused; amounts
of memory and time, and colours, as people write them; and the settings that may be ``auto``."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from PIL import ImageColor

from turbogs_plugin.errors import InputError, require
from turbogs_plugin.types import Color

AUTO = "auto"
"""A value that leaves the setting to the plan of a run, which looks at scene and machine (`turbogs_plugin.plan`)."""

Auto = Literal["auto"]
LONGEST_TIME = 100 * 3600.0
"""Most seconds of a time budget: iterations of 0.2 ms that fit are still fewer than 2^31."""
AUTO_SETTINGS = ("backdrop", "background", "exposure", "dropout", "batch_for", "iterations", "pixels_place")
"""Settings of the section `train` that may be ``auto``; what a plan makes of it: `turbogs_plugin.plan.decisions`.
`device` is not among them, as a plan is made for a given device."""
WRITTEN_FOR = 5000
"""Iterations for which the settings that count iterations are written where `train.iterations` is ``auto``."""


@dataclass
class SceneConfig:
    """Which photos.

    Args:
        path: folder of the capture; the command line sets it.
        factor: divisor of the photos' width and height.
        test_every: every n-th photo in name order tests.
        validation: leave the test photos out, and test on every n-th of the others: for whoever chooses settings.
        force: train also where cameras, points and photos contradict each other (`turbogs_plugin.scene.agreement`).
    """

    path: str = ""
    factor: int = 1
    test_every: int = 8
    validation: bool = False
    force: bool = False

    def __post_init__(self) -> None:
        require(self.factor >= 1, "factor", self.factor, "at least 1")
        require(self.test_every >= 2, "test_every", self.test_every, "at least 2")

    @property
    def photos(self) -> tuple[int, int, bool]:
        """Settings that decide which photos of a capture train and test, and how large they are."""
        return self.factor, self.test_every, self.validation


@dataclass
class TrainConfig:
    """The run itself.

    Args:
        iterations: length of the run, T in the paper. A number leaves all other settings as they are. ``auto``: as many
            as `epochs` take, 30,000 at most, and all settings that count iterations (`turbogs_plugin.config.scaling`)
            are scaled from `WRITTEN_FOR`.
        epochs: passes over the training photos: iterations times images per iteration, divided by training views. Used
            where `iterations` is ``auto``, and where a time budget allows for more.
        batch_for: number of processes for which the settings of a batch are written: views and pixels of an iteration,
            learning rates and the decays of moments. ``auto``: they are written for one, and scaled to the processes
            that train together (`turbogs_plugin.config.scaling.with_batch_for`).
        refine_until: last iteration of densification, tau_until in the paper, which also ends the annealing of the
            sampling.
        seed: seed of all random numbers.
        device: ``cpu``, ``cuda``, or ``auto``: CUDA where there is a GPU.
        pixels_place: where photos, error and age maps are: on the device, or in pinned memory of the host, from where a
            window of them travels. Changes no result.
        init: what training starts from: ``points`` of the capture; ``random`` points, in a cube about what the cameras
            look at; or a model's file, a .ply, gsplat's .pt, a checkpoint or a run's folder. A model is taken as it is:
            all its bands are in use from the start, and `initial_opacity` and `initial_size` change nothing.
        init_world: coordinates of a model's file: ``capture``, the capture's own, or ``gsplat``, the normalised world
            of gsplat's example trainer. Also for a model that eval, render, export or view is given with a capture.
        refine_cameras: train with cameras that agree better with the points that photos show: each photo has a pose,
            focal lengths and a principal point of its own (`turbogs_plugin.captures.bundle_adjustment`). Nothing
            where the capture does not say which photos show a point, as COLMAP does. Test photos keep their cameras.
        sh_degree: highest degree of the spherical harmonics.
        sh_interval: iterations between two bands; a run starts with band 0, unless from a model's file.
        initial_opacity: opacity of the Gaussians that training starts with, 0.1 in 3DGS, 0.5 in gsplat's MCMC preset.
        initial_size: standard deviation of the Gaussians that training starts with, in mean distances to the three
            nearest points, 1 in 3DGS, 0.1 in gsplat's MCMC preset.
        background: colour that shows through the model: ``black``, ``white``, another that Pillow knows, as
            ``rgb(51, 102, 153)``; or ``random``, another one each iteration, so that nothing dark is taken for empty.
            ``auto``: random where photos are transparent, else black. Transparent photos are composited on it.
        backdrop: start with a far sphere of Gaussians in the photos' mean colour behind the scene.
        exposure: learn an affine colour for each training photo, for captures whose exposure or white balance changes
            from photo to photo (`turbogs_plugin.engine.exposures`). Test photos are compared with the exposure of the
            training photos before and after them (`turbogs_plugin.train.look`). ``auto``: where
            photos differ, but little from those before and after them.
        dropout: share of the Gaussians that each iteration leaves out (`engine.rules.Dropout`), drawn anew each time,
            until `trainer.DROPOUT_UNTIL` of the run. ``auto``: where points are a median of 0.4 pixels or more from
            where photos show them.
        distant_size: largest standard deviation of a Gaussian beyond 2 scene extents, over its distance from the
            cameras (`restrain_distant`). 0: no bound.
        camera_clearance: a change of the set of Gaussians also removes those that stand nearer to a training camera
            than the capture's points do (`turbogs_plugin.model.limits`). Nothing where it has no points of its own.
        average_last: share of the iterations, at the end of the run and since the last change of the set of Gaussians,
            whose mean the model becomes (`turbogs_plugin.train.parameter_mean`). 0: the model of the last iteration.
        evaluate_at: times of evaluations, as fractions of T; the start and the end are always evaluated.
        checkpoint_every: most iterations between checkpoints. 200 s of training end in one, too, and so does the run; a
            stop (Ctrl-C) writes one. 0: only the end.
    """

    iterations: int | Auto = 5000
    epochs: float = 60.0
    batch_for: int | Auto = 1
    refine_until: int = 3500
    seed: int = 0
    device: str = "auto"
    pixels_place: Literal["auto", "device", "host"] = "auto"
    init: str = "points"
    init_world: Literal["capture", "gsplat"] = "capture"
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
    checkpoint_every: int = 30_000

    def __post_init__(self) -> None:
        countable = isinstance(self.iterations, str) or 1 <= self.iterations < 2**31
        require(countable, "iterations", self.iterations, "within 1 .. 2^31 - 1")
        require(math.isfinite(self.epochs) and self.epochs > 0, "epochs", self.epochs, "a finite number above 0")
        require(isinstance(self.batch_for, str) or self.batch_for >= 1, "batch_for", self.batch_for, "at least 1")
        require(self.refine_until >= 0, "refine_until", self.refine_until, "at least 0")
        require(0 <= self.seed < 2**31, "seed", self.seed, "within 0 .. 2^31 - 1")
        require(self.device in ("auto", "cpu", "cuda"), "device", self.device, "auto, cpu or cuda")
        allowed = "points, random, or the file of a model (.ply, .pt) or a run's folder"
        require(bool(self.init.strip()), "init", self.init, allowed)
        require(0 <= self.sh_degree <= 3, "sh_degree", self.sh_degree, "within 0 .. 3")
        if self.background not in ("auto", "random"):
            parse_color(self.background)
        require(self.sh_interval >= 1, "sh_interval", self.sh_interval, "at least 1")
        require(0 < self.initial_opacity < 1, "initial_opacity", self.initial_opacity, "more than 0 and less than 1")
        require(0 < self.initial_size <= 100, "initial_size", self.initial_size, "more than 0 and at most 100")
        share = isinstance(self.dropout, str) or 0 <= self.dropout < 1
        require(share, "dropout", self.dropout, "at least 0, less than 1")
        require(0 <= self.distant_size < math.inf, "distant_size", self.distant_size, "a finite number >= 0")
        require(0 <= self.average_last <= 1, "average_last", self.average_last, "within 0 .. 1")
        for value in self.evaluate_at:
            require(0 < value <= 1, "evaluate_at", value, "fractions within (0, 1]")
        require(self.checkpoint_every >= 0, "checkpoint_every", self.checkpoint_every, "at least 0")

    @property
    def written_iterations(self) -> int:
        """Iterations for which the settings that count iterations are written."""
        return WRITTEN_FOR if isinstance(self.iterations, str) else self.iterations

    @property
    def starts_from_model(self) -> bool:
        """Whether `init` names a model's file."""
        return self.init not in ("points", "random")

    def sh_degree_at(self, iteration: int) -> int:
        """Degree of the bands in use at an iteration."""
        return self.sh_degree if self.starts_from_model else min(self.sh_degree, iteration // self.sh_interval)


@dataclass
class MapsConfig:
    """The error maps. `beta`: weight of a new error in the moving average of the errors at its pixel."""

    beta: float = 0.4

    def __post_init__(self) -> None:
        require(0 < self.beta <= 1, "beta", self.beta, "within (0, 1]")


@dataclass
class BudgetConfig:
    """What the run may take besides Gaussians, whose cap is the density control's `max_gaussians`.

    Args:
        max_memory: most memory of the device, for instance 2GiB or a number of bytes; empty: no limit.
        time: time of training to end after, for instance 2m or a number of seconds; empty: `train.iterations` decide.
    """

    max_memory: str | int = ""
    time: str | float = ""

    def __post_init__(self) -> None:
        self.max_memory, self.time = str(self.max_memory), str(self.time)
        self.memory_bytes()  # which raises `InputError` where it is no amount
        require((self.seconds() or 0.0) <= LONGEST_TIME, "time", self.time, "at most 100h")

    def memory_bytes(self) -> int | None:
        """`max_memory`, or None for no limit."""
        return parse_bytes(str(self.max_memory)) if self.max_memory else None

    def seconds(self) -> float | None:
        """`time`, or None for no limit."""
        return parse_seconds(str(self.time)) if self.time else None


def undecided(mapping: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The settings of a complete configuration that are left to a plan, ``section.key``."""
    return [f"train.{name}" for name in AUTO_SETTINGS if mapping["train"][name] == AUTO]


def parse_bytes(text: str) -> int:
    """``2GiB``, ``1500 MB``, ``300000000``. Raises `InputError`."""
    units = {"": 1, "b": 1, "kib": 2**10, "mib": 2**20, "gib": 2**30, "kb": 10**3, "mb": 10**6, "gb": 10**9}
    return int(_parse(text, units, 1.0, "memory: write 2GiB, 1500MB or a number of bytes"))


def parse_seconds(text: str) -> float:
    """``20s``, ``2m``, ``1.5h``, ``20``. Raises `InputError`."""
    units = {"": 1.0, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}
    return _parse(text, units, 1e-9, "time: write 20s, 2m or 1.5h")


def parse_color(text: str) -> Color:
    """``white``, ``rgb(51, 102, 153)``, ``#336699``, as Pillow's `ImageColor` takes them. Raises `InputError`."""
    try:
        red, green, blue = ImageColor.getrgb(text)[:3]
    except ValueError:
        raise InputError(f"'{text[:40]}' is no colour: write black, white, grey or rgb(51, 102, 153)") from None
    return red / 255.0, green / 255.0, blue / 255.0


def _parse(text: str, units: Mapping[str, float], least: float, expected: str) -> float:
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([a-z]*)\s*", text.lower())
    amount = float(match[1]) * units.get(match[2], math.nan) if match else math.nan
    if not least <= amount < math.inf:
        raise InputError(f"'{text[:40]}' is no amount of {expected}")
    return amount
