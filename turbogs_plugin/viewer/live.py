"""The viewer of a training: a listener of its loop that draws frames between iterations, on their thread.

It changes nothing that the training computes with, so the result stays bit for bit. While nobody looks it draws nothing
and keeps nothing.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager

from turbogs_plugin.device import synchronize
from turbogs_plugin.scene import PosedImages
from turbogs_plugin.train.history import Evaluation
from turbogs_plugin.train.loop import Listener, TrainingLoop
from turbogs_plugin.train.session import RunSession
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import Gaussians, PixelSamples, RowUpdate, Step
from turbogs_plugin.viewer.frames import Frames
from turbogs_plugin.viewer.model_state import CaptureViews, DensityChange, ModelState
from turbogs_plugin.viewer.pictures import Picture, Request, missing, shown_view
from turbogs_plugin.viewer.server import Page, plain, serve_until_interrupted

STATUS_SECONDS = 0.5
"""Seconds between two updates of the page's text."""
ABANDONED_SECONDS = 5.0
"""Seconds after which a paused training whose last page was closed goes on."""


@contextmanager
def attached(port: int, host: str) -> Iterator[LiveViewer]:
    """A viewer for a training, which listens while entered.

    Raises:
        InputError: viser is not installed, or the port is not free.
    """
    with closing(Page(host, port, training=True)) as page:
        yield LiveViewer(page)


class LiveViewer(Listener):
    """Shows a training on a page, and waits where the page asks for it.

    Args:
        page: with controls of a training.
    """

    def __init__(self, page: Page) -> None:
        self.page = page
        self.frames = Frames(page.screens, page.wish)
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
        return self.attach(session.trainer, session.test)

    def attach(self, trainer: Trainer, test: PosedImages) -> LiveViewer:
        """Take a trainer and the test views of its capture; itself, as a listener of the loop."""
        self.trainer = trainer
        self._capture = CaptureViews(trainer.views, test)
        trainer.observer = self
        self.page.show_capture(self._capture)
        return self

    def begun(self, loop: TrainingLoop) -> None:
        self._began, self._began_at = time.perf_counter(), loop.trainer.iteration

    def advanced(self, loop: TrainingLoop) -> None:
        if self.page.controls.paused:
            self._hold(loop)
        elif self.page.watched:
            self._serve(loop.trainer, running=True)

    def evaluated(self, loop: TrainingLoop, evaluation: Evaluation) -> None:
        self._psnr = evaluation.psnr

    def sampled(self, samples: PixelSamples) -> None:
        self._samples = samples if self.page.watched else None

    def changing(self, gaussians: Gaussians, update: RowUpdate, step: Step) -> None:
        self._change = DensityChange.of(gaussians, update, step.iteration) if self.page.watched else None

    def stay(self) -> None:
        """Show the model after the training until Ctrl-C."""
        trainer = self.trainer
        assert trainer is not None, "no training was watched"
        self.page.finished()
        serve_until_interrupted(self.page, lambda: self._serve(trainer, running=False))

    def _hold(self, loop: TrainingLoop) -> None:
        """Wait until the page lets the training go on, or nobody is there who could, or it is to be stopped."""
        controls, alone_since = self.page.controls, time.perf_counter()
        self._next_status = -math.inf  # told at once
        with loop.clock.stopped():
            while controls.paused and not loop.stopped and not controls.take_step():
                if self.page.watched:
                    alone_since = time.perf_counter()
                elif time.perf_counter() - alone_since > ABANDONED_SECONDS:
                    controls.set_paused(False)
                if not self._serve(loop.trainer, running=False):
                    controls.wait(0.05)
        self.begun(loop)
        self.page.refresh_controls()

    def _serve(self, trainer: Trainer, running: bool) -> bool:
        """Draw a frame if one is due, and keep the page's text up to date."""

        def state() -> ModelState:
            synchronize(trainer.device)  # waiting for the iterations before is no cost of a frame
            return self._state(trainer)

        drawn = self.frames.serve(state, trainer.iteration, running)
        now = time.perf_counter()
        if self.page.watched and now >= self._next_status:
            self._next_status = now + STATUS_SECONDS
            self.page.say(self._status(trainer, running, now))
        return drawn

    def _state(self, trainer: Trainer) -> ModelState:
        return ModelState(
            gaussians=trainer.gaussians,
            sh_degree=trainer.sh_degree,
            settings=trainer.config.raster,
            background=trainer.background.evaluated,
            capture=self._capture,
            maps=trainer.maps,
            step=trainer.now,
            samples=self._samples,
            change=self._change,
        )

    def _status(self, trainer: Trainer, running: bool, now: float) -> str:
        speed = "paused" if self.page.controls.paused else "finished"
        if running:
            speed = f"{(trainer.iteration - self._began_at) / max(now - self._began, 1e-9):.0f} a second"
            self._began, self._began_at = now, trainer.iteration
        psnr = "" if math.isnan(self._psnr) else f" · test PSNR {self._psnr:.2f} dB"
        line = f"iteration **{trainer.iteration}** of {trainer.iterations} ({speed}) · "
        line += f"{len(trainer.gaussians):,} Gaussians{psnr}"
        return "\n\n".join([line, *described(self._state(trainer), self.page)])


def described(state: ModelState, page: Page) -> list[str]:
    """Lines about what the page shows: view, samples, what density control did; or why it shows nothing."""
    picture, view = page.wish()
    cameras = [screen.camera for screen in page.screens() if screen.camera is not None]
    if not cameras:
        return []
    request = Request(picture, cameras[0], view)
    if reason := missing(state, request):
        return [f"*{reason}*"]
    lines = []
    if picture.of_view and state.capture is not None:
        lines.append(f"`{plain(state.capture.name(shown_view(state, request)))}`")
    if picture is Picture.SAMPLES and (samples := state.samples) is not None:
        lines.append(f"{len(samples):,} pixels of {len(samples.view_ids)} views in this iteration")
    if picture is Picture.CHANGES and (change := state.change) is not None:
        did = change.update
        counts = f"{did.num_split:,} split, {did.num_cloned:,} copied, {did.num_pruned:,} removed"
        lines.append(f"iteration {change.iteration}: {counts}")
    return lines
