"""A run and its folder: training with evaluations and checkpoints, new or resumed, up to a saved model."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from turbogs_plugin.config.configuration import DEFAULT_CONFIG, Config, load_config, resolve
from turbogs_plugin.distributed.ranks import ONE, Ranks
from turbogs_plugin.errors import InputError, TrainingStopped
from turbogs_plugin.files import require_writable, write_text_atomically
from turbogs_plugin.model.ply import save_ply
from turbogs_plugin.plan import Plan, make_plan
from turbogs_plugin.scene import Scene
from turbogs_plugin.scene.camera_refinement import refine_cameras
from turbogs_plugin.scene.fingerprint import capture_difference, capture_state
from turbogs_plugin.scene.load import holds_photos_alone
from turbogs_plugin.scene.offload import place_views
from turbogs_plugin.train.calibration import Calibration, budget_text, hold_to, within_budget
from turbogs_plugin.train.checkpoint import latest_checkpoint, load_checkpoint, require_like, save_checkpoint
from turbogs_plugin.train.evaluate import load_lpips
from turbogs_plugin.train.evaluations import Evaluations
from turbogs_plugin.train.finished import require_unfinished
from turbogs_plugin.train.folder import RunFolder
from turbogs_plugin.train.history import Evaluation, append_evaluation, rewind_history
from turbogs_plugin.train.interrupts import Interrupts
from turbogs_plugin.train.loop import Listener, TrainingLoop
from turbogs_plugin.train.pace import pace_of
from turbogs_plugin.train.progress import TrainingProgress
from turbogs_plugin.train.start import open_scene, read_scene, require_possible, resolve_device, starting
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.train.wall import WallClock, WallRecord
from turbogs_plugin.types import Gaussians

IMPORTS, CAMERAS = "interpreter and imports", "cameras of photos alone"
PHOTOS, DEVICE = "photos", "CUDA and kernels, after the photos"
"""Parts of the wall time before a plan is made."""
MODEL, CHECKPOINT = "model, after the pictures", "checkpoint, after the report"
"""Parts of the wall time at the end in which nothing else is left to do than to wait for these files."""


Report = Callable[["RunSession"], object]
"""Writes the report of a finished run."""
Watch = Sequence[Callable[["RunSession"], Listener]]
"""Each is called with a run before it trains, and gives one more listener of the first process's loop."""


def plan_run(config: Config, processes: int = 1) -> Plan:
    """The plan that `train` would make now. What the capture was taken for is printed.

    Args:
        processes: that would train together.

    Raises:
        InputError: anything wrong with the input.
    """
    require_possible(config)
    device = resolve_device(config.train.device)
    scene = open_scene(config, training=True)
    plan = make_plan(config, scene, device, processes)
    print("\n".join(scene.notes), file=sys.stderr)  # last, as an error is one line alone
    return plan


def new_loop(
    config: Config, scene: Scene, device: torch.device, ranks: Ranks = ONE
) -> tuple[TrainingLoop, Calibration | None]:
    """A training that has not begun, fitted to its budgets. Runs and the cells of studies both begin here.

    Args:
        config: nothing in it is `auto` any more (`Plan.apply`). The trainer gets it fitted to the budgets.
        ranks: the processes that train this model together; each calls this.

    Returns:
        The loop, without listeners; and the measurements for a time budget, whose seconds the loop's clock includes.

    Raises:
        InputError: a budget is too small; the message names one that would do.
    """
    config, calibration = within_budget(_agreed(config, ranks), scene, device, ranks)
    trainer = Trainer(config, scene, device, ranks=ranks)
    pace = pace_of(config, calibration and calibration.cost)
    seconds = calibration.seconds if calibration else 0.0
    return TrainingLoop(trainer, pace, seconds=seconds), calibration


def _agreed(config: Config, ranks: Ranks) -> Config:
    """The first process's configuration: plans look at the machine's free memory, which differs."""
    return config if ranks.count == 1 else resolve(ranks.agree(config.to_mapping()))


