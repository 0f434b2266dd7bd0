"""When a frame is drawn, for whom, how large, and within which share of the time. Knows no page and no training."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np
import torch

from turbogs_plugin.viewer.eye import Eye
from turbogs_plugin.viewer.pictures import Picture, Request, draw
from turbogs_plugin.viewer.subject import Subject

SHARE = 0.07
"""Share of the wall time that frames may take from a running training. The threads that encode and send them take some
more; together they stay below 0.1."""
REST_SECONDS = 0.25
"""A camera that has not moved for so long is at rest."""
SHORTEST_INTERVALS = {True: 1.0 / 15.0, False: 1.0 / 30.0}
"""Between two frames of one page, by whether a training runs beside: each frame takes the interpreter from it for a
moment that no clock here sees, when it is encoded and sent."""
MOVING_INTERVAL, RESTING_INTERVAL = 0.1, 0.5
"""Seconds between frames that the size of frames is chosen for, if larger ones would take longer."""
RESTING_FRAME = 5.0
"""Seconds that a frame at rest may take where no training waits for it."""
FEWEST_PIXELS = 160 * 120
"""Frames do not get smaller than this, so on a slow machine they come more rarely."""


@dataclass
class Screen:
    """One page: what it wants to see, and what it was sent.

    Args:
        send: takes a picture [H, W, 3] uint8 and whether to send it without loss. It returns at once.

    Attributes:
        eye: the camera; None until the client has told a usable one.
        moved_at: when it last changed.
        busy: a picture is still being encoded; whoever encodes sets it back.
        sent: what was sent last, and whether without loss; None: nothing.
        served_at: when.
        failed: why the last frame was not drawn, in words; empty where it was.
    """

    send: Callable[[np.ndarray, bool], None]
    eye: Eye | None = None
    moved_at: float = -math.inf
    busy: bool = False
    sent: tuple | None = None
    served_at: float = -math.inf
    failed: str = ""

    def look(self, eye: Eye | None, now: float) -> None:
        """The client's camera is this now; None changes nothing."""
        if eye is not None and eye != self.eye:
            self.eye, self.moved_at = eye, now


@dataclass
class Pace:
    """How long frames take, and with that when the next may begin and how large it may be.

    Args:
        share: of the wall time that frames may take; None: all of it.

    Attributes:
        next_at: no frame begins before.
    """

    share: float | None
    next_at: float = -math.inf
    _per_pixel: dict[Picture, float] = field(default_factory=dict)

    def spent(self, picture: Picture, begun: float, seconds: float, pixels: int) -> None:
        """A frame took so long."""
        known = self._per_pixel.get(picture)
        per_pixel = seconds / pixels
        # The first frames of a process warm things up, so a faster one counts at once.
        self._per_pixel[picture] = per_pixel if known is None else min(per_pixel, 0.7 * known + 0.3 * per_pixel)
        self.next_at = begun + seconds / (self.share or 1.0)

    def sized(self, picture: Picture, eye: Eye, moving: bool) -> Eye:
        """The eye with as many pixels as time allows; sizes come in steps, so that tables of pixels are used again."""
        if not picture.renders:
            return eye
        if self.share is None:
            seconds = MOVING_INTERVAL if moving else RESTING_FRAME
        else:
            seconds = self.share * (MOVING_INTERVAL if moving else RESTING_INTERVAL)
        per_pixel = self._per_pixel.get(picture)
        if per_pixel is None:  # nothing is known yet: begin small
            return eye if self.share is None and not moving else eye.with_at_most(FEWEST_PIXELS)
        allowed = max(seconds / max(per_pixel, 1e-12), FEWEST_PIXELS)
        whole = eye.width * eye.height
        if allowed >= whole:
            return eye
        return eye.with_at_most(whole / 2.0 ** math.ceil(math.log2(whole / allowed)))


class Frames:
    """Draws the frames that are due, one a call, on the thread that calls.

    Args:
        screens: gives those to serve.
        wish: gives the picture and the view that the pages show.
        share: as in `Pace`.
        clock: seconds.
    """

    def __init__(
        self,
        screens: Callable[[], Iterable[Screen]],
        wish: Callable[[], tuple[Picture, int]],
        share: float | None = SHARE,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.screens, self.wish, self.clock = screens, wish, clock
        self.paces = {True: Pace(share), False: Pace(None)}
        """By whether a training runs beside."""

    def serve(self, subject: Callable[[], Subject], version: int, running: bool) -> bool:
        """Draw and send the frame that has waited longest, if one is due and the pace allows.

        Args:
            subject: what to draw; called only if something is drawn, before the frame's time begins.
            version: changes whenever a picture may look different.
            running: a training waits for the frame.

        Returns:
            Whether a frame was drawn.
        """
        now, pace = self.clock(), self.paces[running]
        if now < pace.next_at:
            return False
        picture, view = self.wish()
        for screen in sorted(self.screens(), key=lambda screen: screen.served_at):
            if screen.eye is None or screen.busy or now < screen.served_at + SHORTEST_INTERVALS[running]:
                continue
            moving = now - screen.moved_at < REST_SECONDS
            wanted = (picture, view, screen.eye, version, running)
            if screen.sent == (wanted, True) or (moving and screen.sent == (wanted, False)):
                continue
            request = Request(picture, pace.sized(picture, screen.eye, moving), view)
            screen.sent, screen.served_at = (wanted, not moving), now
            self._draw(screen, subject(), request, not moving, pace)
            return True
        return False

    def _draw(self, screen: Screen, subject: Subject, request: Request, lossless: bool, pace: Pace) -> None:
        begun = self.clock()
        try:
            pixels, screen.failed = draw(subject, request), ""
        except torch.cuda.OutOfMemoryError:  # the training has what it needs; a page can wait
            screen.failed = "The device has too little free memory for this picture."
        else:
            screen.busy = True
            screen.send(pixels, lossless)
        pace.spent(request.picture, begun, self.clock() - begun, request.eye.width * request.eye.height)
