"""A run and its folder: training with a clock, evaluations, checkpoints and a report, from the start or from a stop."""

from __future__ import annotations

import operator
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

import torch

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.errors import InputError, TrainingStopped
from turbogs_plugin.files import write_text_atomically
from turbogs_plugin.model.ply import save_ply
from turbogs_plugin.plan import Plan, make_plan
from turbogs_plugin.report.pages import RunRecord, write_report
from turbogs_plugin.scene import Frame, PosedImages, Scene, load_scene
from turbogs_plugin.scene.fingerprint import capture_difference, capture_state, frame_of_state
from turbogs_plugin.scene.offload import place_views
from turbogs_plugin.train.calibration import budget_text, hold_to, within_budget
from turbogs_plugin.train.checkpoint import latest_checkpoint, load_checkpoint, require_like, save_checkpoint
from turbogs_plugin.train.clock import TrainingClock
from turbogs_plugin.train.evaluate import Metrics, evaluate, load_lpips, peak_memory_bytes
from turbogs_plugin.train.folder import RunFolder
from turbogs_plugin.train.history import Evaluation, append_evaluation, rewind_history
from turbogs_plugin.train.pace import Pace, pace_of
from turbogs_plugin.train.progress import TrainingProgress
from turbogs_plugin.train.trainer import Trainer, gaussians_of_state
from turbogs_plugin.types import Gaussians


@dataclass
class Outcome:
    """How a call of `train` or `resume` ended. `signal`: the one that stopped it, or None at the end of the run."""

    folder: RunFolder
    history: list[Evaluation]
    signal: int | None = None


@dataclass
class SavedModel:
    """What is needed of a run to look at its model."""

    folder: RunFolder
    config: Config
    gaussians: Gaussians
    frame: Frame
    iteration: int

    @property
    def sh_degree(self) -> int:
        return self.config.train.sh_degree_at(self.iteration)


def resolve_device(name: str, remedy: str = "use --device cpu, or see 'turbogs doctor'") -> torch.device:
    """The device of ``auto``, ``cpu`` or ``cuda``. Raises `InputError` where CUDA is asked for and absent."""
    if name == "cuda" and not torch.cuda.is_available():
        build = "this PyTorch is built without CUDA" if torch.version.cuda is None else "no GPU answers"
        raise InputError(f"CUDA was asked for and is absent ({build}): {remedy}")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def open_scene(config: Config, folder: RunFolder | None = None) -> Scene:
    """The capture of a configuration.

    Args:
        folder: of the run that names the capture, where the user does not.

    Raises:
        InputError: no usable capture there.
    """
    settings = config.scene
    if folder is not None and not Path(settings.path).exists():
        raise InputError(
            f"capture '{settings.path}' of the run in '{folder.path}' is not there: bring it back, or edit scene.path "
            f"in {folder.config}"
        )
    return load_scene(settings.path, settings.factor, settings.test_every)


def plan_run(config: Config) -> Plan:
    """What `train` would decide here and now.

    Raises:
        InputError: anything wrong with the input.
    """
    device = resolve_device(config.train.device)
    return _plan(config, open_scene(config), device)


def _plan(config: Config, scene: Scene, device: torch.device) -> Plan:
    limit, seconds = config.budget.memory_bytes(), config.budget.seconds()
    return make_plan(config, scene, device, memory_limit=limit, time_budget=seconds)


def train(config: Config, out: Path) -> Outcome:
    """Train from the start into a new folder, by a plan that is told first.

    Raises:
        InputError: anything wrong with the input; then nothing was written.
        TrainingStopped: the run cannot go on; what it saved stays.
    """
    folder = RunFolder(out)
    folder.require_new()
    device = resolve_device(config.train.device)
    scene = open_scene(config)
    load_lpips(config.report.lpips_weights, device)
    plan = _plan(config, scene, device)
    remedy = "use train.photos_place=host and train.maps_place=host, --max-gaussians or a larger --factor"
    with _fitting(scene, remedy):
        config, calibration = within_budget(plan.apply(config), scene, device)
        trainer = Trainer(config, scene, device)
        _make_independent(config, device)
        pace = pace_of(config, calibration and calibration.cost)
        session = _Session(folder, config, plan, scene, trainer, pace)
    session.clock.seconds = calibration.seconds if calibration else 0.0
    print("\n".join(filter(None, [plan.text(), budget_text(config, calibration)])), file=sys.stderr)
    folder.path.mkdir(parents=True, exist_ok=True)
    write_text_atomically(folder.plan, plan.to_json())
    write_text_atomically(folder.config, config.to_yaml())
    return session.run()


