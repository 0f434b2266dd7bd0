"""The viewer of a training: a listener of its loop that draws frames between iterations, on their thread.

Nothing that the training computes with changes, so the result stays bit for bit. While nobody looks, nothing is drawn
or kept.
"""

from __future__ import annotations

import math
import sys

from turbogs_plugin.device import synchronize
from turbogs_plugin.train.history import Evaluation
from turbogs_plugin.train.look import Look
from turbogs_plugin.train.loop import Listener, TrainingLoop
from turbogs_plugin.train.session import RunSession
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import PixelSamples
from turbogs_plugin.viewer.pictures import CaptureViews, ModelState
from turbogs_plugin.viewer.server import POLL_SECONDS, Page, serve_until_interrupted


class LiveViewer(Listener):
    """Shows a training on a page with its controls, and waits where the page asks for it."""

    trainer: Trainer
    _capture: CaptureViews

    def __init__(self, page: Page) -> None:
        self.page = page
        self._samples: PixelSamples | None = None
        self._psnr = math.nan

    def watch(self, session: RunSession) -> LiveViewer:
        """Take a run that is about to begin; itself, as a listener of its loop. The page's address is printed."""
        print(f"viewer  {self.page.url}", file=sys.stderr, flush=True)
        self.trainer = session.trainer
        self.trainer.on_samples = self.sampled
        self._capture = CaptureViews(self.trainer.views, session.test)
        self._ended = self.trainer.iteration == self.trainer.iterations  # the last checkpoint has no maps
        self.page.show_capture(self._capture)
        return self

    def advanced(self, loop: TrainingLoop) -> None:
        if self.page.paused:
            self._hold(loop)
        elif self.page.watched:
            self._serve(running=True)

    def evaluated(self, loop: TrainingLoop, evaluation: Evaluation) -> None:
        self._psnr = evaluation.psnr

    def sampled(self, samples: PixelSamples) -> None:
        self._samples = samples if self.page.watched else None

    def stay(self) -> None:
        """Show the model after the training until Ctrl-C."""
        self.page.training.visible = False
        serve_until_interrupted(self.page, lambda: self._serve(running=False))

    def _hold(self, loop: TrainingLoop) -> None:
        """Wait until the page asks for an iteration or lets the training go on, or the training is to be stopped.
        Where no page is open any more, nobody could let it go on, so it does."""
        with loop.clock.stopped():
            while self.page.paused and not loop.stopped:
                if not self.page.watched:
                    self.page.pause(False)
                drawn = self._serve(running=False)
                if self.page.steps.acquire(timeout=0.0 if drawn else POLL_SECONDS):
                    break

    def _serve(self, running: bool) -> bool:
        """Draw a frame if one is due, and say what it shows."""
        drawn = self.page.frames.serve(self._state, self.trainer.iteration, running)
        if drawn:
            doing = "" if running else " (paused)" if self.page.paused else " (finished)"
            psnr = "" if math.isnan(self._psnr) else f" · test PSNR {self._psnr:.2f} dB"
            line = f"iteration **{self.trainer.iteration}** of {self.trainer.iterations}{doing}"
            self.page.say(f"{line} · {len(self.trainer.gaussians):,} Gaussians{psnr}")
        return drawn

    def _state(self) -> ModelState:
        trainer = self.trainer
        synchronize(trainer.device)  # waiting for the iterations before is no cost of a frame
        look = Look(trainer.sh_degree, trainer.config.raster, trainer.background.evaluated)
        maps = None if self._ended else (trainer.maps, trainer.now)
        return ModelState(trainer.gaussians, look, self._capture, maps, self._samples)
