"""The training of a run in one process: what it writes into the run's folder, and its progress on stderr."""

from __future__ import annotations

import json
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict
from types import FrameType
from typing import Any

import torch

from turbogs_plugin.device import free_device_memory
from turbogs_plugin.errors import InputError, TrainingStopped, refused_file
from turbogs_plugin.files import write_text_atomically
from turbogs_plugin.model.ply import save_ply
from turbogs_plugin.scene import Scene
from turbogs_plugin.scene.fingerprint import capture_difference, capture_state
from turbogs_plugin.scene.offload import place_views
from turbogs_plugin.train.checkpoint import latest_checkpoint, load_checkpoint, require_like, save_checkpoint
from turbogs_plugin.train.history import Evaluation, append_evaluation, rewind_history
from turbogs_plugin.train.loop import Listener, TrainingLoop
from turbogs_plugin.train.metrics import Evaluations
from turbogs_plugin.train.run_files import RunFolder
from turbogs_plugin.train.wall import WallClock, WallRecord

Report = Callable[["RunSession"], object]
"""Writes the report of a finished run."""
Watch = Sequence[Callable[["RunSession"], Listener]]
"""Functions that are called with a run before it trains, and give one more listener of its first process each."""
REFRESH_SECONDS = 0.1
"""Time between two updates of the terminal's line, so that fast iterations are not slowed down."""


@contextmanager
def interruptible(stop: Callable[[int], None]) -> Iterator[None]:
    """While entered, the first SIGINT, SIGTERM or SIGHUP calls `stop` with its number, and a second one ends the
    process, but for SIGHUP: a terminal that closes and its shell send one each. nohup's SIGHUP stays ignored. Outside
    the main thread, to which alone Python allows handlers, signals keep their usual effect."""
    here = threading.current_thread() is threading.main_thread()
    hangup = signal.SIGHUP if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN else signal.SIGTERM
    handled = {signal.SIGINT, signal.SIGTERM, hangup} if here else set()
    terminals = [descriptor for descriptor in (1, 2) if os.isatty(descriptor)]  # a closed one is none

    def handle(number: int, frame: FrameType | None) -> None:
        for each in handled:
            signal.signal(each, signal.SIG_IGN if each == signal.SIGHUP else signal.default_int_handler)
        if number == signal.SIGHUP:  # whoever writes to a closed terminal ends by an error
            for descriptor in terminals:
                os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)
        stop(number)

    previous = {number: signal.signal(number, handle) for number in handled}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


