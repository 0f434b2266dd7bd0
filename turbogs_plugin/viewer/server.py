"""The web page of the viewer, a viser server: its panel, its clients, the cameras of the capture.

viser calls back from threads of its own; these only take down what a client wants. Drawing and encoding happen on the
thread that owns the model (`frames`).
"""

from __future__ import annotations

import contextlib
import io
import math
import re
import socket
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Literal
from urllib.parse import urlsplit

import numpy as np

from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.geometry import evenly
from turbogs_plugin.viewer.camera import ViewerCamera
from turbogs_plugin.viewer.frames import Screen
from turbogs_plugin.viewer.model_state import CaptureViews
from turbogs_plugin.viewer.pictures import EXPLANATIONS, Picture

if TYPE_CHECKING:
    import viser

JPEG_QUALITY = 85
MOST_FRUSTA = 150
"""Largest number of cameras drawn into the scene, evenly spread over the capture. The slider reaches all."""
FRUSTUM_SIZE = 0.06
"""Size of a camera in the scene, in units of the scene's extent."""
TRAIN_COLOR, TEST_COLOR = (40, 110, 220), (230, 140, 20)
INSTALL = 'pip install "turbogs-plugin[viewer]"'


class Controls:
    """Whether a training may go on: set by the page's threads, read by the training's."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self.paused = False
        self._steps = 0

    def set_paused(self, paused: bool, steps: int = 0) -> None:
        """Pause, after `steps` more iterations, or go on."""
        with self._changed:
            self.paused, self._steps = paused, self._steps + steps if steps else 0
            self._changed.notify_all()

    def take_step(self) -> bool:
        """Whether an iteration was asked for; it counts as made."""
        with self._changed:
            asked = self._steps > 0
            self._steps -= asked
            return asked

    def wake(self) -> None:
        """Let the thread that waits look again: a camera moved, or a picture was chosen."""
        with self._changed:
            self._changed.notify_all()

    def wait(self, seconds: float) -> None:
        """Wait until something changes, at most `seconds`."""
        with self._changed:
            if not self._steps:
                self._changed.wait(seconds)


def require_server(host: str, port: int) -> None:
    """Raise `InputError` where viser is not installed, or no server can listen at `host` and `port`: viser itself
    would silently take another port."""
    try:
        import viser  # noqa: F401
    except ImportError as error:
        lacking = "viser" if (error.name or "").partition(".")[0] == "viser" else error.name
        raise InputError(f"the viewer needs {lacking}: {INSTALL}") from error
    if not 0 <= port < 2**16:
        raise InputError(f"port {port} of the viewer: it must be 1 to 65535")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except (OSError, UnicodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"the viewer cannot listen at {host}:{port} ({reason}): name another port or host") from None


def quiet_server(host: str, port: int) -> viser.ViserServer:
    """A viser server that says nothing on standard output, which is the command's. Port 0 takes any free one."""
    import viser

    require_server(host, port)
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=port, label="TurboGS", verbose=False)
    if port not in (0, server.get_port()):
        stop(server)
        raise InputError(f"the viewer cannot listen at {host}:{port} (taken meanwhile): name another port")
    return server


