"""A client of the viewer without a browser: tells where its camera is, and receives frames.

It speaks viser's own protocol: messages of msgpack, several of them compressed together. viser brings the packages for
that, which are imported where they are used.
"""

from __future__ import annotations

import io
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from PIL import Image

from turbogs_plugin.viewer.camera import ViewerCamera


@dataclass(frozen=True)
class Frame:
    """A frame as it arrived."""

    lossless: bool  # PNG, not JPEG
    data: bytes  # the file

    def pixels(self) -> np.ndarray:
        """[H, W, 3] uint8."""
        return np.asarray(Image.open(io.BytesIO(self.data)).convert("RGB"))


class ViewerClient:
    """A connection to a viewer, as a context; `headers`: further ones of the request."""

    def __init__(self, url: str, **headers: str) -> None:
        import viser
        import zstandard
        from websockets.sync.client import connect

        place = urlsplit(url)
        if "Host" in headers:  # the page by another name
            url = f"http://{headers.pop('Host')}"
        options = {"subprotocols": [f"viser-v{viser.__version__}"], "max_size": None, "compression": None}
        options["sock"] = socket.create_connection((place.hostname, place.port))
        self._socket = connect(url.replace("http", "ws", 1), additional_headers=headers, **options)
        self._zstd = zstandard.ZstdDecompressor()

    def __enter__(self) -> ViewerClient:
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

    def press(self, uuid: str, value: Any) -> None:
        """Change a control of the page."""
        self.say({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}})

    def next_frame(self, lossless: bool | None = None, timeout: float = 60.0) -> Frame:
        """Wait for a frame, if asked for one of this kind. Raises TimeoutError where none came."""
        ends = time.perf_counter() + timeout
        while (left := ends - time.perf_counter()) > 0:
            for frame in self._frames(left):
                if lossless in (None, frame.lossless):
                    return frame
        raise TimeoutError("no frame came")

    def _frames(self, timeout: float) -> Iterator[Frame]:
        """The frames of the next parcel of messages; none if it does not come in time."""
        import msgspec

        try:
            raw = self._socket.recv(timeout)
        except TimeoutError:
            return
        size = int.from_bytes(raw[8:16], "little")
        for message in msgspec.msgpack.decode(self._zstd.decompress(raw[16 : 16 + size]))["messages"]:
            if message["type"] == "BackgroundImageMessage" and message["rgb_data"] is not None:
                yield Frame(message["format"] == "png", message["rgb_data"])
