"""The page as a client without a browser meets it: frames, hostile input, ports, and the commands that open it."""

import contextlib
import math
import os
import signal
import socket
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from http.client import HTTPConnection
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import urlsplit

import numpy as np
import pytest
import torch
from helpers.framework_runs import TINY, assert_identical
from helpers.processes import comes_true, command_line, ended, said, start_ranks
from helpers.refusals import assert_one_line, assert_refused
from helpers.viewer_client import ViewerClient

from turbogs_plugin.model.ply import save_ply
from turbogs_plugin.viewer.camera import ViewerCamera
from turbogs_plugin.viewer.live import LiveViewer
from turbogs_plugin.viewer.pictures import Picture, draw
from turbogs_plugin.viewer.server import INSTALL, Page, _own_name
from turbogs_plugin.viewer.show import open_state

pytest.importorskip("viser")
exceptions = pytest.importorskip("websockets.exceptions")


def test_pictures_and_views_are_chosen_on_the_page_and_moving_frames_are_jpeg(shown, state):
    camera = ViewerCamera.of_view(state.capture.train.cameras, 0)
    with shown(state) as page, ViewerClient(page.url) as client:
        client.look(camera)
        client.next_frame(lossless=True)
        for picture, view in ((Picture.COMPARE, 2), (Picture.ERRORS, 4), (Picture.RENDER, 4)):
            client.press(page._slider._impl.uuid, view + 1)
            client.press(page._pictures._impl.uuid, picture.value)
            expected, _ = draw(state, picture, camera, view)
            came = (client.next_frame(lossless=True).pixels() for _ in range(5))  # perhaps after the choice of a view
            assert any(np.array_equal(pixels, expected) for pixels in came), picture
        client.look(replace(camera, fov=camera.fov * 0.9))
        assert not client.next_frame().lossless
        client.next_frame(lossless=True)


HOSTILE = (
    ((math.nan, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 1.0, 64, 48),
    ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), 1.0, 64, 48),
    ((0.0,), (1.0,), "wide", None, []),
)


def test_a_hostile_client_ends_nothing(shown, state):
    camera = ViewerCamera.of_view(state.capture.train.cameras, 0)
    with shown(state) as page:
        for claimed in HOSTILE:
            with ViewerClient(page.url) as client:
                client.look(ViewerCamera(*claimed))
                time.sleep(0.2)
                page.go_to(3)  # moves every client's camera, as far as it has one
                assert page.frames.camera is None
        with ViewerClient(page.url) as client:
            client.look(camera)
            client.next_frame(lossless=True)
            slider, pictures = page._slider._impl.uuid, page._pictures._impl.uuid
            for uuid, value in ((slider, 10**9), (slider, -5), (pictures, "no such picture"), ("nobody", 1)):
                client.press(uuid, value)
            client.look(replace(camera, width=10**9, height=10**9))
            assert max(client.next_frame(lossless=True).pixels().shape) <= 1920
            client.say({"type": "ShareUrlRequest"})
        assert page.server._share_tunnel is None


def test_scripts_of_other_pages_are_turned_away(shown, state):
    camera = ViewerCamera.of_view(state.capture.train.cameras, 0)
    with shown(state) as page:
        port = urlsplit(page.url).port
        foreign, local = f"elsewhere.example:{port}", f"127.0.0.1:{port}"
        for headers in ({"Origin": page.url}, {"Host": local, "Origin": f"http://{local}"}):
            with ViewerClient(page.url, **headers) as client:
                client.look(camera)
                client.next_frame()
        for headers in ({}, {"Host": foreign}):  # a name of theirs that leads here is the second
            with pytest.raises(exceptions.InvalidStatus, match="403"):
                ViewerClient(page.url, Origin=f"http://{foreign}", **headers)
        for name, status in ((local, 200), (foreign, 403)):
            with closing(HTTPConnection("127.0.0.1", port)) as asked:
                asked.request("GET", "/", headers={"Host": name})
                answer = asked.getresponse()
                assert (answer.status, b"<title>TurboGS<" in answer.read()) == (status, status == 200)


def test_a_viser_that_serves_otherwise_is_refused(monkeypatch):
    monkeypatch.setattr("viser.ViserServer", lambda **options: None)
    assert_refused("cannot be kept from foreign pages", Page, "127.0.0.1", 0)


@pytest.mark.parametrize(
    ("host", "own", "others"),
    [
        ("127.0.0.1", ["localhost:80", "127.0.0.1", "[::1]:8080"], ["a.example:8080", "192.168.1.7:80", "", "[::1"]),
        ("box.lan", ["box.lan:1", "localhost"], ["box.lan.example"]),
        ("0.0.0.0", ["192.168.1.7:80", "[fe80::1]:80", f"{socket.gethostname()}:80"], ["a.example:8080"]),
    ],
)
def test_a_page_answers_to_its_own_names(host, own, others):
    assert [_own_name(name, host) for name in (*own, *others)] == [True] * len(own) + [False] * len(others)


