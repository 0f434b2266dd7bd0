"""A training with a viewer: the same to the last bit, stopped and stepped, and told of nothing while nobody looks."""

import threading
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.framework_runs import assert_identical
from helpers.processes import comes_true

from turbogs_plugin.train.loop import Listener
from turbogs_plugin.viewer import frames
from turbogs_plugin.viewer.camera import ViewerCamera
from turbogs_plugin.viewer.frames import Frames
from turbogs_plugin.viewer.live import LiveViewer
from turbogs_plugin.viewer.pictures import Picture


class PretendedPage:
    """A page without viser that takes every frame, and wants another picture each time."""

    url = "http://nowhere"

    def __init__(self, watched: bool = True) -> None:
        self.watched, self.paused, self.steps = watched, False, threading.Semaphore(0)
        self.pictures: list[np.ndarray] = []
        self.said: list[str] = []
        self.frames = Frames(lambda pixels, lossless: self.pictures.append(pixels), self.wish)

    def wish(self) -> tuple[Picture, int]:
        count = len(self.pictures)
        return list(Picture)[count % len(Picture)], count

    def show_capture(self, capture) -> None:
        if self.watched:
            self.frames.look(ViewerCamera.of_view(capture.train.cameras, 1))

    def say(self, text: str) -> None:
        self.said.append(text)

    def pause(self, paused: bool) -> None:
        self.paused = paused


class At(Listener):
    """Does something after an iteration."""

    def __init__(self, iteration: int, action) -> None:
        self.iteration, self.action = iteration, action

    def advanced(self, loop) -> None:
        if loop.trainer.iteration == self.iteration:
            self.action()


@pytest.fixture
def watched(new_training, scene, monkeypatch):
    """Makes (page, viewer, training). Every frame that is due is drawn, whatever it takes."""
    monkeypatch.setattr(frames, "SHARE", 1e9)

    def watched(*overrides: str, looking: bool = True):
        page, loop = PretendedPage(looking), new_training(*overrides)
        live = LiveViewer(page).watch(SimpleNamespace(trainer=loop.trainer, test=scene.test))
        loop.listeners.append(live)
        return page, live, loop

    return watched


# In host memory, what a page asks for passes through the window of the training.
@pytest.mark.parametrize("place", ["device", "host"])
def test_a_watched_training_ends_as_an_unwatched_one(unwatched, watched, monkeypatch, place):
    monkeypatch.setitem(frames.SHORTEST_INTERVALS, True, 0.0)
    page, live, loop = watched(f"train.pixels_place={place}")
    loop.run()
    assert live._state().samples.filled.any()
    assert len(page.pictures) >= loop.trainer.iteration > 10 and len({frame.tobytes() for frame in page.pictures}) > 6
    assert_identical(loop.trainer.state_dict(), unwatched)
    assert any("Gaussians" in text and "iteration" in text for text in page.said)
    assert live._state().maps is not None
    live.watch(SimpleNamespace(trainer=loop.trainer, test=live._capture.test))  # as after a resume at the end
    assert live._state().maps is None


def test_nothing_is_drawn_or_kept_while_nobody_looks(watched, monkeypatch):
    page, live, loop = watched(looking=False)
    monkeypatch.setattr(LiveViewer, "_state", lambda *_: pytest.fail("a state was made for nobody"))
    loop.run()
    assert page.pictures == [] and page.said == []
    assert live._samples is None


def test_pause_step_and_go_on(unwatched, watched, monkeypatch):
    page, _, loop = watched()
    stopped, clock_stopped = [], loop.clock.stopped

    def stopping():
        stopped.append(loop.trainer.iteration)
        return clock_stopped()

    monkeypatch.setattr(loop.clock, "stopped", stopping)

    def click() -> None:
        """As a page's thread would."""
        for iteration in (4, 5):
            comes_true(lambda iteration=iteration: iteration in stopped, 60.0)
            page.steps.release()
        comes_true(lambda: 6 in stopped, 60.0)
        page.paused = False

    loop.listeners.insert(0, At(4, lambda: setattr(page, "paused", True)))
    thread = threading.Thread(target=click, daemon=True)
    thread.start()
    loop.run()
    thread.join(60.0)
    assert stopped == [4, 5, 6], "it waited elsewhere, or with the clock running"
    assert loop.finished and any("paused" in text for text in page.said)
    assert_identical(loop.trainer.state_dict(), unwatched)


def test_a_paused_training_can_be_stopped(watched):
    page, _, loop = watched()
    page.steps = SimpleNamespace(acquire=lambda timeout: loop.stop())
    loop.listeners.insert(0, At(3, lambda: setattr(page, "paused", True)))
    loop.run()
    assert loop.trainer.iteration == 3 and loop.stopped


def test_a_training_does_not_wait_for_nobody(watched):
    """Even where a click on Pause arrives behind the news that its page was closed."""
    page, _, loop = watched()
    loop.listeners.insert(0, At(3, lambda: vars(page).update(paused=True, watched=False)))
    loop.run()
    assert loop.finished and not page.paused
