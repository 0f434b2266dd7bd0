"""The web page of the viewer, a viser server: its panel and its clients.

viser calls back from threads of its own; these only take down what a client wants. Drawing and encoding happen on the
thread that owns the model (`frames`).
"""

from __future__ import annotations

import contextlib
import io
import logging
import re
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import numpy as np

from turbogs_plugin.errors import InputError
from turbogs_plugin.viewer.camera import ViewerCamera, focus_and_up
from turbogs_plugin.viewer.frames import Frames
from turbogs_plugin.viewer.pictures import CaptureViews, Picture

if TYPE_CHECKING:
    import viser

JPEG_QUALITY = 85
POLL_SECONDS = 0.02
"""Seconds between two looks at what the page asks for, where no frame is due."""
INSTALL = 'pip install "viser>=1.1,<2"'


@contextlib.contextmanager
def quiet_server(host: str, port: int) -> Iterator[viser.ViserServer]:
    """While entered, a viser server that says nothing on standard output, which is the command's, and answers to its
    own names alone (`_guarded`). Port 0 takes any free one. Raises `InputError`: viser is not installed, or no server
    can listen there (viser itself would take another port)."""
    try:
        import viser
    except ImportError as error:
        raise InputError(f"the viewer needs {error.name}: {INSTALL}") from error
    try:
        socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET).close()
    except (OSError, OverflowError, UnicodeError) as error:
        reason = (isinstance(error, OSError) and error.strerror) or error
        raise InputError(f"the viewer cannot listen at {host}:{port} ({reason}): name another port or host") from None
    with contextlib.redirect_stdout(io.StringIO()), _guarded(host):
        server: Any = viser.ViserServer(host=host, port=port, label="TurboGS", verbose=False)
    server.request_share_url = lambda *arguments, **options: None  # a tunnel into the internet
    try:
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


def quoted(name: str) -> str:
    """A name that comes with a capture as a Markdown text that cannot be more than text."""
    return f"`{name.replace('`', '?')}`"


class Page:
    """A web page that shows frames and takes wishes, as of `quiet_server`.

    Args:
        training: whether there is a training to control.

    Attributes:
        paused: whether the training is asked to wait. It waits only while a page is open.
        steps: iterations that a paused training is asked for.
        training: the controls of a training.
    """

    def __init__(self, host: str, port: int, training: bool = False) -> None:
        self.capture: CaptureViews | None = None
        self.frames = Frames(self._send, self.wish)
        self._opened = contextlib.ExitStack()
        self.server = self._opened.enter_context(quiet_server(host, port))
        self.server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        self.server.gui.main_panel.dock_right()
        host = "localhost" if host in ("127.0.0.1", "0.0.0.0") else f"[{host}]" if ":" in host else host
        self.url = f"http://{host}:{self.server.get_port()}"
        gui: Any = self.server.gui  # its handles' values cannot be set, says its type
        self._status = gui.add_markdown("Photos are being read, and error maps made.")
        offered = Picture if training else (Picture.RENDER, Picture.COMPARE)  # the others are of a training
        self._pictures = gui.add_dropdown("Picture", [picture.value for picture in offered])
        self._slider = gui.add_slider("View", 1, 2, 1, 1, visible=False)  # from 1, as the line about a view counts
        self._there = gui.add_button("Stand at this view", visible=False)
        self.training = gui.add_folder("Training", visible=training)
        with self.training:
            self._pause = gui.add_button("Pause")
            self._step = gui.add_button("One step")
        self._there.on_click(lambda _: self.go_to(self._slider.value - 1))
        self._pause.on_click(self._pause_clicked)
        self._step.on_click(self._step_clicked)
        self.pause(False)
        self.server.on_client_connect(self._connected)

    @property
    def watched(self) -> bool:
        return bool(self.server.get_clients())

    def wish(self) -> tuple[Picture, int]:
        """The picture and the view that the pages show; a picture that a client made up is the render."""
        name = self._pictures.value
        return Picture(name) if name in list(Picture) else Picture.RENDER, self._slider.value - 1

    def pause(self, paused: bool) -> None:
        """Let the training wait, or go on; iterations that it was asked for are void."""
        self.paused, self.steps = paused, threading.Semaphore(0)
        self._pause.label = "Go on" if paused else "Pause"

    def show_capture(self, capture: CaptureViews) -> None:
        """Offer the views of a capture, and stand at the first one."""
        self.capture = capture
        cameras = capture.train.cameras
        self.server.scene.set_up_direction(focus_and_up(cameras)[1])
        self._slider.max = max(2, len(capture))
        self._slider.visible = self._there.visible = True
        self.stand_at(ViewerCamera.of_view(cameras, 0))

    def stand_at(self, camera: ViewerCamera) -> None:
        """Move all clients, those who come later too, to a camera; they turn about a point one unit before it."""
        _, down, forward = camera.rotation.T
        place = np.array(camera.position)
        start = self.server.initial_camera
        start.position, start.look_at, start.up, start.fov = place, place + forward, -down, camera.fov
        for client in self.server.get_clients().values():
            # A client that claims to be at an impossible place stays there.
            with contextlib.suppress(ValueError, AssertionError), client.atomic():
                client.camera.position, client.camera.wxyz = place, np.array(camera.wxyz)
                client.camera.fov = camera.fov

    def say(self, line: str) -> None:
        """Show a line of Markdown, and below it the line about the last frame."""
        about = self.frames.about
        self._status.content = f"{line}\n\n{quoted(about) if about else ''}"

    def go_to(self, number: int) -> None:
        """Choose a view, and bring every client's camera there."""
        if self.capture is not None:
            self._slider.value = 1 + min(max(0, number), len(self.capture) - 1)
            views, view_id = self.capture.find(self._slider.value - 1)
            self.stand_at(ViewerCamera.of_view(views.cameras, view_id))

    def close(self) -> None:
        """Turn everybody away."""
        self._opened.close()

    # viser runs asynchronous functions one after the other, in the order of the clicks; others in any order.
    async def _pause_clicked(self, event: object) -> None:
        self.pause(not self.paused)

    async def _step_clicked(self, event: object) -> None:
        """Ask for one iteration, after which the training waits."""
        if not self.paused:
            self.pause(True)
        self.steps.release()

    def _connected(self, client: viser.ClientHandle) -> None:
        client.camera.on_update(self._looked)
        self._looked(client.camera)

    def _looked(self, camera: viser.CameraHandle) -> None:
        size = camera.image_width, camera.image_height
        self.frames.look(ViewerCamera.checked(camera.position, camera.wxyz, camera.fov, *size))

    def _send(self, pixels: np.ndarray, lossless: bool) -> None:
        self.server.scene.set_background_image(pixels, "png" if lossless else "jpeg", jpeg_quality=JPEG_QUALITY)