def test_garbage_of_clients_leaves_one_line(shown, state, capfd):
    with shown(state) as page:
        for garbage in (b"\xff\xfe", "text", b"\x80", b"\x90"):
            with ViewerClient(page.url) as client, contextlib.suppress(exceptions.ConnectionClosed):
                client._socket.send(garbage)
                for _ in client._socket:  # until it is turned away
                    pass
        with ViewerClient(page.url) as client:
            client.look(ViewerCamera.of_view(state.capture.train.cameras, 0))
            client.next_frame()
    assert len(capfd.readouterr().err.splitlines()) == 1


def test_a_training_goes_on_while_a_client_looks_and_when_it_leaves_a_pause(new_training, scene, unwatched):
    loop, page = new_training(), Page("127.0.0.1", 0, training=True)
    loop.listeners.append(LiveViewer(page).watch(SimpleNamespace(trainer=loop.trainer, test=scene.test)))

    def press(client: ViewerClient) -> None:
        with client:  # whatever happens: a training that waits goes on when its client leaves
            client.next_frame(lossless=True)
            for button in (page._pause, page._step):  # goes on, and pauses after an iteration
                client.press(button._impl.uuid, True)
            client.next_frame(lossless=True)

    with closing(page), ThreadPoolExecutor() as pool, ViewerClient(page.url) as client:
        client.look(ViewerCamera.of_view(loop.trainer.views.cameras, 0))
        assert comes_true(lambda: page.watched, 60.0)
        page.pause(True)
        pressed = pool.submit(press, client)
        loop.run()
        pressed.result(60.0)
    assert not page.paused
    assert_identical(loop.trainer.state_dict(), unwatched)


def test_without_viser_one_line_names_the_extra(turbogs, tmp_path, capture, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    for command in (("view", tmp_path), ("train", capture, "--out", tmp_path / "run", "--viewer")):
        assert turbogs(*command) == (2, "", f"turbogs: error: the viewer needs viser: {INSTALL}\n")
    assert not (tmp_path / "run").exists()


def shown_until_ctrl_c(words: list[str], told: Path) -> None:
    """In a process of its own: the command. A shell starts what it puts into the background with SIGINT ignored, and
    children inherit that."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with told.open("w", buffering=1) as sys.stdout:
        command_line(words)


def test_a_command_with_a_viewer_shows_the_model_until_ctrl_c(capture, tmp_path):
    out, told = tmp_path / "run", tmp_path / "told"
    changes = [*TINY, "train.iterations=2", "train.refine_until=1", "train.evaluate_at=[]"]
    words = ["train", str(capture), *changes, "--out", str(out), "--no-report", "--device", "cpu", "--viewer", "0"]
    (process,) = processes = start_ranks(1, shown_until_ctrl_c, tmp_path, words, told)
    try:
        shown = lambda: told.is_file() and "Ctrl-C ends" in told.read_text()  # noqa: E731
        assert comes_true(lambda: shown() or not process.is_alive(), 120.0)
        assert (out / "model.ply").is_file(), process.exitcode
        os.kill(process.pid, signal.SIGINT)
    finally:
        codes, err = ended(processes, 60.0), said(tmp_path)
    assert codes == [0] and told.read_text().endswith("(Ctrl-C ends)\n"), err
    assert "viewer  http://localhost:" in err and "Traceback" not in err and "viser" not in told.read_text() + err


def test_bad_input_is_one_line(turbogs, tmp_path, capture):
    points = tmp_path / "points.ply"
    points.write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        out = tmp_path / "run"
        cases = {
            ("view", points, "--port", "0"): "points.ply",
            ("view", points, "--port", port): f"127.0.0.1:{port}",
            ("view", points, "--host", "192.0.2.1"): "192.0.2.1:8080",
            ("train", capture, "--out", out, "--viewer", port): f"127.0.0.1:{port}",
            ("train", capture, "--out", out, "--viewer", "0.0.0.0"): "--viewer 0.0.0.0: write a port",
            ("view", points, "--factor", "2"): "--scene",
        }
        for command, named in cases.items():
            assert_one_line(turbogs(*command), named)
    assert not out.exists()


def test_a_model_from_a_file_stands_before_the_camera(state, tmp_path):
    far = replace(state.gaussians, means=state.gaussians.means * 50.0 + torch.tensor([1000.0, -2000.0, 500.0]))
    save_ply(far, tmp_path / "model.ply")
    found = open_state(tmp_path / "model.ply", torch.device("cpu"))
    distances = found.gaussians.means.norm(dim=1)
    assert 0.45 < float((distances <= 1.01).float().mean()) < 0.55
    assert found.capture is None


def test_a_run_is_shown_with_its_capture(turbogs, capture, tmp_path):
    out = tmp_path / "run"
    code, *_ = turbogs("train", capture, "--out", out, "--no-report", "--device", "cpu", *TINY)
    assert code == 0
    found = open_state(out, torch.device("cpu"))
    camera = ViewerCamera.of_view(found.capture.train.cameras, 0)
    assert len(found.capture) == 8 and draw(found, Picture.COMPARE, camera, 7)[0].std() > 1
