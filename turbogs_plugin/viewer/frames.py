"""The rhythm of frames: when a page gets one, how large, and within which share of the time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import torch

from turbogs_plugin.viewer.camera import ViewerCamera
from turbogs_plugin.viewer.model_state import ModelState
from turbogs_plugin.viewer.pictures import Picture, Request, draw

SHARE = 0.08
"""Share of the wall time that frames may take from a running training, drawn and encoded; viser sends them in a thread
of its own."""
REST_SECONDS = 0.25
"""Seconds without a movement after which a camera is at rest."""
SHORTEST_INTERVALS = {True: 1.0 / 15.0, False: 1.0 / 30.0}
"""Seconds between two frames of one page, by whether a training runs beside: sending a frame takes the interpreter from
the training for a moment that no clock here sees."""
FRAME_SECONDS = {(True, True): 0.1 * SHARE, (True, False): 0.5 * SHARE, (False, True): 0.1, (False, False): 5.0}
"""Seconds that a frame may take, by whether a training runs beside and whether the camera moves."""
FEWEST_PIXELS = 160 * 120
"""Pixels of the smallest frame: on a slow machine frames come more rarely instead."""


@dataclass
class Screen:
    """One page: what it wants to see, and what it was sent.

    Args:
        send: encodes a picture [H, W, 3] uint8, without loss or not, and sends it.

    Attributes:
        camera: None until the client has told a usable one.
        moved_at: when the camera last changed.
        sent: what was drawn last; None: nothing.
        served_at: when it was sent.
    """

    send: Callable[[np.ndarray, bool], None]
    camera: ViewerCamera | None = None
    moved_at: float = -math.inf
    sent: tuple | None = None
    served_at: float = -math.inf

    def look(self, camera: ViewerCamera | None, now: float) -> None:
        """Take the client's camera; None changes nothing."""
        if camera is not None and camera != self.camera:
            self.camera, self.moved_at = camera, now


class Frames:
    """Draws the frames that are due, one a call, on the thread that calls.

    Args:
        screens: gives the pages to serve.
        wish: gives the picture and the view that the pages show.
        clock: seconds.
    """

    def __init__(
        self,
        screens: Callable[[], Iterable[Screen]],
        wish: Callable[[], tuple[Picture, int]],
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.screens, self.wish, self.clock = screens, wish, clock
        self.next_at = -math.inf
        self._per_pixel: dict[Picture, float] = {}

    def serve(self, state: Callable[[], ModelState], version: int, running: bool) -> bool:
        """Draw and send the frame that has waited longest, if one is due.

        Args:
            state: what to draw; called only if something is drawn, before the frame's time begins.
            version: changes whenever a picture may look different.
            running: a training waits for the frame.

        Returns:
            Whether a frame was drawn.
        """
        now = self.clock()
        if running and now < self.next_at:
            return False
        picture, view = self.wish()
        for screen in sorted(self.screens(), key=lambda screen: screen.served_at):
            if screen.camera is None or now < screen.served_at + SHORTEST_INTERVALS[running]:
                continue
            moving = now - screen.moved_at < REST_SECONDS
            wanted = (picture, view, screen.camera, version, running, moving)
            if screen.sent == wanted or (moving and screen.sent == (*wanted[:-1], False)):
                continue
            request = Request(picture, self._sized(picture, screen.camera, moving, running), view)
            screen.sent, screen.served_at = wanted, now
            self._draw(screen, state(), request, lossless=not (moving or running))
            return True
        return False

    def _sized(self, picture: Picture, camera: ViewerCamera, moving: bool, running: bool) -> ViewerCamera:
        """The camera with as many pixels as `FRAME_SECONDS` allows, in steps of a factor 2."""
        per_pixel = self._per_pixel.get(picture)
        if not picture.renders or (per_pixel is None and not (moving or running)):
            return camera
        allowed = float(FEWEST_PIXELS)  # where nothing is known yet
        if per_pixel is not None:
            allowed = max(allowed, FRAME_SECONDS[running, moving] / max(per_pixel, 1e-12))
        whole = camera.width * camera.height
        return camera if allowed >= whole else camera.with_at_most(whole / 2 ** math.ceil(math.log2(whole / allowed)))

    def _draw(self, screen: Screen, state: ModelState, request: Request, lossless: bool) -> None:
        begun = self.clock()
        with suppress(torch.cuda.OutOfMemoryError):  # the training has what it needs; a page can wait
            screen.send(draw(state, request), lossless)
        seconds = self.clock() - begun
        self.next_at = begun + seconds / SHARE
        known = self._per_pixel.get(request.picture)
        per_pixel = seconds / (request.camera.width * request.camera.height)
        # The first frames of a process warm things up, so a faster one counts at once.
        mixed = per_pixel if known is None else min(per_pixel, 0.7 * known + 0.3 * per_pixel)
        self._per_pixel[request.picture] = mixed
