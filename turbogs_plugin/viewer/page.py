"""The page: a viser server, its panel, the cameras of the capture. The only module that knows viser.

viser calls back from threads of its own; these only take down what a client wants. Drawing happens on the thread that
owns the model (`frames`), encoding in one more thread, which waits for neither.
"""

from __future__ import annotations

import contextlib
import errno
import io
import math
import socket
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from types import ModuleType
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.geometry import evenly
from turbogs_plugin.types import Cameras
from turbogs_plugin.viewer.controls import Controls
from turbogs_plugin.viewer.eye import Eye
from turbogs_plugin.viewer.frames import Screen
from turbogs_plugin.viewer.pictures import Picture
from turbogs_plugin.viewer.subject import CaptureViews
from turbogs_plugin.viewer.texts import METHOD, PICTURES, TRY_IT

JPEG_QUALITY = 85
MOST_FRUSTA = 150
"""Cameras drawn into the scene; of more, as many are taken evenly. The slider reaches all."""
FRUSTUM_SIZE = 0.06
"""Of a camera in the scene, in units of the scene's extent."""
FRUSTUM_PIXELS = 2.0
"""Thickness of its lines."""
TRAIN_COLOR, TEST_COLOR = (40, 110, 220), (230, 140, 20)
NARROW = 600
"""Pixels of a picture, as on a telephone, beside which the explanation of the method is folded up at first."""
INSTALL = 'pip install "turbogs-plugin[viewer]"'


def require_viser() -> ModuleType:
    """The module viser.

    Raises:
        InputError: it is not installed.
    """
    try:
        import viser
    except ImportError as error:
        lacking = "viser" if (error.name or "").partition(".")[0] == "viser" else error.name
        raise InputError(f"the viewer needs {lacking}: {INSTALL}") from error
    return viser


def require_free(host: str, port: int) -> None:
    """Raise `InputError` where no server can listen: viser itself would silently take another port."""
    if not 0 <= port < 2**16:
        raise InputError(f"port {port} of the viewer: it must be 1 to 65535")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        remedies = {
            errno.EADDRINUSE: "name another port (view --port N, train --viewer N)",
            errno.EACCES: "name a port above 1023",
        }
        otherwise = "name an address of this machine: 127.0.0.1 for itself alone, 0.0.0.0 for the network, too"
        remedy = remedies.get(getattr(error, "errno", None), otherwise)
        raise InputError(f"the viewer cannot listen at {host}:{port} ({reason}): {remedy}") from None


def address(host: str, port: int) -> str:
    """What a browser on this machine opens to see a server that listens at `host`."""
    if host in ("127.0.0.1", "0.0.0.0"):
        host = "localhost"
    elif host == "::":
        host = "::1"  # not localhost, which may mean 127.0.0.1 alone
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