def fit(scene: Scene | Path | str, *overrides: str, config: str = DEFAULT_CONFIG) -> Gaussians:
    """Train in memory: nothing is written, nothing is printed.

    Args:
        scene: a loaded one, its photos in host memory; or the folder of a capture, which the section `scene` of the
            configuration says how to read.
        overrides: changes of the configuration, ``section.key=value``.
        config: name of a packaged configuration, or a YAML file.

    Returns:
        The model, on the device of the training and in the scene's coordinates.

    Raises:
        InputError: anything wrong with the input.
        TrainingStopped: the model is lost.
    """
    settings = load_config(config, overrides)
    device = resolve_device(settings.train.device)
    if isinstance(scene, str | Path):
        scene = read_scene(scene, settings)
    else:
        scene = refine_cameras(scene, settings.train.refine_cameras)
    loop, _ = new_loop(make_plan(settings, scene, device).apply(settings), scene, device)
    loop.run()
    loop.trainer.require_finite()
    return loop.trainer.gaussians


def train(
    config: Config,
    out: Path,
    report: Report | None = None,
    clock: WallClock | None = None,
    ranks: Ranks = ONE,
    watch: Watch = (),
) -> RunSession:
    """Train from the start into a new folder. The plan is printed first. Photos alone are reconstructed before.

    Args:
        report: called with the finished run; `turbogs_plugin.report.pages.write_report` writes its page.
        clock: of the wall; None: it begins now.
        ranks: the processes that train this model together; each calls this, and the first one writes and prints.
        watch: further listeners.

    Raises:
        InputError: anything wrong with the input; then nothing was written.
        TrainingStopped: the run cannot go on; the files that it saved stay.
    """
    clock = clock or WallClock()
    clock.mark(IMPORTS)
    folder = RunFolder(out)
    if ranks.first:
        folder.require_new()
    require_possible(config)
    _try_lpips(config, report is not None)
    posed = ranks.agree(_posed_capture(config, out) if ranks.first else None)
    if posed != config.scene.path:
        clock.mark(CAMERAS)
        config = replace(config, scene=replace(config.scene, path=posed))
    with starting(lambda: resolve_device(config.train.device)) as started:
        scene = open_scene(config, training=True, ranks=ranks)
        clock.mark(PHOTOS)
        device = started.result()
    clock.mark(DEVICE)
    plan = make_plan(config, scene, device, ranks.count)
    clock.mark("plan")
    remedy = "use train.photos_place=host and train.maps_place=host, --max-gaussians or a larger --factor"
    with _fitting(scene, remedy):
        loop, calibration = new_loop(_independent(plan.apply(config), device), scene, device, ranks)
        session = RunSession(folder, plan, scene, loop, clock)
    if ranks.first:
        resolved = loop.trainer.config
        said = [*scene.notes, plan.text(), budget_text(resolved, calibration)]
        print("\n".join(filter(None, said)), file=sys.stderr)
        folder.path.mkdir(parents=True, exist_ok=True)
        write_text_atomically(folder.plan, plan.to_json())
        write_text_atomically(folder.asked, config.to_yaml())
        write_text_atomically(folder.config, resolved.to_yaml())
    return session.run(report, watch)


def resume(
    path: Path, report: Report | None = None, clock: WallClock | None = None, ranks: Ranks = ONE, watch: Watch = ()
) -> RunSession:
    """Go on with a stopped run from its newest checkpoint, with its own configuration, in which nothing is `auto`.

    On a CPU, the result is bit for bit that of a run never stopped; `Trainer.state_dict` says why.

    Args:
        report, clock, ranks, watch: as in `train`. The number of processes may be another than before.

    Raises:
        InputError: no run there, a finished one without checkpoints, an unusable checkpoint, a changed
            capture, or a machine without what the run needs; then nothing was changed.
        TrainingStopped: the run cannot go on.
    """
    clock = clock or WallClock()
    clock.mark(IMPORTS)
    folder = RunFolder(path)
    config, plan = folder.read_config(), folder.read_plan()
    earlier = WallRecord.read(folder.wall)
    checkpoint = latest_checkpoint(folder.checkpoints)
    if checkpoint is None:
        require_unfinished(folder)
    state = None if checkpoint is None else load_checkpoint(checkpoint)
    device = resolve_device(config.train.device, "go on with this run where there is a GPU, or see 'turbogs doctor'")
    require_writable(folder.path, f"what --resume {folder.path} writes")
    _try_lpips(config, report is not None)
    with starting(lambda: device) as started:
        scene = open_scene(config, folder, training=True, ranks=ranks)
        clock.mark(PHOTOS)
        started.result()
    clock.mark(DEVICE)
    limit = config.budget.memory_bytes()
    if limit is not None:
        hold_to(limit, device)
    with _fitting(scene, "end what else is in that memory, or go on with this run where there is more"):
        resuming = state is not None
        loop = TrainingLoop(Trainer(config, scene, device, resuming, ranks), pace_of(config))
        session = RunSession(folder, plan, scene, loop, clock)
        if state is not None:
            session.load_state_dict(state, str(checkpoint))
            session.earlier_wall = earlier.wall_seconds if earlier else math.nan
    if ranks.first:
        session.history += rewind_history(folder.history, loop.trainer.iteration if session.resumed else -1)
    return session.run(report, watch)