class RunSession(Listener):
    """The part of a run in one process: trains, and writes the results into the run's folder.

    Attributes:
        test: the test views, on the trainer's device.
        resumed: whether the trainer's state was loaded.
        signal: the signal that stopped the training; None at the end of the run.
        wall: what is recorded of the `clock` when the model is written.
    """

    def __init__(self, folder: RunFolder, scene: Scene, loop: TrainingLoop, clock: WallClock) -> None:
        self.folder, self.scene, self.loop = folder, scene, loop
        self.clock, self.wall = clock, WallRecord(0.0)
        self.trainer = loop.trainer
        self.test = place_views(scene.test, self.trainer.device, self.trainer.config.train.pixels_place)
        self.evaluations = Evaluations(self.test)
        self.history = self.evaluations.history
        self.signal: int | None = None
        self.resumed, self._saved_at = False, -1

    def run(self, report: Report | None, watch: Watch = ()) -> RunSession:
        """Train to the end, or until a signal; both end with a checkpoint. The model is written before it."""
        loop, trainer, ranks, began = self.loop, self.trainer, self.loop.ranks, self.trainer.iteration
        self.clock.mark("initial model")
        try:
            with interruptible(self._stop), closing(TrainingProgress()) as progress:
                loop.listeners = [self]  # first, so that its marks tell apart what the others do
                if ranks.first:
                    loop.listeners += [self.evaluations, progress, *(listener_of(self) for listener_of in watch)]
                self._train()
                self.clock.mark("training")
                if loop.finished and ranks.first:
                    trainer.require_finite()
                    save_ply(trainer.gaussians, self.folder.model, self.scene.frame)
                    self.clock.mark("model")
                seconds = None if self.resumed else self.clock.seconds
                if trainer.iteration != self._saved_at:
                    trainer.complete()
                    self._save()
            self.signal = None if loop.finished else ranks.stop_signal or self.signal
            if not ranks.first:
                return self
            earlier = WallRecord.read(self.folder.wall) if self.resumed and began == trainer.iteration else None
            self.wall = earlier or WallRecord(loop.clock.seconds, seconds, self.clock.parts)
            try:
                if loop.finished and report is not None:
                    report(self)
            finally:
                write_text_atomically(self.folder.wall, json.dumps(asdict(self.wall), indent=1) + "\n")
        except TrainingStopped as stop:
            raise TrainingStopped(f"{stop}; {self._last_good()}") from stop
        except OSError as error:
            raise TrainingStopped(f"{refused_file(error)}; {self._last_good()}") from error
        except torch.cuda.OutOfMemoryError as error:
            said = f"iteration {trainer.iteration}: the device's memory was too small for {len(trainer.gaussians)}"
            remedy = f"try --max-gaussians {round(0.7 * len(trainer.gaussians))}"
            raise TrainingStopped(f"{said} Gaussians; {remedy}; {self._last_good()}") from error
        return self

    def _train(self) -> None:
        """Train to the end or a signal; once more from the newest checkpoint where the device's memory, which others
        may share, is full on the way, with memory of passes sized anew."""
        try:
            return self.loop.run(self.resumed)
        except torch.cuda.OutOfMemoryError:
            checkpoint = latest_checkpoint(self.folder.checkpoints)
            if checkpoint is None or self.loop.ranks.count > 1:
                raise
        full = self.trainer.iteration
        self.trainer.engine = self.loop.ranks.engine(self.trainer.device)
        free_device_memory(self.trainer.device)
        self.load_state_dict(load_checkpoint(checkpoint), str(checkpoint))
        self.history[:] = rewind_history(self.folder.history, self.trainer.iteration)
        line = f"iteration {full}: the device's memory was full; once more from iteration {self.trainer.iteration}"
        print(line, file=sys.stderr, flush=True)
        return self.loop.run(resumed=True)

    def _stop(self, number: int) -> None:
        self.signal = number
        self.loop.stop(number)

    def begun(self, loop: TrainingLoop) -> None:
        self.clock.mark("initial maps")

    def evaluation_due(self, loop: TrainingLoop) -> None:
        self.clock.mark("training")

    def evaluated(self, loop: TrainingLoop, evaluation: Evaluation) -> None:
        self.clock.mark("evaluations" if evaluation.iteration else "first evaluation")
        append_evaluation(self.folder.history, evaluation)

    def checkpoint_due(self, loop: TrainingLoop) -> None:
        if not loop.finished:
            self.clock.mark("training")
            self._save()

    def state_dict(self) -> dict[str, Any]:
        return {
            "trainer": self.trainer.state_dict(ended=self.loop.finished),
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
                self.resumed, self._saved_at = True, self.trainer.iteration
        except torch.cuda.OutOfMemoryError:  # a RuntimeError too, but not the checkpoint's fault
            raise
        except (KeyError, TypeError, AttributeError, IndexError, ArithmeticError, RuntimeError, ValueError) as error:
            raise InputError(f"checkpoint '{source}' does not fit this run and its capture: {error}") from None
        if difference:
            path, run = self.trainer.config.scene.path, self.folder.path
            changed = f"capture '{path}' has {difference} than when the run in '{run}' began"
            raise InputError(f"{changed}: bring that state of it back, or train anew with another --out")

    def _save(self) -> None:
        """Write a checkpoint. Raises `TrainingStopped` for a model that is not finite, or where the disk refused."""
        self.trainer.require_finite()
        if self.loop.ranks.first:
            save_checkpoint(self.folder.checkpoints, self.trainer.iteration, self.state_dict())
        self._saved_at = self.trainer.iteration
        self.clock.mark("checkpoints")

    def _last_good(self) -> str:
        checkpoint, older = latest_checkpoint(self.folder.checkpoints), self.folder.older()
        return f"the last good checkpoint is '{checkpoint}'{older}" if checkpoint else "no checkpoint was saved before"


class TrainingProgress(Listener):
    """A line on stderr for each evaluation; and on a terminal one below them with iteration, seconds left, iterations a
    second and number of Gaussians."""

    def __init__(self) -> None:
        self._terminal = sys.stderr.isatty()
        self._began: tuple[int, float] | None = None  # the iteration and time of the first look
        self._next_refresh, self._before = 0.0, 0.0  # a time; seconds of training before the first iteration

    def advanced(self, loop: TrainingLoop) -> None:
        now, trainer = time.perf_counter(), loop.trainer
        if not self._terminal or now < self._next_refresh:
            return
        self._next_refresh = now + REFRESH_SECONDS
        first, began = self._began = self._began or (trainer.iteration, now)
        speed, left = (trainer.iteration - first) / max(1e-9, now - began), trainer.iterations - trainer.iteration
        remaining = f"{left / speed:,.0f} s left  " if speed else ""
        said = f"{remaining}{speed:,.0f} it/s  {len(trainer.gaussians):,} Gaussians"
        self._say(f"{trainer.iteration}/{trainer.iterations}  {said}", "\r")

    def evaluated(self, loop: TrainingLoop, evaluation: Evaluation) -> None:
        counts = {"non-finite losses": evaluation.nonfinite_losses, "skipped updates": evaluation.skipped_updates}
        further = [f"{count} {what}" for what, count in counts.items() if count]
        iteration, total = evaluation.iteration, loop.trainer.iterations
        if iteration == 0:
            self._before = evaluation.train_seconds
        elif iteration < total:
            mean = (evaluation.train_seconds - self._before) / iteration
            further.append(f"{mean * (total - iteration):,.0f} s left")
        if not math.isnan(psnr := evaluation.refined_psnr):
            further.append(f"by refined test cameras {psnr:.2f} dB, SSIM {evaluation.refined_ssim:.4f}")
        said = (
            f"iteration {iteration:>{len(str(total))}}/{total}  {evaluation.train_seconds:7.1f} s  test PSNR"
            f" {evaluation.psnr:.2f} dB  SSIM {evaluation.ssim:.4f}  {evaluation.num_gaussians} Gaussians"
        )
        self._say("  ".join([said, *further]))

    def close(self) -> None:
        """Clear the terminal's line."""
        self._say("", "")

    def _say(self, line: str, end: str = "\n") -> None:
        with suppress(OSError):  # a terminal that closes
            print("\r\033[K" * self._terminal + line, end=end, file=sys.stderr, flush=True)
