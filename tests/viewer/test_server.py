"""The page as a client without a browser meets it: frames, hostile input, ports, and the commands that open it."""

import dataclasses
import math
import signal
import socket
import subprocess
import sys
import threading

import numpy as np
import pytest
import torch
from helpers.framework_runs import TINY, assert_identical

from turbogs_plugin.engine.render import render_image
from turbogs_plugin.errors import InputError
from turbogs_plugin.model.formats import FORMATS
from turbogs_plugin.report.images import to_uint8
from turbogs_plugin.scene import Frame
from turbogs_plugin.viewer.camera import ViewerCamera
from turbogs_plugin.viewer.live import LiveViewer
from turbogs_plugin.viewer.pictures import Picture, Request, draw
from turbogs_plugin.viewer.server import INSTALL, Page, address, require_server
from turbogs_plugin.viewer.show import open_state

pytest.importorskip("viser")


def connected(page: Page, **headers: str):
    from helpers.viewer_client import WaitingClient

    return WaitingClient(page.url, **headers)


def test_the_first_frames_are_our_renders(shown, state):
    cameras = state.capture.train.cameras
    with shown(state) as page:
        for view in (0, 3, 6):
            with connected(page) as client:
                client.look(ViewerCamera.of_view(cameras, view))
                frame = client.next_frame(lossless=True).pixels()
            image = render_image(state.gaussians, cameras, view, sh_degree=state.sh_degree)
            assert np.abs(frame.astype(int) - to_uint8(image.colors)).max() <= 2


def test_pictures_and_views_are_chosen_on_the_page(shown, state):
    eye = ViewerCamera.of_view(state.capture.train.cameras, 0)
    with shown(state) as page, connected(page) as client:
        client.look(eye)
        client.next_frame(lossless=True)
        for picture, view in ((Picture.DEPTH, 0), (Picture.COMPARE, 2), (Picture.ERRORS, 4), (Picture.RENDER, 4)):
            page.choose_view(view)
            client.press(page._pictures._impl.uuid, picture.value)
            expected = draw(state, Request(picture, eye, view))
            for _ in range(5):  # the choice of a view may be drawn on the way
                if np.array_equal(client.next_frame(lossless=True).pixels(), expected):
                    break
            else:
                pytest.fail(f"{picture.value} did not come")


def test_moving_frames_are_jpeg(shown, state):
    eye = ViewerCamera.of_view(state.capture.train.cameras, 0)
    with shown(state) as page, connected(page) as client:
        client.look(eye)
        client.next_frame(lossless=True)
        client.look(dataclasses.replace(eye, fov=eye.fov * 0.9))
        assert not client.next_frame().lossless
        client.next_frame(lossless=True)


def test_the_address_is_one_that_a_browser_here_reaches():
    """Nothing answers at localhost where that is 127.0.0.1 and the server listens at IPv6 alone."""
    assert [address(host, 80) for host in ("0.0.0.0", "::", "::1", "fox.local")] == [
        "http://localhost:80",
        "http://[::1]:80",
        "http://[::1]:80",
        "http://fox.local:80",
    ]


HOSTILE = (
    ((math.nan, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 1.0, 64, 48),
    ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), 1.0, 64, 48),
    ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), math.inf, 64, 48),
    ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 1.0, -1, 0),
    ((0.0,), (1.0,), "wide", None, []),
)


def test_a_hostile_client_ends_nothing(shown, state):
    from websockets.exceptions import ConnectionClosed

    eye = ViewerCamera.of_view(state.capture.train.cameras, 0)
    with shown(state) as page:
        with connected(page) as client:
            client.look(eye)
            client.next_frame()
        for camera in HOSTILE:
            with connected(page) as client:
                client.look(ViewerCamera(*camera))
                with pytest.raises((TimeoutError, ConnectionClosed)):
                    client.next_frame(timeout=0.3)
                page.go_to(3)  # moves every client's camera, as far as it has one
        with connected(page) as client:
            client.look(eye)
            client.next_frame(lossless=True)
            slider, pictures = page._slider._impl.uuid, page._pictures._impl.uuid
            for uuid, value in ((slider, 10**9), (slider, -5), (pictures, "no such picture"), ("nobody", 1)):
                client.press(uuid, value)
            client.look(dataclasses.replace(eye, width=10**9, height=10**9))
            wide = client.next_frame(lossless=True).pixels()
            assert max(wide.shape) <= 1920
            client.say({"type": "ShareUrlRequest"})
        assert page.server._share_tunnel is None
        assert page.picture in Picture and 0 <= page.view < len(state.capture)


def test_scripts_of_other_pages_are_turned_away(shown, state):
    from websockets.exceptions import ConnectionClosed

    eye = ViewerCamera.of_view(state.capture.train.cameras, 0)
    with shown(state) as page:
        with pytest.raises(ConnectionClosed), connected(page, Origin="http://elsewhere.example") as client:
            client.look(eye)
            client.next_frame(timeout=10.0)
        with connected(page, Origin=page.url) as client:
            client.look(eye)
            client.next_frame()


