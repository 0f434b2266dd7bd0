"""SIGINT and SIGTERM while training: the run is stopped and saved."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import FrameType


class Interrupts:
    """At the first SIGINT or SIGTERM, asks training to stop after this iteration; at a second one, stops at once.

    It works only in the main thread: in others Python does not allow handlers, so signals keep their usual effect.

    Args:
        stop: called at the first signal, with its number.
    """

    SIGNALS = (signal.SIGINT, signal.SIGTERM)

    def __init__(self, stop: Callable[[int], None]) -> None:
        self.signal: int | None = None
        self._stop = stop

    def __enter__(self) -> Interrupts:
        handled = self.SIGNALS if threading.current_thread() is threading.main_thread() else ()
        self._previous = {number: signal.signal(number, self._handle) for number in handled}
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.signal is not None:
            raise KeyboardInterrupt
        self.signal = number
        self._stop(number)
