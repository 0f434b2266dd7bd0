"""The rhythm of frames: when the pages get one, how large, and within which share of the time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress

import numpy as np
import torch

from turbogs_plugin.viewer.camera import ViewerCamera
from turbogs_plugin.viewer.pictures import ModelState, Picture, draw

SHARE = 0.08
"""Share of the wall time that frames may take from a running training, drawn and encoded; viser sends them in a thread
of its own."""
REST_SECONDS = 0.25
"""Seconds without a movement after which a camera is at rest."""
SHORTEST_INTERVALS = {True: 1.0 / 15.0, False: 1.0 / 30.0}
"""Seconds between two frames, by whether a training runs beside: sending a frame takes the interpreter from
the training for a moment that no clock here sees."""
FRAME_SECONDS = {(True, True): 0.1 * SHARE, (True, False): 0.5 * SHARE, (False, True): 0.1, (False, False): 5.0}
"""Seconds that a frame may take, by whether a training runs beside and whether the camera moves."""
FEWEST_PIXELS = 160 * 120
"""Pixels of the smallest frame: on a slow machine frames come more rarely instead."""


class Frames:
    """Draws the frames that are due, one a call, on the thread that calls. All pages show what the camera that moved
    last sees. `about` is a line about the last frame.

    Args:
        send: encodes a picture [H, W, 3] uint8, without loss or not, and sends it.
        wish: gives the picture and the view that the pages show.
    """

    def __init__(
        self,
        send: Callable[[np.ndarray, bool], None],
        wish: Callable[[], tuple[Picture, int]],
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.send, self.wish, self.clock = send, wish, clock
        self.camera: ViewerCamera | None = None
        self.about, self.next_at = "", -math.inf
        self._moved_at = self._sent_at = -math.inf
        self._sent: tuple | None = None
        self._per_pixel: float | None = None  # seconds, of pictures by the free camera

    def look(self, camera: ViewerCamera | None) -> None:
        """Take a client's camera; None changes nothing."""
        if camera is not None and camera != self.camera:
            self.camera, self._moved_at = camera, self.clock()

    def serve(self, state: Callable[[], ModelState], version: int, running: bool) -> bool:
        """Draw and send a frame, if one is due, and say whether one was.

        Args:
            state: what to draw; called only if something is drawn, before the frame's time begins.
            version: changes whenever a picture may look different.
            running: a training waits for the frame.
        """
        now, camera = self.clock(), self.camera
        if camera is None or now < self._sent_at + SHORTEST_INTERVALS[running] or (running and now < self.next_at):
            return False
        picture, view = self.wish()
        moving = now - self._moved_at < REST_SECONDS
        wanted = (picture, view, camera, version, running, moving)
        if self._sent == wanted or (moving and self._sent == (*wanted[:-1], False)):
            return False
        self._sent, self._sent_at = wanted, now
        if not picture.of_view:
            camera = self._sized(camera, moving, running)
        shown, begun = state(), self.clock()
        with suppress(torch.cuda.OutOfMemoryError):  # the training has what it needs; a page can wait
            pixels, self.about = draw(shown, picture, camera, view)
            self.send(pixels, not (moving or running))
        seconds = self.clock() - begun
        self.next_at = begun + seconds / SHARE
        if not picture.of_view:
            per_pixel, known = seconds / (camera.width * camera.height), self._per_pixel
            # A faster frame counts at once, as a process's first frames warm things up.
            self._per_pixel = per_pixel if known is None else min(per_pixel, 0.7 * known + 0.3 * per_pixel)
        return True

    def _sized(self, camera: ViewerCamera, moving: bool, running: bool) -> ViewerCamera:
        """The camera with as many pixels as `FRAME_SECONDS` allows, in steps of a factor 2."""
        allowed = 0.0 if moving or running else math.inf  # where nothing is known yet
        if self._per_pixel is not None:
            allowed = FRAME_SECONDS[running, moving] / max(self._per_pixel, 1e-12)
        pixels = float(camera.width * camera.height)
        while pixels > max(FEWEST_PIXELS, allowed):
            pixels /= 2
        return camera.with_at_most(pixels)
