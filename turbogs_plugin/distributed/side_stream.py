"""Work of a GPU that is done beside that of its current stream."""

from __future__ import annotations

from collections.abc import Callable

import torch


class SideStream:
    """A stream for one piece of work after the other. On a CPU the work is done at once.

    What the work uses was allocated elsewhere, and torch's allocator does not know of this stream: do not let go of it
    before `finish`. What is let go of then, or later, is used again behind the work.
    """

    def __init__(self, device: torch.device) -> None:
        self._stream: torch.cuda.Stream | None = None
        if device.type == "cuda":
            self._stream = torch.cuda.Stream(device)
            self._begun, self._done = torch.cuda.Event(), torch.cuda.Event()

    def begin(self, work: Callable[[], None]) -> None:
        """Let `work` come after all that the current stream was given, and beside what it is given next.

        Args:
            work: enqueues it, and allocates nothing.
        """
        if self._stream is None:
            work()
            return
        self._begun.record()
        with torch.cuda.stream(self._stream):
            self._begun.wait()
            work()
            self._done.record()

    def finish(self) -> None:
        """What the current stream is given next comes after the latest work."""
        if self._stream is not None:
            self._done.wait()
