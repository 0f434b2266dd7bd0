"""A training that is looked at: a listener of its loop that draws frames between iterations, on their thread.

It changes nothing that the training computes with, so the result is the same to the last bit. While nobody looks it
draws nothing and keeps nothing.
"""

from __future__ import annotations

import math
import sys
import time
from contextlib import suppress

from turbogs_plugin.device import synchronize
from turbogs_plugin.scene import PosedImages
from turbogs_plugin.train.history import Evaluation
from turbogs_plugin.train.loop import Listener, TrainingLoop
from turbogs_plugin.train.session import RunSession
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import Gaussians, PixelSamples, RowUpdate, Step
from turbogs_plugin.viewer.frames import Frames
from turbogs_plugin.viewer.page import Page
from turbogs_plugin.viewer.pictures import Picture, Request, missing, shown_view
from turbogs_plugin.viewer.subject import CaptureViews, DensityChange, Subject
from turbogs_plugin.viewer.texts import plain

STATUS_SECONDS = 0.5
"""Between two updates of the page's text."""
ABANDONED_SECONDS = 5.0
"""A paused training whose last page was closed goes on after so long."""


class LiveViewer(Listener):
    """Shows a training on a page, and waits where the page asks for it.

    Args:
        page: with controls.
    """

    def __init__(self, page: Page) -> None:
        self.page = page
        self.frames = Frames(page.screens, page.wish)
        self._trainer: Trainer | None = None
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
        self._trainer = trainer
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
            self._serve(running=True)

    def evaluated(self, loop: TrainingLoop, evaluation: Evaluation) -> None:
        self._psnr = evaluation.psnr

    def sampled(self, samples: PixelSamples) -> None:
        self._samples = samples if self.page.watched else None

    def changing(self, gaussians: Gaussians, update: RowUpdate, step: Step) -> None:
        self._change = DensityChange.of(gaussians, update, step.iteration) if self.page.watched else None

    def stay(self) -> None:
        """After the training: show its model until Ctrl-C, as is said on standard output."""
        with suppress(KeyboardInterrupt):
            self.page.finished()
            print(f"viewer  {self.page.url}  (Ctrl-C ends)", flush=True)
            while True:
                if not self._serve(running=False):
                    self.page.controls.wait(0.05)

    def _hold(self, loop: TrainingLoop) -> None:
        """Wait until the page lets the training go on, or nobody is there who could, or it is to be stopped."""
        controls, alone_since = self.page.controls, time.perf_counter()
        self._next_status = -math.inf  # told at once
        with loop.clock.stopped():
            while controls.paused and not loop.stopped and not controls.take_step():
                if self.page.watched:
                    alone_since = time.perf_counter()
                elif time.perf_counter() - alone_since > ABANDONED_SECONDS:
                    controls.resume()
                if not self._serve(running=False):
                    controls.wait(0.05)
        self._began, self._began_at = time.perf_counter(), loop.trainer.iteration
        self.page.refresh_controls()

    def _serve(self, running: bool) -> bool:
        """Draw a frame if one is due, and keep the page's text up to date."""
        drawn = self.frames.serve(self._drawable, self._trainer.iteration, running)
        now = time.perf_counter()
        if self.page.watched and now >= self._next_status:
            self._next_status = now + STATUS_SECONDS
            self.page.say(self._status(running, now))
        return drawn

    def _drawable(self) -> Subject:
        """The subject, when the device has finished the iterations before: waiting for these is no cost of a frame."""
        synchronize(self._trainer.device)
        return self._subject()

    def _subject(self) -> Subject:
        trainer = self._trainer
        return Subject(
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

    def _status(self, running: bool, now: float) -> str:
        trainer = self._trainer
        state = "paused" if self.page.controls.paused else "finished" if not running else ""
        if running:
            state = f"{(trainer.iteration - self._began_at) / max(now - self._began, 1e-9):.0f} a second"
            self._began, self._began_at = now, trainer.iteration
        psnr = "" if math.isnan(self._psnr) else f" · test PSNR {self._psnr:.2f} dB"
        line = f"iteration **{trainer.iteration}** of {trainer.iterations} ({state}) · "
        lines = [f"{line}{len(trainer.gaussians):,} Gaussians{psnr}", *described(self._subject(), self.page)]
        return "\n\n".join(lines)


def described(subject: Subject, page: Page) -> list[str]:
    """What the page shows, in lines: view, samples, what density control did; or why it shows nothing."""
    picture, view = page.wish()
    if not (eyes := [screen.eye for screen in page.screens() if screen.eye is not None]):
        return []
    request = Request(picture, eyes[0], view)
    if reason := missing(subject, request):
        return [f"*{reason}*"]
    lines = [f"*{screen.failed}*" for screen in page.screens() if screen.failed]
    if picture.of_view:
        lines.append(f"`{plain(subject.capture.name(shown_view(subject, request)))}`")
    if picture is Picture.SAMPLES:
        samples = subject.samples
        lines.append(f"{len(samples):,} pixels of {len(samples.view_ids)} views in this iteration")
    if picture is Picture.CHANGES:
        change = subject.change
        lines.append(
            f"iteration {change.iteration}: {change.num_split:,} split, {change.num_cloned:,} copied, "
            f"{change.num_pruned:,} removed"
        )
    return lines
