"""A client of the viewer that waits for frames, and may say what no browser says."""

import time
from typing import Any

from helpers.scripted_client import Frame, ScriptedClient


class WaitingClient(ScriptedClient):
    def next_frame(self, lossless: bool | None = None, timeout: float = 60.0) -> Frame:
        """Wait for a frame, if asked for one of this kind. Raises TimeoutError where none came."""
        ends = time.perf_counter() + timeout
        while (left := ends - time.perf_counter()) > 0:
            for frame in self.frames(left):
                if lossless in (None, frame.lossless):
                    return frame
        raise TimeoutError("no frame came")

    def press(self, uuid: str, value: Any) -> None:
        """Change a control of the page."""
        self.say({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}})