def resume(path: Path) -> Outcome:
    """Go on with a stopped run from its newest checkpoint, by its own configuration, in which all is decided.

    On a CPU, the result is bit for bit that of a run never stopped.

    Raises:
        InputError: no run there, an unusable checkpoint, a capture that is no longer what it was, or a machine that
            does not have what the run needs; then nothing was changed.
        TrainingStopped: the run cannot go on.
    """
    folder = RunFolder(path)
    config, plan = folder.read_config(), folder.read_plan()
    checkpoint = latest_checkpoint(folder.checkpoints)
    state = None if checkpoint is None else load_checkpoint(checkpoint)
    device = resolve_device(config.train.device, "go on with this run where there is a GPU, or see 'turbogs doctor'")
    scene = open_scene(config, folder)
    load_lpips(config.report.lpips_weights, device)
    limit = config.budget.memory_bytes()
    if limit is not None:
        hold_to(limit, device)
    with _fitting(scene, "end what else is in that memory, or go on with this run where there is more"):
        session = _Session(folder, config, plan, scene, Trainer(config, scene, device), pace_of(config))
        if state is not None:
            session.load_state_dict(state, str(checkpoint))
    session.history = rewind_history(folder.history, session.trainer.iteration if state is not None else -1)
    return session.run()


@contextmanager
def _fitting(scene: Scene, remedy: str) -> Iterator[None]:
    """Around what takes memory of the device before training; where there is too little, the user hears of a remedy."""
    try:
        yield
    except torch.cuda.OutOfMemoryError:
        raise InputError(f"'{scene.name}' does not fit into the device's memory: {remedy}") from None


def _make_independent(config: Config, device: torch.device) -> None:
    """Write into a run's configuration what else would depend on where it is resumed from."""
    config.scene.path = str(Path(config.scene.path).resolve())
    if config.report.lpips_weights is not None:
        config.report.lpips_weights = str(Path(config.report.lpips_weights).resolve())
    config.train.device = device.type


def load_model(path: Path, device: torch.device) -> SavedModel:
    """The newest saved model of a run.

    Raises:
        InputError: no run there, no checkpoint, or an unusable one.
    """
    folder = RunFolder(path)
    config = folder.read_config()
    checkpoint = latest_checkpoint(folder.checkpoints)
    if checkpoint is None:
        raise InputError(f"'{path}' has no checkpoint yet: let the run go on with  turbogs train --resume {path}")
    state = load_checkpoint(checkpoint)
    try:
        frame = frame_of_state(state)
        trained = state["trainer"]
        iteration = operator.index(trained["iteration"])
        return SavedModel(folder, config, gaussians_of_state(trained, device), frame, iteration)
    except (KeyError, TypeError, AttributeError, IndexError, ValueError, RuntimeError) as error:
        raise InputError(f"checkpoint '{checkpoint}' is not one of a run: {error}") from None


class _Interrupts:
    """Turns SIGINT and SIGTERM into a wish to stop after this iteration; a second one stops at once.

    Only in the main thread: in others, Python lets nobody handle signals, and they are left as they are.
    """

    SIGNALS = (signal.SIGINT, signal.SIGTERM)

    def __init__(self) -> None:
        self.signal: int | None = None

    def __enter__(self) -> _Interrupts:
        handled = self.SIGNALS if threading.current_thread() is threading.main_thread() else ()
        self._previous = {number: signal.signal(number, self._handle) for number in handled}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.signal is not None:
            raise KeyboardInterrupt
        self.signal = number


