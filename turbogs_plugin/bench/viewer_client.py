"""A client of the viewer without a browser: turns its camera and counts the frames that arrive.

It speaks viser's own protocol: messages of msgpack, several of them compressed together. viser brings the packages for
that, which are imported where they are used. As a program of its own it
takes no time from the process that it measures: `python -m turbogs_plugin.bench.viewer_client URL EYE` moves until the
server goes away, then prints what it saw as JSON. EYE is a JSON list: position, wxyz, fov, width, height.
"""

from __future__ import annotations

import io
import json
import math
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from PIL import Image

from turbogs_plugin.viewer.camera import ViewerCamera

MOVES_A_SECOND = 30.0
TURN = 0.05
"""Radius of the small circle that the camera moves on, in units of the scene's extent."""


@dataclass(frozen=True)
class Frame:
    """A frame as it arrived.

    Args:
        at: when, seconds.
        lossless: PNG, not JPEG.
        data: the file.
    """

    at: float
    lossless: bool
    data: bytes

    def pixels(self) -> np.ndarray:
        """[H, W, 3] uint8."""
        return np.asarray(Image.open(io.BytesIO(self.data)).convert("RGB"))


class ScriptedClient:
    """A connection to a viewer, as a context.

    Args:
        url: of the page, ``http://``.
        headers: further ones of the request.
    """

    def __init__(self, url: str, **headers: str) -> None:
        import viser
        import zstandard
        from websockets.sync.client import connect

        options = {"subprotocols": [f"viser-v{viser.__version__}"], "max_size": None, "compression": None}
        self._socket = connect(url.replace("http", "ws", 1), additional_headers=headers, **options)
        self._zstd = zstandard.ZstdDecompressor()

    def __enter__(self) -> ScriptedClient:
        return self

    def __exit__(self, *error: object) -> None:
        self._socket.close()

    def look(self, eye: ViewerCamera) -> None:
        """Tell where this client's camera is."""
        message = {"type": "ViewerCameraMessage", "wxyz": eye.wxyz, "position": eye.position, "fov": eye.fov}
        message |= {"near": 0.01, "far": 1000.0, "image_height": eye.height, "image_width": eye.width}
        self.say(message | {"look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 0.0, 1.0)})

    def say(self, message: dict[str, Any]) -> None:
        """Send one message of viser's."""
        import msgspec

        self._socket.send(msgspec.msgpack.encode(message))

    def frames(self, timeout: float) -> Iterator[Frame]:
        """The frames of the next parcel of messages; none if it does not come in time."""
        import msgspec

        try:
            raw = self._socket.recv(timeout)
        except TimeoutError:
            return
        size = int.from_bytes(raw[8:16], "little")
        for message in msgspec.msgpack.decode(self._zstd.decompress(raw[16 : 16 + size]))["messages"]:
            if message["type"] == "BackgroundImageMessage" and message["rgb_data"] is not None:
                yield Frame(time.perf_counter(), message["format"] == "png", message["rgb_data"])


def turning(eye: ViewerCamera, seconds: float) -> ViewerCamera:
    """The eye after so long on a small circle, once around in two seconds."""
    angle = math.pi * seconds
    x, y, z = eye.position
    return replace(eye, position=(x + TURN * math.cos(angle), y + TURN * math.sin(angle), z))


def main() -> None:
    """Move until the server goes away, and print how many frames came, over how long, and of which size."""
    from websockets.exceptions import ConnectionClosed

    url, numbers = sys.argv[1:]
    position, wxyz, fov, width, height = json.loads(numbers)
    eye = ViewerCamera(tuple(position), tuple(wxyz), fov, width, height)
    frames: list[Frame] = []
    with ScriptedClient(url) as client:
        began = time.perf_counter()
        try:
            while True:
                now = time.perf_counter()
                client.look(turning(eye, now - began))
                while (left := now + 1.0 / MOVES_A_SECOND - time.perf_counter()) > 0:
                    frames += client.frames(left)
        except ConnectionClosed:
            pass
    seconds = frames[-1].at - frames[0].at if len(frames) > 1 else math.nan
    widths = [frame.pixels().shape[1] for frame in frames]
    found = {"frames": len(frames), "seconds": seconds, "widths": widths, "bytes": sum(len(f.data) for f in frames)}
    print(json.dumps(found))


if __name__ == "__main__":
    main()
