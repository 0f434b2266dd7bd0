"""Options that several commands have, and checks of options."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from turbogs_plugin.errors import InputError

if TYPE_CHECKING:
    from turbogs_plugin.config.configuration import Config

LOCAL, PORT = "127.0.0.1", 8080
"""Where a viewer listens unless told otherwise: for this machine alone."""

Device = Literal["auto", "cpu", "cuda"]
Overrides = Annotated[Positional[tuple[str, ...]], arg(metavar="[section.key=value ...]")]
Count = Annotated[int | None, arg(metavar="N")]
Scene = Annotated[Path | None, arg(metavar="SCENE")]
RunOrModel = Annotated[Positional[Path], arg(metavar="RUN|MODEL")]


@dataclass(frozen=True)
class RunOptions:
    """Options of train and plan that change a configuration.

    Args:
        config: turbogs where absent, turbogs-big, turbogs-ssim, turbogs-paper, paper-literal, 3dgs, 3dgs-as-shipped,
            mcmc, demo, or a .yaml file.
        factor: scale photos down by this.
        device: where to train; auto takes a GPU where there is one.
        max_gaussians: limit of the finished model (density.max_gaussians). While it grows it may have some more.
        max_memory: limit of tensors on the GPU: 2GiB, 1500MB (budget.max_memory). Photos and error maps move to the
            host if need be, then the number of Gaussians is limited.
        time_budget: time of training to end after: 20s, 2m (budget.time). The schedule is fitted to it.
        init: start of the model (train.init): points of the capture, random points, a .ply of points in the capture's
            coordinates, or a model trained anywhere: a .ply, .spz, gsplat's .pt, a checkpoint, or a run's folder.
    """

    config: Annotated[str | None, arg(metavar="NAME_OR_FILE")] = None
    factor: Count = None
    device: Annotated[Device | None, arg(metavar="auto|cpu|cuda")] = None
    max_gaussians: Count = None
    max_memory: Annotated[str | None, arg(metavar="2GiB")] = None
    time_budget: Annotated[str | None, arg(metavar="20s")] = None
    init: Annotated[str | None, arg(metavar="points|random|MODEL")] = None

    def settings(self, scene: Path | None, overrides: tuple[str, ...]) -> Config:
        """The configuration that a command line asks for. No scene leaves the capture open."""
        from turbogs_plugin.config.configuration import DEFAULT_CONFIG, load_config, refuse_overrides
        from turbogs_plugin.plan.memory import with_cap

        refuse_overrides(overrides, {"scene.path": "what SCENE says"})
        require_positive("--max-gaussians", self.max_gaussians)
        given = {"scene.factor": self.factor, "train.device": self.device, "train.init": self.init}
        given |= {"budget.max_memory": self.max_memory, "budget.time": self.time_budget}
        more = [f"{name}={json.dumps(value)}" for name, value in given.items() if value is not None]
        settings = load_config(DEFAULT_CONFIG if self.config is None else self.config, (*overrides, *more))
        if self.max_gaussians is not None:
            settings = with_cap(settings, self.max_gaussians)
        if scene is not None:
            settings.scene.path = str(scene)
        return settings


Flat = Annotated[RunOptions, arg(name="")]
NO_OPTIONS = RunOptions()


@dataclass(frozen=True)
class GivenOptions:
    """Options of eval, render, export and view for a model in the place of a run.

    Args:
        scene: the capture of a model from a file: a .ply, .spz, gsplat's .pt, or a checkpoint. Not with a run's folder.
        factor: scale its photos down by this.
    """

    scene: Scene = None
    factor: Count = None

    def settings(self, overrides: tuple[str, ...]) -> Config | None:
        """The capture and how to render it; None for a run, which says that itself."""
        if self.scene is None:
            if overrides or self.factor is not None:
                option = overrides[0] if self.factor is None else "--factor"
                raise InputError(f"{option} is for a model's file with --scene: a run uses its own configuration")
            return None
        asked = RunOptions(factor=self.factor).settings(self.scene, overrides)
        background = {"background": asked.train.background}  # auto goes by the photos, as in a run
        return asked.without_plan().changed(train=background)


Given = Annotated[GivenOptions, arg(name="")]
NO_SCENE = GivenOptions()


def require_positive(option: str, *values: float | None) -> None:
    """Raise `InputError` unless the values of an option, where there are any, are all above 0."""
    if not all(value is None or 0 < value < math.inf for value in values):
        raise InputError(f"{option} {' '.join(map(str, values))}: it must be above 0 and finite, or left out")


def address(option: str, words: tuple[str, ...]) -> tuple[str, int]:
    """Host and port of ``[HOST:]PORT``, which are `words` of an option. Raises `InputError` for other words."""
    host, _, port = " ".join(words).rpartition(":")
    if not port.isdecimal():
        raise InputError(f"{option} {' '.join(words)}: write a port, as 8080, or host and port, as 0.0.0.0:8080")
    return host.strip("[]") or LOCAL, int(port)
