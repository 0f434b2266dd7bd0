"""Event files for TensorBoard (`report.tensorboard`): a training's history as curves, and strips of its test views.

Evaluations stop the clock of training, so the event files cost no time that is reported.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.config.sections import STRIPS
from turbogs_plugin.errors import InputError
from turbogs_plugin.report.images import strip
from turbogs_plugin.train.history import Evaluation
from turbogs_plugin.train.loop import Listener, TrainingLoop
from turbogs_plugin.train.metrics import render_view
from turbogs_plugin.train.session import RunSession

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

INSTALL = 'pip install "tensorboard>=2.12"'
WIDEST_STRIP = 900
"""Pixels. A strip of every view at every evaluation would take hundreds of megabytes at full size."""
GROUPS = {"num_gaussians": "counts", "nonfinite_losses": "counts", "skipped_updates": "counts"}
GROUPS |= {"train_seconds": "cost", "memory_bytes": "cost"}
"""Group under which TensorBoard shows a field of `Evaluation`; all others are errors on test views."""


def event_writers(config: Config) -> list[Callable[[RunSession], Listener]]:
    """Makers of the listeners that a run with this configuration needs: one that writes event files, or none.

    Raises:
        InputError: event files are asked for, and the package is not installed.
    """
    if not config.report.tensorboard:
        return []
    _writer_class()
    return [EventWriter]


class EventWriter(Listener):
    """Writes event files for TensorBoard at each evaluation of a run, new or resumed."""

    def __init__(self, session: RunSession) -> None:
        self._folder, self._test = session.folder.tensorboard, session.test
        # The history of a resumed run ends at its checkpoint: later points of earlier files are void.
        self._first = session.trainer.iteration + 1 if session.resumed else 0
        self._writer: SummaryWriter | None = None

    def evaluated(self, loop: TrainingLoop, evaluation: Evaluation) -> None:
        iteration = evaluation.iteration
        if self._writer is None:
            self._writer = _writer_class()(str(self._folder), purge_step=self._first)
        for name, value in asdict(evaluation).items():
            if name != "iteration" and not math.isnan(value):
                self._writer.add_scalar(f"{GROUPS.get(name, 'test')}/{name}", value, iteration)
        for view in range(min(STRIPS, len(self._test))):
            pixels = self._strip(loop, view)
            self._writer.add_image(f"test views/{self._test.names[view]}", pixels, iteration, dataformats="HWC")
        self._writer.flush()
        if loop.finished:
            self._writer.close()  # and its thread
            self._writer = None

    def _strip(self, loop: TrainingLoop, view: int) -> np.ndarray:
        """Photo, render and error of a test view, [H, W, 3] uint8, at most `WIDEST_STRIP` wide."""
        trainer, look = loop.trainer, loop.trainer.look(self._test.names)
        views = replace(self._test, cameras=self._test.cameras.to(trainer.device))
        image = render_view(trainer.gaussians, views, view, look)
        photo = views.photos.image(view, look.background).to(trainer.device)
        picture = Image.fromarray(strip(photo, image, views.mask(view)).cpu().numpy())
        picture.thumbnail((WIDEST_STRIP, WIDEST_STRIP), Image.Resampling.LANCZOS)
        return np.asarray(picture)


def _writer_class() -> type[SummaryWriter]:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise InputError(f"report.tensorboard needs the package tensorboard: {INSTALL}") from error
    return SummaryWriter
