"""Training in memory, from Python."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from turbogs_plugin.captures.bundle_adjustment import refine_cameras
from turbogs_plugin.config.components import KINDS, completed
from turbogs_plugin.config.configuration import DEFAULT_CONFIG, Config, load_config
from turbogs_plugin.errors import InputError, nearest
from turbogs_plugin.model.ply import save_ply
from turbogs_plugin.plan import make_plan
from turbogs_plugin.scene import Scene
from turbogs_plugin.scene.offload import place_views
from turbogs_plugin.train.history import Evaluation
from turbogs_plugin.train.inputs import open_scene, resolve_device
from turbogs_plugin.train.loop import Listener, TrainingLoop
from turbogs_plugin.train.metrics import Evaluations, Metrics
from turbogs_plugin.train.run import new_loop
from turbogs_plugin.train.session import TrainingProgress
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import Gaussians


@dataclass(repr=False)
class Fit:
    """A finished training.

    Args:
        gaussians: the model, on the device of the training and in the scene's coordinates.
        scene: what was trained on.
        config: what the training went by, decided by the plan.
        history: the evaluations on the test views, the last one at the end.
        metrics: errors of each test view at the end.
    """

    gaussians: Gaussians
    scene: Scene
    config: Config
    history: list[Evaluation]
    metrics: Metrics

    def save(self, path: Path | str) -> None:
        """Write the model as a .ply in the capture's own coordinates."""
        save_ply(self.gaussians, Path(path), self.scene.frame)

    def __repr__(self) -> str:
        end = self.history[-1]
        return f"Fit of {self.scene!r}: {self.gaussians!r}, {end.psnr:.2f} dB after {end.train_seconds:.1f} s"


def fit(
    scene: Scene | Path | str,
    *overrides: str,
    config: str | Path | Mapping[str, Any] = DEFAULT_CONFIG,
    callback: Callable[[Evaluation], object] | None = None,
    progress: bool = False,
    **strategies: Any,
) -> Fit:
    """Train in memory: nothing is written.

    Args:
        scene: a loaded one, its photos in host memory; or the folder of a capture, which the section `scene` of the
            configuration says how to read.
        overrides: changes of the configuration, ``section.key=value``, as ``"train.iterations=500"``.
        config: name of a packaged configuration, a YAML file, or a mapping like that of a YAML.
        callback: called with each evaluation (`train.evaluate_at`).
        progress: show a line for each evaluation on stderr, and on a terminal the seconds left.
        strategies: objects in the place of those that the configuration names, by kind: ``pixel_sampler=MySampler()``.

    Raises:
        InputError: anything wrong with the input.
        TrainingStopped: the training cannot go on.
    """
    for kind in strategies:
        if kind not in KINDS:
            raise InputError(f"fit: unknown kind of strategy '{kind}': {nearest(kind, KINDS)}")
    settings = load_config(config if isinstance(config, Mapping) else str(config), overrides)
    device = resolve_device(settings.train.device)
    if isinstance(scene, str | Path):
        scene = open_scene(replace(settings.scene, path=str(scene)), settings.train.refine_cameras)
    else:
        scene = refine_cameras(scene, settings.train.refine_cameras)
    plan = make_plan(settings, scene, device)
    loop = new_loop(plan.apply(settings), scene, device, gains=plan.facts.gains)
    for kind, strategy in strategies.items():
        take(loop.trainer, kind, completed(kind, strategy, f"fit: {type(strategy).__name__}"))
    trained = loop.trainer.config
    evaluations = Evaluations(place_views(scene.test, device, trained.train.pixels_place))
    loop.listeners = [evaluations] + ([Called(callback)] if callback else [])
    with closing(TrainingProgress()) as shown:
        if progress:
            loop.listeners.append(shown)
        loop.run()
    assert evaluations.metrics is not None
    return Fit(loop.trainer.gaussians, scene, trained, evaluations.history, evaluations.metrics)


def take(trainer: Trainer, kind: str, strategy: Any) -> None:
    """Put a strategy in the place of the trainer's own, before the first iteration."""
    setattr(trainer, kind, strategy)
    if kind == "view_sampler":
        strategy.setup(trainer.views.cameras, trainer.extent)
    elif kind in ("density", "optimizer"):
        strategy.setup(trainer.gaussians)


@dataclass
class Called(Listener):
    """Calls a function with each evaluation."""

    callback: Callable[[Evaluation], object]

    def evaluated(self, loop: TrainingLoop, evaluation: Evaluation) -> None:
        self.callback(evaluation)