def _posed_capture(config: Config, out: Path) -> str:
    """The path of the capture; where that is of photos alone, of their reconstruction, which is made."""
    if not holds_photos_alone(Path(config.scene.path)):
        return config.scene.path
    from turbogs_plugin.reconstruct.train_on_photos import reconstruct_beside  # no other run needs that room

    return str(reconstruct_beside(config, out))


def _try_lpips(config: Config, reported: bool) -> None:
    """Load LPIPS, which the report uses, so that weights that cannot be read are refused before photos are."""
    if reported or config.report.lpips_weights is not None:
        load_lpips(config.report.lpips_weights, torch.device("cpu"))


@contextmanager
def _fitting(scene: Scene, remedy: str) -> Iterator[None]:
    """Turn a lack of device memory before training into an `InputError` that names a remedy."""
    try:
        yield
    except torch.cuda.OutOfMemoryError:
        raise InputError(f"'{scene.name}' does not fit into the device's memory: {remedy}") from None


def _independent(config: Config, device: torch.device) -> Config:
    """The configuration with absolute paths and the device in use, so that a resume finds the same from any folder."""
    config.scene.path = str(Path(config.scene.path).resolve())
    if config.train.starts_from_model:
        config.train.init = str(Path(config.train.init).resolve())
    if config.report.lpips_weights is not None:
        config.report.lpips_weights = str(Path(config.report.lpips_weights).resolve())
    config.train.device = device.type
    return config


