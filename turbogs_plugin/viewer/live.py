"""The viewer of a training: a listener of its loop that draws frames between iterations, on their thread.

It changes nothing that the training computes with, so the result stays bit for bit. While nobody looks it draws nothing
and keeps nothing.
"""

from __future__ import annotations

import math
import sys
import time

from turbogs_plugin.device import synchronize
from turbogs_plugin.train.history import Evaluation
from turbogs_plugin.train.look import Look
from turbogs_plugin.train.loop import Listener, TrainingLoop
from turbogs_plugin.train.session import RunSession
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import Gaussians, PixelSamples, RowUpdate, Step
from turbogs_plugin.viewer.pictures import CaptureViews, DensityChange, ModelState
from turbogs_plugin.viewer.server import POLL_SECONDS, Page, serve_until_interrupted

STATUS_SECONDS = 0.5
"""Seconds between two updates of the page's text."""


class LiveViewer(Listener):
    """Shows a training on a page, and waits where the page asks for it.

    Args:
        page: with controls of a training.
    """

    def __init__(self, page: Page) -> None:
        self.page = page
        self.trainer: Trainer | None = None
        self._capture: CaptureViews | None = None
        self._samples: PixelSamples | None = None
        self._change: DensityChange | None = None
        self._psnr = math.nan
        self._next_status = -math.inf
        self._began, self._began_at = time.perf_counter(), 0

    def watch(self, session: RunSession) -> LiveViewer:
        """Take a run that is about to begin; itself, as a listener of its loop. The page's address is printed."""
        print(f"viewer  {self.page.url}", file=sys.stderr, flush=True)
        self.trainer = session.trainer
        self.trainer.observer = self
        self._capture = CaptureViews(self.trainer.views, session.test)
        self.page.show_capture(self._capture)
        return self

    def begun(self, loop: TrainingLoop) -> None:
        self._began, self._began_at = time.perf_counter(), loop.trainer.iteration

    def advanced(self, loop: TrainingLoop) -> None:
        if self.page.paused:
            self._hold(loop)
        elif self.page.watched:
            self._serve(loop.trainer, running=True)

    def evaluated(self, loop: TrainingLoop, evaluation: Evaluation) -> None:
        self._psnr = evaluation.psnr

    def sampled(self, samples: PixelSamples) -> None:
        self._samples = samples if self.page.watched else None

    def changing(self, gaussians: Gaussians, update: RowUpdate, step: Step) -> None:
        self._change = DensityChange.of(gaussians, update) if self.page.watched else None

    def stay(self) -> None:
        """Show the model after the training until Ctrl-C."""
        trainer = self.trainer
        assert trainer is not None, "no training was watched"
        self.page.finished()
        serve_until_interrupted(self.page, lambda: self._serve(trainer, running=False))

    def _hold(self, loop: TrainingLoop) -> None:
        """Wait until the page asks for an iteration or lets the training go on, or the training is to be stopped."""
        self._next_status = -math.inf  # told at once
        with loop.clock.stopped():
            while self.page.paused and not loop.stopped:
                drawn = self._serve(loop.trainer, running=False)
                if self.page.steps.acquire(timeout=0.0 if drawn else POLL_SECONDS):
                    break
        self.begun(loop)

    def _serve(self, trainer: Trainer, running: bool) -> bool:
        """Draw a frame if one is due, and keep the page's text up to date."""

        def state() -> ModelState:
            synchronize(trainer.device)  # waiting for the iterations before is no cost of a frame
            return self._state(trainer)

        drawn = self.page.frames.serve(state, trainer.iteration, running)
        now = time.perf_counter()
        if self.page.watched and now >= self._next_status:
            self._next_status = now + STATUS_SECONDS
            self.page.say(self._status(trainer, running, now), self._state(trainer))
        return drawn

    def _state(self, trainer: Trainer) -> ModelState:
        return ModelState(
            gaussians=trainer.gaussians,
            look=Look(trainer.sh_degree, trainer.config.raster, trainer.background.evaluated),
            capture=self._capture,
            maps=trainer.maps,
            step=trainer.now,
            samples=self._samples,
            change=self._change,
        )

    def _status(self, trainer: Trainer, running: bool, now: float) -> str:
        speed = "paused" if self.page.paused else "finished"
        if running:
            speed = f"{(trainer.iteration - self._began_at) / max(now - self._began, 1e-9):.0f} a second"
            self._began, self._began_at = now, trainer.iteration
        psnr = "" if math.isnan(self._psnr) else f" · test PSNR {self._psnr:.2f} dB"
        line = f"iteration **{trainer.iteration}** of {trainer.iterations} ({speed})"
        return f"{line} · {len(trainer.gaussians):,} Gaussians{psnr}"
