"""Event files for TensorBoard (`report.tensorboard`): a training's history as curves.

Evaluations stop the clock of training, so the event files cost no time that is reported.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable
from dataclasses import asdict

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.errors import InputError
from turbogs_plugin.train.history import Evaluation
from turbogs_plugin.train.loop import Listener, TrainingLoop
from turbogs_plugin.train.session import RunSession

INSTALL = 'pip install "tensorboard>=2.12"'
GROUPS = {"num_gaussians": "counts", "nonfinite_losses": "counts", "skipped_updates": "counts"}
GROUPS |= {"train_seconds": "cost", "memory_bytes": "cost"}
"""Group under which TensorBoard shows a field of `Evaluation`; all others are errors on test views."""


def event_writers(config: Config) -> list[Callable[[RunSession], Listener]]:
    """Makers of the listeners that a run with this configuration needs: one that writes event files, or none. Raises
    `InputError` where event files are asked for, and the package is not installed."""
    if config.report.tensorboard and importlib.util.find_spec("tensorboard") is None:
        raise InputError(f"report.tensorboard needs the package tensorboard: {INSTALL}")
    return [EventWriter] if config.report.tensorboard else []


class EventWriter(Listener):
    """Writes event files for TensorBoard at each evaluation of a run, new or resumed."""

    def __init__(self, session: RunSession) -> None:
        from torch.utils.tensorboard import SummaryWriter

        # The history of a resumed run ends at its checkpoint: later points of earlier files are void.
        first = session.trainer.iteration + 1 if session.resumed else 0
        self._writer = SummaryWriter(str(session.folder.tensorboard), purge_step=first)

    def evaluated(self, loop: TrainingLoop, evaluation: Evaluation) -> None:
        for name, value in asdict(evaluation).items():
            if name != "iteration" and not math.isnan(value):
                self._writer.add_scalar(f"{GROUPS.get(name, 'test')}/{name}", value, evaluation.iteration)
        self._writer.flush()
        if loop.finished:
            self._writer.close()  # and its thread