class Page:
    """A web page that shows frames and takes wishes.

    Args:
        host: interface to listen at.
        port: 0 takes any free one.
        controls: those of a training; None: there is none to control.

    Raises:
        InputError: viser is not installed, or the port is not free.
    """

    def __init__(self, host: str, port: int, controls: Controls | None = None) -> None:
        viser = require_viser()
        require_free(host, port)
        self.controls = controls or Controls()
        self.picture, self.view = Picture.RENDER, 0
        self.capture: CaptureViews | None = None
        self._screens: dict[int, Screen] = {}
        self._encoder = ThreadPoolExecutor(1, thread_name_prefix="turbogs-viewer")
        self._frusta: list[Any] = []
        with contextlib.redirect_stdout(io.StringIO()):  # viser greets on standard output, which is the command's
            self.server = viser.ViserServer(host=host, port=port, label="TurboGS", verbose=False)
        self.port = self.server.get_port()
        if port not in (0, self.port):
            self.close()
            raise InputError(f"the viewer cannot listen at {host}:{port} (taken meanwhile): name another port")
        _guard(self.server)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        self.server.gui.main_panel.dock_right()
        self.url = address(host, self.port)
        self._build_panel(controls is not None)
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
        self._slider.disabled = self._there.disabled = len(capture) < 2
        self._slider.visible = self._there.visible = self._cameras.visible = True
        self._start_at(Eye.of_view(cameras, 0))
        for number in evenly(len(capture), MOST_FRUSTA):
            views, view_id = capture.find(number)
            self._add_frustum(number, views.cameras, view_id, TRAIN_COLOR if views is capture.train else TEST_COLOR)
        self._refresh_visibility()

    def show_model(self, distance: float) -> None:
        """Stand before a model without a capture, at the origin. Its way up is not known: y is taken as down, as most
        reconstructions have it."""
        self.server.scene.set_up_direction("-y")
        self._start_at(Eye((0.0, 0.0, -distance), (1.0, 0.0, 0.0, 0.0), math.radians(60.0), 640, 480), distance)

    def say(self, text: str) -> None:
        """Show the state of things."""
        if self._status.content != text:
            self._status.content = text

    def go_to(self, number: int) -> None:
        """Choose a view, and bring every client's camera there."""
        self.choose_view(number)
        views, view_id = self.capture.find(self.view)
        eye = Eye.of_view(views.cameras, view_id)
        for client in self.server.get_clients().values():
            self._bring(client, eye)
        self.controls.wake()

    def choose_view(self, number: float) -> None:
        """Set the view that pictures of a view show; whatever comes is brought within bounds."""
        count = len(self.capture) if self.capture is not None else 1
        number = int(min(max(0.0, float(number)), count - 1)) if math.isfinite(float(number)) else 0
        self.view = number
        if self._slider.value != number:
            self._slider.value = number
        self.controls.wake()

    def choose_picture(self, name: str) -> None:
        """Set the picture by its name; one that there is not is ignored."""
        chosen = {picture.value: picture for picture in Picture}.get(str(name))
        if chosen is None:
            return
        self.picture = chosen
        self._about.content = PICTURES[chosen]
        self._refresh_visibility()
        self.controls.wake()

    def refresh_controls(self) -> None:
        """Show whether the training waits."""
        self._pause.label = "Go on" if self.controls.paused else "Pause"

    def finished(self) -> None:
        """There is nothing to control any more."""
        self._training.visible = False

    def close(self) -> None:
        """Turn everybody away."""
        self._screens.clear()
        self._encoder.shutdown(wait=True, cancel_futures=True)
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def _build_panel(self, training: bool) -> None:
        gui = self.server.gui
        self._status = gui.add_markdown("Photos are being read, and error maps made.")
        names = [picture.value for picture in Picture]
        self._pictures = gui.add_dropdown("Picture", names, initial_value=self.picture.value)
        self._about = gui.add_markdown(PICTURES[self.picture])
        self._slider = gui.add_slider("View", 0, 1, 1, 0, visible=False)
        self._there = gui.add_button("Stand at this view", visible=False)
        self._cameras = gui.add_checkbox("Cameras of the capture", False, visible=False)
        self._training = gui.add_folder("Training", visible=training)
        with self._training:
            self._pause = gui.add_button("Pause")
            self._step = gui.add_button("One step")
        self._pictures.on_update(lambda event: self.choose_picture(self._pictures.value))
        self._slider.on_update(lambda event: self.choose_view(self._slider.value))
        self._there.on_click(lambda event: self.go_to(self.view))
        self._cameras.on_update(lambda event: self._refresh_visibility())
        controls = self.controls
        self._pause.on_click(lambda event: self._control(controls.resume if controls.paused else controls.pause))
        self._step.on_click(lambda event: self._control(controls.step))

    def _control(self, change: Callable[[], None]) -> None:
        change()
        self.refresh_controls()

    def _refresh_visibility(self) -> None:
        visible = bool(self._cameras.value) and not self.picture.of_view
        for frustum in self._frusta:
            frustum.visible = visible

    def _add_frustum(self, number: int, cameras: Cameras, view_id: int, color: tuple[int, int, int]) -> None:
        eye = Eye.of_view(cameras, view_id)
        frustum = self.server.scene.add_camera_frustum(
            f"/views/{number}",
            fov=eye.fov,
            aspect=eye.width / eye.height,
            scale=FRUSTUM_SIZE,
            thickness=FRUSTUM_PIXELS,
            thickness_units="screen",
            color=color,
            wxyz=eye.wxyz,
            position=eye.position,
        )
        frustum.on_click(lambda event: self.go_to(number))
        self._frusta.append(frustum)

    def _start_at(self, eye: Eye, distance: float = 1.0) -> None:
        """Where new clients stand, and those who are there already."""
        _, down, forward = eye.rotation.T
        place = np.array(eye.position)
        start = self.server.initial_camera
        start.position, start.look_at, start.up, start.fov = place, place + distance * forward, -down, eye.fov
        for client in self.server.get_clients().values():
            self._bring(client, eye)

    def _bring(self, client: Any, eye: Eye) -> None:
        """Move a client's camera. One that claims to be at an impossible place stays there."""
        with contextlib.suppress(ValueError, AssertionError), client.atomic():
            client.camera.position = np.array(eye.position)
            client.camera.wxyz = np.array(eye.wxyz)
            client.camera.fov = eye.fov

    def _connected(self, client: Any) -> None:
        screen = Screen(lambda pixels, lossless: self._send(client, screen, pixels, lossless))
        self._screens[client.client_id] = screen
        client.camera.on_update(lambda camera: self._looked(screen, camera))
        self._looked(screen, client.camera)
        wide = screen.eye is not None and screen.eye.width > NARROW
        with client.gui.add_folder("What is this?", expand_by_default=wide):
            client.gui.add_markdown(METHOD + TRY_IT if self._training.visible else METHOD)

    def _disconnected(self, client: Any) -> None:
        self._screens.pop(client.client_id, None)
        self.controls.wake()

    def _looked(self, screen: Screen, camera: Any) -> None:
        state = (camera.position, camera.wxyz, camera.fov, camera.image_width, camera.image_height)
        screen.look(Eye.checked(*state), time.perf_counter())
        self.controls.wake()

    def _send(self, client: Any, screen: Screen, pixels: np.ndarray, lossless: bool) -> None:
        def encode() -> None:
            try:
                if client.client_id in self._screens:
                    options = {"format": "png"} if lossless else {"format": "jpeg", "jpeg_quality": JPEG_QUALITY}
                    client.scene.set_background_image(pixels, **options)
            finally:
                screen.busy = False
                self.controls.wake()

        with contextlib.suppress(RuntimeError):  # the page is closing
            self._encoder.submit(encode)


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
