"""The training of a run in one process, and what it writes into the run's folder."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext
from types import FrameType
from typing import Any

import torch

from turbogs_plugin.captures.fingerprint import capture_difference, capture_state
from turbogs_plugin.errors import InputError, TrainingStopped
from turbogs_plugin.model.ply import save_ply
from turbogs_plugin.plan import Plan
from turbogs_plugin.scene import Scene
from turbogs_plugin.scene.offload import place_views
from turbogs_plugin.train.checkpoint import latest_checkpoint, require_like, save_checkpoint
from turbogs_plugin.train.clock import WallClock, WallRecord
from turbogs_plugin.train.history import Evaluation, append_evaluation
from turbogs_plugin.train.loop import Listener, TrainingLoop
from turbogs_plugin.train.metrics import Evaluations
from turbogs_plugin.train.progress import TrainingProgress
from turbogs_plugin.train.run_files import RunFolder

MODEL, CHECKPOINT = "model, after the pictures", "checkpoint, after the report"
"""Parts of the wall time at the end, in which the run only waits for these files."""

Report = Callable[["RunSession"], object]
"""Writes the report of a finished run."""
Watch = Sequence[Callable[["RunSession"], Listener]]
"""Each is called with a run before it trains, and gives one more listener of the first process's loop."""


class Interrupts:
    """SIGINT and SIGTERM while training: the first asks training to stop after this iteration, a second stops at once.

    Python allows handlers in the main thread alone; in others signals keep their usual effect.

    Args:
        stop: called at the first signal, with its number.
    """

    SIGNALS = (signal.SIGINT, signal.SIGTERM)

    def __init__(self, stop: Callable[[int], None]) -> None:
        self.signal: int | None = None
        self._stop = stop

    def __enter__(self) -> Interrupts:
        handled = self.SIGNALS if threading.current_thread() is threading.main_thread() else ()
        self._previous = {number: signal.signal(number, self._handle) for number in handled}
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.signal is not None:
            raise KeyboardInterrupt
        self.signal = number
        self._stop(number)


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
                    trainer.complete()
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
        except InputError as error:  # in an iteration: from a strategy of one's own, say
            self._threads.shutdown()
            if latest_checkpoint(self.folder.checkpoints) is not None:
                raise TrainingStopped(f"{error}; {self._last_good()}") from error
            if ranks.first:
                self.folder.discard()
            raise
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
