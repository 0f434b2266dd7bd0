"""What the wall time of a training goes into."""

from __future__ import annotations

from turbogs_plugin.train.history import Evaluation
from turbogs_plugin.train.loop import Listener, TrainingLoop
from turbogs_plugin.train.wall import WallClock


class WallMarks(Listener):
    """Marks training and evaluations. It has to be the first listener, so that what others do is told apart."""

    def __init__(self, clock: WallClock) -> None:
        self.clock = clock

    def begun(self, loop: TrainingLoop) -> None:
        self.clock.mark("initial maps")

    def evaluating(self, loop: TrainingLoop) -> None:
        self.clock.mark("training")

    def evaluated(self, loop: TrainingLoop, evaluation: Evaluation) -> None:
        self.clock.mark("evaluations" if evaluation.iteration else "first evaluation")
