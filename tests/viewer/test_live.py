"""A training with a viewer: the same to the last bit, stopped and stepped, and told of nothing while nobody looks."""

import threading
import time

import numpy as np
import pytest
from helpers.framework_runs import assert_identical

from turbogs_plugin.train.loop import Listener
from turbogs_plugin.viewer import frames
from turbogs_plugin.viewer import live as module
from turbogs_plugin.viewer.camera import ViewerCamera
from turbogs_plugin.viewer.frames import Screen
from turbogs_plugin.viewer.live import LiveViewer
from turbogs_plugin.viewer.pictures import Picture
from turbogs_plugin.viewer.server import Controls


class PretendedPage:
    """A page without viser, whose screens take every frame, and which wants another picture each time."""

    url = "http://nowhere"

    def __init__(self, looking: bool = True) -> None:
        self.controls = Controls()
        self.frames: list[np.ndarray] = []
        self.said: list[str] = []
        self._screens = [Screen(self._take)] if looking else []
        self._wishes = 0

    @property
    def watched(self) -> bool:
        return bool(self._screens)

    def screens(self) -> list[Screen]:
        return self._screens

    def wish(self) -> tuple[Picture, int]:
        return list(Picture)[self._wishes % len(Picture)], self._wishes

    def show_capture(self, capture) -> None:
        for screen in self._screens:
            screen.camera = ViewerCamera.of_view(capture.train.cameras, 1)

    def say(self, text: str) -> None:
        self.said.append(text)

    def refresh_controls(self) -> None:
        pass

    def _take(self, pixels: np.ndarray, lossless: bool) -> None:
        self.frames.append(pixels)
        self._wishes += 1


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
        live = LiveViewer(page).attach(loop.trainer, scene.test)
        loop.listeners.append(live)
        return page, live, loop

    return watched


# In host memory, what a page asks for passes through the window of the training.
@pytest.mark.parametrize("place", ["device", "host"])
def test_a_watched_training_ends_as_an_unwatched_one(new_training, watched, monkeypatch, place):
    monkeypatch.setitem(frames.SHORTEST_INTERVALS, True, 0.0)
    overrides = (f"train.maps_place={place}", f"train.photos_place={place}")
    alone = new_training(*overrides)
    alone.run()
    page, _, loop = watched(*overrides)
    loop.run()
    assert len(page.frames) >= loop.trainer.iteration > 10 and len({frame.tobytes() for frame in page.frames}) > 6
    assert_identical(loop.trainer.state_dict(), alone.trainer.state_dict())
    assert any("Gaussians" in text and "iteration" in text for text in page.said)


def test_nothing_is_drawn_or_kept_while_nobody_looks(watched, monkeypatch):
    page, live, loop = watched(looking=False)
    monkeypatch.setattr(LiveViewer, "_state", lambda *_: pytest.fail("a state was made for nobody"))
    loop.run()
    assert page.frames == [] and page.said == []
    assert live._samples is None and live._change is None


def test_what_an_iteration_did_is_shown(watched):
    _, live, loop = watched()
    changes = []
    loop.listeners.append(At(5, lambda: changes.append(live._state(loop.trainer))))
    loop.run()
    (state,) = changes
    assert state.samples is not None and len(state.samples) > 0
    assert len(state.change.update.fresh) == len(state.gaussians)
    assert int(state.change.update.fresh.sum()) >= state.change.update.num_split > 0


def test_pause_step_and_go_on(new_training, watched, monkeypatch):
    page, _, loop = watched()
    waited, stopped = set(), []
    wait, clock_stopped = page.controls.wait, loop.clock.stopped

    def waiting(seconds: float) -> None:
        waited.add(loop.trainer.iteration)
        wait(seconds)

    def stopping():
        stopped.append(loop.trainer.iteration)
        return clock_stopped()

    monkeypatch.setattr(page.controls, "wait", waiting)
    monkeypatch.setattr(loop.clock, "stopped", stopping)

    def click() -> None:
        """As a page's thread would."""
        for iteration, press in ((4, (True, 1)), (5, (True, 1)), (6, (False,))):
            until(lambda iteration=iteration: iteration in waited)
            page.controls.set_paused(*press)

    loop.listeners.insert(0, At(4, lambda: page.controls.set_paused(True)))
    thread = threading.Thread(target=click)
    thread.start()
    loop.run()
    thread.join()
    assert waited == {4, 5, 6} and stopped == [4, 5, 6], "it waited elsewhere, or with the clock running"
    assert loop.finished and not page.controls.paused
    assert any("paused" in text for text in page.said)
    alone = new_training()
    alone.run()
    assert_identical(loop.trainer.state_dict(), alone.trainer.state_dict())


def test_a_paused_training_can_be_stopped(watched, monkeypatch):
    page, _, loop = watched()
    loop.listeners.insert(0, At(3, lambda: page.controls.set_paused(True)))
    monkeypatch.setattr(page.controls, "wait", lambda seconds: loop.stop())
    loop.run()
    assert loop.trainer.iteration == 3 and loop.stopped


def test_a_paused_training_goes_on_when_nobody_looks_any_more(watched, monkeypatch):
    monkeypatch.setattr(module, "ABANDONED_SECONDS", 0.1)
    page, _, loop = watched()

    def pause_and_leave() -> None:
        page.controls.set_paused(True)
        page._screens.clear()

    loop.listeners.insert(0, At(3, pause_and_leave))
    loop.run()
    assert loop.finished


def until(reached, seconds: float = 60.0) -> None:
    ends = time.perf_counter() + seconds
    while not reached():
        assert time.perf_counter() < ends, "nothing happened"
        time.sleep(0.01)


def test_steps_are_counted():
    controls = Controls()
    assert not controls.paused and not controls.take_step()
    controls.set_paused(True, 1)
    controls.set_paused(True, 1)
    assert controls.paused and controls.take_step() and controls.take_step() and not controls.take_step()
    controls.set_paused(False)
    assert not controls.paused