def stop(server: viser.ViserServer) -> None:
    """End a server without a word on standard output."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def address(host: str, port: int) -> str:
    """The address that a browser on this machine opens to see a server that listens at `host`."""
    # "::" is not localhost, which may mean 127.0.0.1 alone.
    host = {"127.0.0.1": "localhost", "0.0.0.0": "localhost", "::": "::1"}.get(host, host)
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def plain(name: str) -> str:
    """A file's name without what a page's Markdown could take for more than text: names come with captures."""
    return re.sub(r"[^\w ./()+,-]", "?", name)


class Page:
    """A web page that shows frames and takes wishes.

    Args:
        host: interface to listen at.
        port: 0 takes any free one.
        training: whether there is a training to control.

    Attributes:
        picture, view: what the page shows.
        controls: whether the training may go on.

    Raises:
        InputError: viser is not installed, or the port is not free.
    """

    def __init__(self, host: str, port: int, training: bool = False) -> None:
        require_server(host, port)
        self.controls = Controls()
        self.picture, self.view = Picture.RENDER, 0
        self.capture: CaptureViews | None = None
        self._screens: dict[int, Screen] = {}
        self._frusta: list[Any] = []
        self.server = quiet_server(host, port)
        _guard(self.server)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        self.server.gui.main_panel.dock_right()
        self.url = address(host, self.server.get_port())
        self._build_panel(training)
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._disconnected)

    @property
    def watched(self) -> bool:
        """Whether anybody looks."""
        return bool(self._screens)

    def screens(self) -> list[Screen]:
        return list(self._screens.values())

    def wish(self) -> tuple[Picture, int]:
        """The picture and the view that the pages show."""
        return self.picture, self.view

    def show_capture(self, capture: CaptureViews) -> None:
        """Offer the views of a capture, and stand at the first one."""
        self.capture = capture
        cameras = capture.train.cameras
        up = -cameras.viewmats[:, 1, :3].double().mean(dim=0).cpu().numpy()
        if np.linalg.norm(up) > 1e-3:
            self.server.scene.set_up_direction(tuple(up / np.linalg.norm(up)))
        self._slider.max = max(1, len(capture) - 1)
        self._slider.visible = self._there.visible = self._cameras.visible = True
        self.stand_at(ViewerCamera.of_view(cameras, 0))
        for number in evenly(len(capture), MOST_FRUSTA):
            views, view_id = capture.find(number)
            self._add_frustum(number, ViewerCamera.of_view(views.cameras, view_id), views is capture.train)

    def stand_at(self, camera: ViewerCamera, distance: float = 1.0) -> None:
        """Set where new clients stand, who turn about a point at `distance`, and move those who are there already."""
        _, down, forward = camera.rotation.T
        place = np.array(camera.position)
        start = self.server.initial_camera
        start.position, start.look_at, start.up, start.fov = place, place + distance * forward, -down, camera.fov
        for client in self.server.get_clients().values():
            self._bring(client, camera)

    def say(self, text: str) -> None:
        """Show the state of things, in Markdown."""
        if self._status.content != text:
            self._status.content = text

    def go_to(self, number: int) -> None:
        """Choose a view, and bring every client's camera there."""
        self.choose_view(number)
        if self.capture is None:
            return
        views, view_id = self.capture.find(self.view)
        for client in self.server.get_clients().values():
            self._bring(client, ViewerCamera.of_view(views.cameras, view_id))

    def choose_view(self, number: float) -> None:
        """Set the view that pictures of a view show; any number is brought within bounds."""
        count = len(self.capture) if self.capture is not None else 1
        self.view = int(min(max(0.0, float(number)), count - 1)) if math.isfinite(number) else 0
        if self._slider.value != self.view:
            self._slider.value = self.view
        self.controls.wake()

    def choose_picture(self, name: str) -> None:
        """Set the picture by its name; an unknown name is ignored."""
        if name in list(Picture):
            self.picture = Picture(name)
            self._about.content = EXPLANATIONS[self.picture]
            self._refresh_visibility()
            self.controls.wake()

    def refresh_controls(self) -> None:
        """Show whether the training waits."""
        self._pause.label = "Go on" if self.controls.paused else "Pause"

    def finished(self) -> None:
        """Hide the controls of a training that has ended."""
        self._training.visible = False

    def close(self) -> None:
        """Turn everybody away."""
        self._screens.clear()
        stop(self.server)

    def _build_panel(self, training: bool) -> None:
        gui: Any = self.server.gui  # its handles' values cannot be set, says its type
        controls = self.controls
        self._status = gui.add_markdown("Photos are being read, and error maps made.")
        names = [picture.value for picture in Picture]
        self._pictures = gui.add_dropdown("Picture", names, initial_value=self.picture.value)
        self._about = gui.add_markdown(EXPLANATIONS[self.picture])
        self._slider = gui.add_slider("View", 0, 1, 1, 0, visible=False)
        self._there = gui.add_button("Stand at this view", visible=False)
        self._cameras = gui.add_checkbox("Cameras of the capture", False, visible=False)
        self._training = gui.add_folder("Training", visible=training)
        with self._training:
            self._pause = gui.add_button("Pause")
            self._step = gui.add_button("One step")
        self._pictures.on_update(lambda _: self.choose_picture(self._pictures.value))
        self._slider.on_update(lambda _: self.choose_view(self._slider.value))
        self._there.on_click(lambda _: self.go_to(self.view))
        self._cameras.on_update(lambda _: self._refresh_visibility())
        self._pause.on_click(lambda _: self._control(not controls.paused))
        self._step.on_click(lambda _: self._control(True, 1))

    def _control(self, paused: bool, steps: int = 0) -> None:
        self.controls.set_paused(paused, steps)
        self.refresh_controls()

    def _refresh_visibility(self) -> None:
        for frustum in self._frusta:
            frustum.visible = bool(self._cameras.value) and not self.picture.of_view

    def _add_frustum(self, number: int, camera: ViewerCamera, training: bool) -> None:
        frustum = self.server.scene.add_camera_frustum(
            f"/views/{number}",
            fov=camera.fov,
            aspect=camera.width / camera.height,
            scale=FRUSTUM_SIZE,
            color=TRAIN_COLOR if training else TEST_COLOR,
            wxyz=camera.wxyz,
            position=camera.position,
            visible=False,
        )
        frustum.on_click(lambda _: self.go_to(number))
        self._frusta.append(frustum)

    def _bring(self, client: viser.ClientHandle, camera: ViewerCamera) -> None:
        """Move a client's camera. A client that claims to be at an impossible place stays there."""
        with contextlib.suppress(ValueError, AssertionError), client.atomic():
            client.camera.position = np.array(camera.position)
            client.camera.wxyz = np.array(camera.wxyz)
            client.camera.fov = camera.fov

    def _connected(self, client: viser.ClientHandle) -> None:
        screen = Screen(partial(self._send, client))
        self._screens[client.client_id] = screen
        client.camera.on_update(lambda camera: self._looked(screen, camera))
        self._looked(screen, client.camera)

    def _disconnected(self, client: viser.ClientHandle) -> None:
        self._screens.pop(client.client_id, None)
        self.controls.wake()

    def _looked(self, screen: Screen, camera: viser.CameraHandle) -> None:
        size = camera.image_width, camera.image_height
        screen.look(ViewerCamera.checked(camera.position, camera.wxyz, camera.fov, *size), time.perf_counter())
        self.controls.wake()

    def _send(self, client: viser.ClientHandle, pixels: np.ndarray, lossless: bool) -> None:
        if client.client_id in self._screens:
            kind: Literal["png", "jpeg"] = "png" if lossless else "jpeg"
            client.scene.set_background_image(pixels, format=kind, jpeg_quality=JPEG_QUALITY)


def _guard(server: Any) -> None:
    """Take from clients what viser would let them do: open a tunnel into the internet, which would make the page
    public; and look from any web page that a browser on this machine has open."""
    server.request_share_url = lambda *arguments, **options: None
    sockets = server._websock_server

    async def refuse_foreign_pages(client: Any) -> None:
        connection = sockets._live_connections[client.client_id]
        origin, host = (connection.request.headers.get(name) for name in ("Origin", "Host"))
        if origin is not None and urlsplit(origin).netloc != host:
            await connection.close(1008, "another page's script")

    sockets.on_client_connect(refuse_foreign_pages)


def serve_until_interrupted(page: Page, serve: Callable[[], bool]) -> None:
    """Say on standard output where the page is, and serve it until Ctrl-C.

    Args:
        serve: draws a frame if one is due, and says whether it did.
    """
    with contextlib.suppress(KeyboardInterrupt):
        print(f"viewer  {page.url}  (Ctrl-C ends)", flush=True)
        while True:
            if not serve():
                page.controls.wait(0.05)