@dataclass
class _Session:
    """One process's share of a run."""

    folder: RunFolder
    config: Config
    plan: Plan | None
    scene: Scene
    trainer: Trainer
    pace: Pace
    history: list[Evaluation] = field(default_factory=list)
    resumed: bool = False
    saved_at: int = -1

    def __post_init__(self) -> None:
        self.device = self.trainer.gaussians.device
        self.test: PosedImages = place_views(self.scene.test, self.device, self.config.train.photos_place)
        self.clock = TrainingClock(self.device)

    def run(self) -> Outcome:
        """Train to the end, or until a signal; both end with a checkpoint."""
        trainer, pace = self.trainer, self.pace
        try:
            with _Interrupts() as interrupts, TrainingProgress(pace.iterations, trainer.iteration) as progress:
                if not self.resumed:
                    with self.clock:
                        trainer.initialise_maps()
                if not self.history:
                    self._evaluate(progress)
                pace.start(trainer.iteration, self.clock.seconds, len(trainer.gaussians))
                while trainer.iteration < pace.iterations and interrupts.signal is None:
                    mark = pace.next_mark(trainer.iteration, self.clock.seconds)
                    with self.clock:
                        while trainer.iteration < mark and interrupts.signal is None:
                            trainer.step_towards(mark)
                            progress.advance(trainer.iteration, len(trainer.gaussians))
                    due = pace.reached(trainer.iteration, self.clock.seconds, len(trainer.gaussians))
                    progress.total = pace.iterations
                    if due.evaluate:
                        self._evaluate(progress)
                    if due.save:
                        self._save()
                trainer.repeat_lost(wait=True)  # a stop between marks must not count iterations that did nothing
                if interrupts.signal is not None and trainer.iteration != self.saved_at:
                    self._save()
            finished = trainer.iteration == pace.iterations
            if finished:
                self._finish()
        except TrainingStopped as stop:
            raise TrainingStopped(f"{stop}; {self._last_good()}") from stop
        except torch.cuda.OutOfMemoryError as error:
            raise TrainingStopped(
                f"iteration {trainer.iteration}: the device's memory was too small for {len(trainer.gaussians)} "
                f"Gaussians; try --max-gaussians {round(0.7 * len(trainer.gaussians))}; {self._last_good()}"
            ) from error
        return Outcome(self.folder, self.history, None if finished else interrupts.signal)

    def state_dict(self) -> dict[str, Any]:
        return {
            "trainer": self.trainer.state_dict(),
            "train_seconds": self.clock.seconds,
            "pace": self.pace.state_dict(),
            **capture_state(self.scene),
        }

    def load_state_dict(self, state: dict[str, Any], source: str) -> None:
        present = self.state_dict()
        try:
            require_like(state, present, "state")
            difference = capture_difference(state, present)
            if not difference:
                self.pace.load_state_dict(state["pace"])
                self.trainer.load_state_dict(state["trainer"])
                self.clock.seconds = state["train_seconds"]
                self.resumed = True
        except torch.cuda.OutOfMemoryError:  # a RuntimeError, which says nothing of the checkpoint
            raise
        except (KeyError, TypeError, AttributeError, IndexError, ArithmeticError, RuntimeError, ValueError) as error:
            raise InputError(f"checkpoint '{source}' does not fit this run and its capture: {error}") from None
        if difference:
            raise InputError(
                f"capture '{self.config.scene.path}' has {difference} than when the run in '{self.folder.path}' began: "
                "bring that state of it back, or train anew with another --out"
            )

    def _evaluate(self, progress: TrainingProgress) -> None:
        trainer = self.trainer
        trainer.require_finite()
        metrics = evaluate(trainer.gaussians, self.test, trainer.sh_degree, self.config.raster)
        memory = peak_memory_bytes(self.device)
        evaluation = Evaluation.of(trainer, metrics, self.clock.seconds, memory)
        self.history.append(evaluation)
        append_evaluation(self.folder.history, evaluation)
        progress.evaluated(evaluation)

    def _save(self) -> None:
        self.trainer.require_finite()
        save_checkpoint(self.folder.checkpoints, self.trainer.iteration, self.state_dict())
        self.saved_at = self.trainer.iteration

    def _finish(self) -> None:
        """The model as a .ply and the report."""
        trainer = self.trainer
        save_ply(trainer.gaussians, self.folder.model, self.scene.frame)
        lpips, lpips_reason = load_lpips(self.config.report.lpips_weights, self.device)
        final: Metrics = evaluate(trainer.gaussians, self.test, trainer.sh_degree, self.config.raster, lpips)
        write_report(
            RunRecord(
                folder=self.folder.path,
                scene=self.scene.name,
                config=self.config,
                plan=self.plan,
                history=self.history,
                metrics=final,
                lpips_reason=lpips_reason,
                num_train_views=len(self.scene.train),
            ),
            trainer.gaussians,
            self.test,
            trainer.sh_degree,
        )

    def _last_good(self) -> str:
        checkpoint = latest_checkpoint(self.folder.checkpoints)
        return f"the last good checkpoint is '{checkpoint}'" if checkpoint else "no checkpoint was saved before"