def _own_name(asked: str, host: str) -> bool:
    """Whether ``localhost:8080``, which a client asks for, names a page that listens at `host`; at 0.0.0.0, any address
    does and the machine's name. A foreign name that leads here is the way of a foreign page's script."""
    try:
        name = urlsplit(f"//{asked}").hostname or ""
    except ValueError:
        return False
    everywhere, machine = host in ("0.0.0.0", "::"), socket.gethostname().lower()
    own = {"localhost", "127.0.0.1", "::1", host.lower(), *([machine, f"{machine}.local"] if everywhere else [])}
    return name in own or (everywhere and bool(re.fullmatch(r"[\d.]+|[\da-f:.]*:[\da-f:.]*", name)))


class _OneLine(logging.Handler):
    """Says once that a client sent what is no message, where websockets would print a trace for each."""

    def emit(self, record: logging.LogRecord) -> None:
        if self.level == logging.NOTSET:
            self.setLevel(logging.CRITICAL + 1)
            print("turbogs: the viewer turned a client away that sent what is no message", file=sys.stderr, flush=True)


@contextlib.contextmanager
def _guarded(host: str) -> Iterator[None]:
    """While entered, a viser server begins that refuses its page and its socket to a foreign name (`_own_name`) and to
    scripts of foreign pages that a browser on this machine has open, and that does not fill stderr. Raises
    `InputError`: this viser serves otherwise."""
    from websockets.asyncio import server as sockets

    logger, serve, guarded = logging.getLogger("websockets.server"), sockets.serve, []
    logger.handlers, logger.propagate = [_OneLine(logging.NOTSET)], False

    def serve_own(*arguments: Any, process_request: Callable, **options: Any) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            origins, hosts = (request.headers.get_all(name) for name in ("Origin", "Host"))
            own = len(hosts) == 1 and _own_name(hosts[0], host)
            if not own or any(urlsplit(origin).netloc != hosts[0] for origin in origins):
                return connection.respond(403, "This page answers to localhost and its --host alone.\n")
            request.headers.pop("Accept-Encoding", None)  # or the page comes packed
            page = process_request(connection, request)
            if page is not None and page.body:  # viser has no setting for the tab's name; the page's length stays
                page.body = page.body.replace(b"  <title>Viser<", b"<title>TurboGS<", 1)
            return page

        guarded.append(host)
        return serve(*arguments, process_request=answer, **options)

    sockets.serve = serve_own  # type: ignore[assignment,misc]  # viser takes no answer of ours
    try:
        yield
    finally:
        sockets.serve = serve  # type: ignore[misc]
    if not guarded:
        raise InputError(f"this version of viser cannot be kept from foreign pages: {INSTALL}")


def serve_until_interrupted(page: Page, serve: Callable[[], bool]) -> None:
    """Say on standard output where the page is, and serve it until Ctrl-C: `serve` draws a frame if one is due, and
    says whether it did."""
    with contextlib.suppress(KeyboardInterrupt):
        print(f"viewer  {page.url}  (Ctrl-C ends)", flush=True)
        while True:
            if not serve():
                time.sleep(POLL_SECONDS)
