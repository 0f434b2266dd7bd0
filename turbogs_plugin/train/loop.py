"""The loop of all training. A pace sets marks, iterations where the loop stops to do something else; a clock measures
the training between them. Everything else is a listener: evaluations, checkpoints, progress, records, stops."""

from __future__ import annotations

from signal import SIGTERM

from turbogs_plugin.distributed.ranks import ONE, Ranks
from turbogs_plugin.train.history import Evaluation
from turbogs_plugin.train.pace import Pace, TrainingClock
from turbogs_plugin.train.trainer import Trainer


class Listener:
    """A listener of a training, whose methods are called when something happens. Subclasses override what they need."""

    def begun(self, loop: TrainingLoop) -> None:
        """The error maps are there; this process has not yet made an iteration."""

    def advanced(self, loop: TrainingLoop) -> None:
        """An iteration was made. The clock runs, so this has to be cheap."""

    def evaluation_due(self, loop: TrainingLoop) -> None:
        """The pace asks for an evaluation here."""

    def evaluated(self, loop: TrainingLoop, evaluation: Evaluation) -> None:
        """An evaluation was made."""

    def checkpoint_due(self, loop: TrainingLoop) -> None:
        """The pace asks for a checkpoint here. An evaluation due at the same place has been made."""


class TrainingLoop:
    """Trains from mark to mark of a pace, and measures the time.

    Args:
        pace: where to stop on the way, and where to end; None: after the configured iterations.
        ranks: the processes that train the model; each has such a loop, and the first one's clock counts.
    """

    def __init__(self, trainer: Trainer, pace: Pace | None = None, seconds: float = 0.0, ranks: Ranks = ONE) -> None:
        self.trainer, self.pace = trainer, pace or Pace(trainer.config.train)
        self.listeners: list[Listener] = []  # called in this order
        self.clock = TrainingClock(trainer.device, seconds)
        self.ranks, self.stopped = ranks, False

    def run(self, resumed: bool = False) -> None:
        """Train to the end, or until `stop`. Where the run is resumed, its error maps are there. Raises
        `TrainingStopped` where the model is lost, another process ended, or devices hold different models."""
        trainer, pace, clock = self.trainer, self.pace, self.clock
        if not resumed:
            with clock:
                trainer.initialise_maps()
        clock.seconds = self.ranks.agree(clock.seconds)
        for listener in self.listeners:
            listener.begun(self)
        while not (self.finished or self.stopped):
            mark = pace.next_mark(trainer.iteration, clock.seconds)
            self.advance(mark)
            if trainer.iteration < mark:  # stopped on the way
                break
            evaluate, save = pace.reached(trainer.iteration, clock.seconds)
            trainer.set_length(pace.iterations, pace.refine_until)
            if self.finished:
                trainer.conclude()
            if evaluate or save:
                trainer.complete()
            if evaluate:
                for listener in self.listeners:
                    listener.evaluation_due(self)
            if save:
                for listener in self.listeners:
                    listener.checkpoint_due(self)

    def advance(self, mark: int) -> None:
        """Train until `mark` iterations are finished, or until `stop`."""
        with self.clock:
            while self._is_short_of(mark):
                self.trainer.step()
                self.stopped = self.stopped or self.ranks.stop_signal != 0
                for listener in self.listeners:
                    listener.advanced(self)
        self.clock.seconds = self.ranks.agree(self.clock.seconds)

    def stop(self, signal: int = SIGTERM) -> None:
        """Stop after the present iteration, or as soon as all processes know of it; a signal's number asks for it."""
        if not self.ranks.ask_to_stop(signal):
            self.stopped = True

    @property
    def finished(self) -> bool:
        """Whether the end is reached."""
        return self.trainer.iteration >= self.pace.iterations

    def _is_short_of(self, mark: int) -> bool:
        """Whether to go on towards a mark. At a mark or a stop it waits for the GPU, and no iteration is missing."""
        if self.trainer.iteration >= mark or self.stopped:
            self.trainer.repeat_lost(wait=True)
        return self.trainer.iteration < mark and not self.stopped
