"""When frames are drawn: nothing for nobody, nothing twice, lossless at rest, within the share of a training."""

from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from helpers.models import random_gaussians

from turbogs_plugin.engine.render_pass import DEFAULT_SETTINGS
from turbogs_plugin.train.look import Look
from turbogs_plugin.viewer import frames as module
from turbogs_plugin.viewer.camera import ViewerCamera
from turbogs_plugin.viewer.frames import FEWEST_PIXELS, REST_SECONDS, SHARE, Frames
from turbogs_plugin.viewer.pictures import ModelState, Picture

AHEAD = ViewerCamera((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 1.0, 640, 480)
NOTHING = ModelState(random_gaussians(0, 0), Look(0, DEFAULT_SETTINGS))


class Desk:
    """Frames under a clock that only a test and drawing move, by `per_pixel` seconds."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, per_pixel: float = 0.0) -> None:
        self.now = 100.0
        self.sent: list[tuple[int, bool]] = []  # width, lossless
        self.wish, self.per_pixel = (Picture.RENDER, 0), per_pixel
        take = lambda pixels, lossless: self.sent.append((pixels.shape[1], lossless))  # noqa: E731
        self.frames = Frames(take, lambda: self.wish, clock=lambda: self.now)
        monkeypatch.setattr(module, "draw", self._draw)

    def _draw(self, state: ModelState, picture: Picture, camera: ViewerCamera, view: int) -> tuple[np.ndarray, str]:
        self.now += self.per_pixel * camera.width * camera.height
        return np.zeros((camera.height, camera.width, 3), dtype=np.uint8), ""

    def look(self, x: float) -> None:
        self.frames.look(ViewerCamera((x, 0.0, 0.0), AHEAD.wxyz, AHEAD.fov, AHEAD.width, AHEAD.height))

    def serve(self, version: int = 0, running: bool = False) -> bool:
        return self.frames.serve(lambda: NOTHING, version, running)

    def wait(self, seconds: float) -> None:
        self.now += seconds


def test_moving_frames_are_small_files_and_the_last_one_is_lossless(monkeypatch):
    desk = Desk(monkeypatch)
    desk.frames.look(None)
    assert not desk.frames.serve(lambda: pytest.fail("a state was asked for"), 0, True)
    desk.look(0.0)
    assert desk.serve() and not desk.sent[-1][1]
    desk.wait(0.05)
    assert not desk.serve(), "the camera stands still for a moment"
    desk.look(1.0)
    assert desk.serve() and not desk.sent[-1][1]
    desk.wait(REST_SECONDS)
    assert desk.serve() and desk.sent[-1] == (AHEAD.width, True)
    for _ in range(5):
        desk.wait(10.0)
        assert not desk.serve(), "at rest with nothing new"


def test_whatever_is_new_is_drawn_again(monkeypatch):
    desk = Desk(monkeypatch)
    desk.look(0.0)
    for wish, version in (((Picture.RENDER, 0), 0), ((Picture.RENDER, 0), 1), ((Picture.AGES, 0), 1)):
        desk.wait(1.0)
        desk.wish = wish
        assert desk.serve(version)
        desk.wait(1.0)
        assert not desk.serve(version)
    desk.wish = (Picture.AGES, 3)
    assert desk.serve(version=1) and all(lossless for _, lossless in desk.sent)


@pytest.mark.parametrize("per_pixel", [1e-9, 1e-8, 1e-6])
def test_frames_take_their_share_of_a_training_and_no_more(monkeypatch, per_pixel):
    desk = Desk(monkeypatch, per_pixel)
    began, drawing = desk.now, 0.0
    while desk.now < began + 20.0:
        desk.wait(0.001)  # an iteration
        desk.look(before := desk.now)
        desk.serve(version=int(1000 * before), running=True)
        drawing += desk.now - before
    # The last frame's pause may lie beyond the end.
    assert drawing <= SHARE * (desk.now - began) + FEWEST_PIXELS * per_pixel
    rate = len(desk.sent) / 20.0
    if per_pixel < 1e-7:
        assert 10 <= rate <= 15 and desk.sent[-1][0] == AHEAD.width, "fast enough, and whole"
    else:
        assert desk.sent[-1][0] == 160 and 1 < rate < 10, "as small as allowed, and as often as allowed"


def test_without_a_training_moving_frames_keep_pace_and_the_one_at_rest_is_whole(monkeypatch):
    desk = Desk(monkeypatch, per_pixel=1e-6)  # the whole page takes 0.3 s
    for step in range(10):
        desk.look(float(step))
        before = desk.now
        assert desk.serve()
        assert desk.now - before <= 0.1
        desk.wait(0.04)
    desk.wait(REST_SECONDS)
    assert desk.serve() and desk.sent[-1] == (AHEAD.width, True)


def test_a_full_device_ends_no_training(monkeypatch):
    desk = Desk(monkeypatch)
    monkeypatch.setattr(module, "draw", MagicMock(side_effect=torch.cuda.OutOfMemoryError))
    desk.look(0.0)
    assert desk.serve() and desk.sent == []


def test_waiting_for_the_training_is_no_cost_of_a_frame(monkeypatch):
    """What `serve` is given may wait for iterations under way; the share is of the time that drawing takes."""
    desk = Desk(monkeypatch, per_pixel=1e-6)
    desk.look(0.0)
    assert desk.frames.serve(lambda: desk.wait(1.0) or NOTHING, 0, True)
    width, _ = desk.sent[-1]
    assert desk.frames.next_at == pytest.approx(101.0 + 1e-6 * width * width * 3 / 4 / SHARE)