def test_a_training_goes_on_while_a_client_looks(new_training, scene):
    alone = new_training()
    alone.run()
    loop, page = new_training(), Page("127.0.0.1", 0, training=True)
    live = LiveViewer(page).attach(loop.trainer, scene.test)
    loop.listeners.append(live)
    frames = []

    def look() -> None:
        with connected(page) as client:
            client.look(ViewerCamera.of_view(loop.trainer.views.cameras, 0))
            frames.append(client.next_frame())
            client.press(page._pause._impl.uuid, True)
            frames.append(client.next_frame(lossless=True))
            client.press(page._pause._impl.uuid, True)

    page.controls.set_paused(True)  # until the client is there
    thread = threading.Thread(target=look)
    thread.start()
    page.refresh_controls()
    try:
        while not page.watched:
            page.controls.wait(0.02)
        page.controls.set_paused(False)
        loop.run()
        thread.join()
    finally:
        page.close()
    assert len(frames) == 2
    assert_identical(loop.trainer.state_dict(), alone.trainer.state_dict())


def test_a_port_in_use_is_named():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=f"cannot listen at 127.0.0.1:{port} .*: name another port"):
            require_server("127.0.0.1", port)
    require_server("127.0.0.1", port)


@pytest.mark.parametrize(
    ("host", "port", "remedy"),
    [
        ("127.0.0.1", -1, "1 to 65535"),
        ("127.0.0.1", 70000, "1 to 65535"),
        ("no such host", 8080, "name another port or host"),
        ("203.0.113.1", 8080, "name another port or host"),
    ],
)
def test_an_address_that_is_none_is_named(host, port, remedy):
    with pytest.raises(InputError, match=f"{port}.*{remedy}"):
        require_server(host, port)


def test_a_port_below_zero_is_taken_for_a_port(turbogs, tmp_path, capture):
    code, out, err = turbogs("train", capture, "--out", tmp_path / "run", "--viewer", -1)
    assert (code, out, err) == (2, "", "turbogs: error: port -1 of the viewer: it must be 1 to 65535\n")


def test_without_viser_one_line_names_the_extra(turbogs, tmp_path, capture, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    for command in (("view", tmp_path), ("train", capture, "--out", tmp_path / "run", "--viewer")):
        code, out, err = turbogs(*command)
        assert (code, out, err) == (2, "", f"turbogs: error: the viewer needs viser: {INSTALL}\n")
    assert not (tmp_path / "run").exists()


def test_a_command_with_a_viewer_shows_the_model_until_ctrl_c(capture, tmp_path):
    out = tmp_path / "run"
    changes = [*TINY, "train.iterations=2", "train.refine_until=1", "train.evaluate_at=[]"]
    command = ["train", capture, *changes, "--out", out, "--no-report", "--device", "cpu", "--viewer", "0"]
    # A shell starts what it puts into the background with SIGINT ignored, and children inherit that.
    heeding = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    process = subprocess.Popen(
        [sys.executable, "-c", heeding + "from turbogs_plugin.cli import main; sys.exit(main())", *map(str, command)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    said = ""
    while "Ctrl-C ends" not in said:
        line = process.stdout.readline()
        assert line, process.stderr.read()
        said += line
    assert (out / "model.ply").is_file()
    process.send_signal(signal.SIGINT)
    rest, err = process.communicate(timeout=60)
    assert process.returncode == 0 and rest == "", err
    assert "viewer  http://localhost:" in err and "Traceback" not in err and "viser" not in said + err


def test_bad_input_is_one_line(turbogs, tmp_path, capture):
    points, empty = tmp_path / "points.ply", tmp_path / "empty"
    points.write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n")
    empty.mkdir()
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        out = tmp_path / "run"
        cases = {
            ("view", points, "--port", "0"): "points.ply",
            ("view", empty, "--port", "0"): "empty",
            ("view", tmp_path / "absent.ply", "--port", "0"): "absent.ply",
            ("view", points, "--port", port): f"127.0.0.1:{port}",
            ("train", capture, "--out", out, "--viewer", port): f"127.0.0.1:{port}",
            ("train", capture, "--out", out, "--viewer-host", "0.0.0.0"): "--viewer",
            ("view", points, "--factor", "2"): "--scene",
        }
        for command, named in cases.items():
            code, said, err = turbogs(*command)
            assert code == 2 and said == "" and err.count("\n") == 1 and named in err, (command, err)
    assert not out.exists()


@pytest.mark.parametrize("name", FORMATS)
def test_a_model_from_a_file_stands_before_the_eye(state, tmp_path, name):
    far = state.gaussians.map(lambda value: value.clone())
    far.means = far.means * 50.0 + torch.tensor([1000.0, -2000.0, 500.0])
    file = tmp_path / f"model{FORMATS[name].suffix}"
    FORMATS[name].write(far, file, Frame(np.zeros(3), 1.0), 0)
    found, _ = open_state(file, torch.device("cpu"))
    distances = found.gaussians.means.norm(dim=1)
    assert 0.85 < float((distances <= 1.01).float().mean()) < 0.95
    assert found.capture is None


def test_a_run_is_shown_with_its_error_maps_and_without_its_capture(turbogs, capture, tmp_path):
    out = tmp_path / "run"
    code, *_ = turbogs("train", capture, "--out", out, "--no-report", "--device", "cpu", *TINY)
    assert code == 0
    found, lacking = open_state(out, torch.device("cpu"))
    assert len(found.capture) == 8 and lacking == "" and found.maps.errors.any()
    eye = ViewerCamera.of_view(found.capture.train.cameras, 0)
    assert draw(found, Request(Picture.AGES, eye, 0)).std() > 1
    config = out / "config.yaml"
    config.write_text(config.read_text().replace(str(capture), str(tmp_path / "gone")))
    found, lacking = open_state(out, torch.device("cpu"))
    assert found.capture is None and "gone" in lacking
