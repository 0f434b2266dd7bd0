"""Pause, one step, go on: what a page asks of a training. Set by the page's threads, read by the training's."""

from __future__ import annotations

import threading


class Controls:
    """Whether the training may go on."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._paused = False
        self._steps = 0

    @property
    def paused(self) -> bool:
        """Whether to wait before the next iteration. Cheap: read at every iteration."""
        return self._paused

    def pause(self) -> None:
        self._set(True, 0)

    def resume(self) -> None:
        self._set(False, 0)

    def step(self) -> None:
        """Make one iteration, then wait again."""
        self._set(True, self._steps + 1)

    def take_step(self) -> bool:
        """Whether an iteration was asked for; it counts as made."""
        with self._changed:
            asked = self._steps > 0
            self._steps -= asked
            return asked

    def wake(self) -> None:
        """Whoever waits looks again: a camera moved, or a picture was chosen."""
        with self._changed:
            self._changed.notify_all()

    def wait(self, seconds: float) -> None:
        """Until something changes, at most so long."""
        with self._changed:
            if not self._steps:
                self._changed.wait(seconds)

    def _set(self, paused: bool, steps: int) -> None:
        with self._changed:
            self._paused, self._steps = paused, steps
            self._changed.notify_all()