class RunSession(Listener):
    """The part of a run in one process: trains, and writes the results into the run's folder.

    Attributes:
        plan: the plan of the run; None if its folder holds none.
        test: the test views, on the trainer's device.
        history: every evaluation of the run.
        resumed: whether the trainer's state was loaded.
        signal: the signal that stopped the training; None at the end of the run.
        clock: of the wall, in this process.
        earlier_wall: seconds on the wall of the processes before; NaN where one did not record them.
        wall: what is recorded of it when the model is written.

    At the end of a run, threads write checkpoint and model while the report's pictures are made.
    """

    def __init__(
        self, folder: RunFolder, plan: Plan | None, scene: Scene, loop: TrainingLoop, clock: WallClock | None = None
    ) -> None:
        self.folder, self.plan, self.scene, self.loop = folder, plan, scene, loop
        self.clock, self.earlier_wall, self.wall = clock or WallClock(), 0.0, WallRecord(0.0)
        self.trainer = loop.trainer
        self.test = place_views(scene.test, self.trainer.device, self.trainer.config.train.photos_place)
        self.evaluations = Evaluations(self.test)
        self.history = self.evaluations.history
        self.resumed = False
        self.signal: int | None = None
        self._saved_at = -1
        self._finished_before = False
        self._threads = ThreadPoolExecutor(2, "files")
        self._model: Future[float] | None = None
        self._checkpoint: Future[float] | None = None

    def run(self, report: Report | None, watch: Watch = ()) -> RunSession:
        """Train to the end, or until a signal; both end with a checkpoint."""
        loop, trainer, ranks = self.loop, self.trainer, self.loop.ranks
        self._finished_before = loop.finished
        if ranks.first:
            self.folder.wall.unlink(missing_ok=True)  # so that a killed process leaves none: it is not counted as 0
        self.clock.mark("initial model")
        try:
            shown = TrainingProgress(trainer.iterations, trainer.iteration) if ranks.first else nullcontext()
            with Interrupts(loop.stop) as interrupts, shown:
                # First the session, so that its marks tell apart what the others do.
                loop.listeners = [self, self.evaluations, shown] if ranks.first else [self]
                loop.listeners += [listener_of(self) for listener_of in watch if ranks.first]
                loop.run(self.resumed)
                self.clock.mark("training")
                if loop.stopped and trainer.iteration != self._saved_at:
                    trainer.compare_replicas()
                    self._save()
            self.signal = None if loop.finished else ranks.stop_signal or interrupts.signal
            if not ranks.first:
                return self
            if loop.finished:
                self._model = self._in_thread(save_ply, trainer.gaussians, self.folder.model, self.scene.frame)
                if report is not None:
                    report(self)
            self.finish_model()
            if self._checkpoint is not None:
                self._checkpoint.result()
            self.clock.mark(CHECKPOINT)
            self.wall.parts = self.clock.parts
            self.wall.write(self.folder.wall)
        except TrainingStopped as stop:
            raise TrainingStopped(f"{stop}; {self._last_good()}") from stop
        except torch.cuda.OutOfMemoryError as error:
            raise TrainingStopped(
                f"iteration {trainer.iteration}: the device's memory was too small for {len(trainer.gaussians)} "
                f"Gaussians; try --max-gaussians {round(0.7 * len(trainer.gaussians))}; {self._last_good()}"
            ) from error
        finally:
            self._threads.shutdown()
        return self

    def finish_model(self) -> None:
        """Wait until the model is written, if the run is finished, and set `wall`. The checkpoint, which is many times
        larger, may come later. Raises `TrainingStopped` if the disk refused."""
        end = self.clock.seconds if self._model is None else self._model.result()
        self.clock.mark(MODEL)
        seconds = 0.0 if self._finished_before else end
        self.wall = WallRecord(self.loop.clock.seconds, self.earlier_wall + seconds, self.clock.parts)

    def begun(self, loop: TrainingLoop) -> None:
        self.clock.mark("initial maps")

    def evaluating(self, loop: TrainingLoop) -> None:
        self.clock.mark("training")

    def evaluated(self, loop: TrainingLoop, evaluation: Evaluation) -> None:
        self.clock.mark("evaluations" if evaluation.iteration else "first evaluation")
        append_evaluation(self.folder.history, evaluation)

    def checkpoint_due(self, loop: TrainingLoop) -> None:
        self.clock.mark("training")
        self._save()
        self.clock.mark("checkpoints")

    def state_dict(self) -> dict[str, Any]:
        return {
            "trainer": self.trainer.state_dict(),
            "train_seconds": self.loop.clock.seconds,
            "pace": self.loop.pace.state_dict(),
            **capture_state(self.scene),
        }

    def load_state_dict(self, state: dict[str, Any], source: str) -> None:
        present, loop = self.state_dict(), self.loop
        try:
            require_like(state, present, "state")
            difference = capture_difference(state, present)
            if not difference:
                loop.pace.load_state_dict(state["pace"])
                self.trainer.set_length(loop.pace.iterations, loop.pace.refine_until)
                self.trainer.load_state_dict(state["trainer"])
                loop.clock.seconds = state["train_seconds"]
                self.resumed = True
        except torch.cuda.OutOfMemoryError:  # a RuntimeError too, but not the checkpoint's fault
            raise
        except (KeyError, TypeError, AttributeError, IndexError, ArithmeticError, RuntimeError, ValueError) as error:
            raise InputError(f"checkpoint '{source}' does not fit this run and its capture: {error}") from None
        if difference:
            path = self.trainer.config.scene.path
            raise InputError(
                f"capture '{path}' has {difference} than when the run in '{self.folder.path}' began: "
                "bring that state of it back, or train anew with another --out"
            )

    def _save(self) -> None:
        """Write a checkpoint; at the end of the run, when nothing changes the state any more, by a thread."""
        self.trainer.require_finite()
        if self.loop.ranks.first:
            arguments = (self.folder.checkpoints, self.trainer.iteration, self.state_dict())
            if self.loop.finished:
                self._checkpoint = self._in_thread(save_checkpoint, *arguments)
            else:
                with self.loop.ranks.working():
                    save_checkpoint(*arguments)
        self._saved_at = self.trainer.iteration

    def _in_thread(self, write: Callable[..., object], *arguments: object) -> Future[float]:
        """Begin to write a file. The result is when it was written, in seconds on the wall."""

        def timed() -> float:
            write(*arguments)
            return self.clock.seconds

        return self._threads.submit(timed)

    def _last_good(self) -> str:
        self._threads.shutdown()  # it may still be on its way to the disk
        checkpoint = latest_checkpoint(self.folder.checkpoints)
        return f"the last good checkpoint is '{checkpoint}'" if checkpoint else "no checkpoint was saved before"
