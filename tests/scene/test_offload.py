"""Maps and photos in host memory: the bits of resident ones, whatever travels when."""

import json
import random
from collections import deque
from threading import Event

import numpy as np
import pytest
import torch
from helpers.framework_runs import assert_identical, tiny_config, tiny_trainer

from turbogs_plugin.error_maps import AGE_MAX, ErrorMaps
from turbogs_plugin.export.renders import render_run
from turbogs_plugin.report.evaluation import evaluate_run
from turbogs_plugin.scene import offload
from turbogs_plugin.scene.offload import ABSENT, OffloadedErrorMaps, ViewWindow
from turbogs_plugin.scene.photos import Photos, pixel_offsets
from turbogs_plugin.strategies.pixel_sampling import ErrorGuidedPixelSampler
from turbogs_plugin.train import run
from turbogs_plugin.types import Step

SIZES = np.array([[21, 17], [5, 40], [16, 16], [1, 1], [33, 9], [20, 20], [7, 7]])
CPU = torch.device("cpu")
PLACES = ("device", "host")


@pytest.mark.parametrize("unit", ["pixel", "tile"])
def test_training_is_bit_for_bit_that_of_resident_maps_and_photos(scene, unit):
    overrides = (f"pixel_sampler.unit={unit}", "schedule.max_views=2")
    resident, offloaded = (tiny_trainer(scene, f"train.pixels_place={place}", *overrides) for place in PLACES)
    assert_identical(resident.state_dict(), offloaded.state_dict())
    for _ in range(9):
        resident.step()
        offloaded.step()
    assert_identical(resident.state_dict(), offloaded.state_dict())
    assert len(offloaded.maps.errors) < len(resident.maps.errors)  # a window, not all of it
    assert len(offloaded.views.photos.colors) < len(resident.views.photos.colors)
    places = offloaded.maps.offsets
    assert np.array_equal(places, offloaded.views.photos.offsets) and (places != ABSENT).sum() == 4  # one kernel uses
    assert len(offloaded.maps.errors) == len(offloaded.views.photos.colors)  # both, and checks that


@pytest.mark.parametrize("place", PLACES)
def test_photos_stay_in_host_memory_when_a_run_is_looked_at(capture, tmp_path, monkeypatch, place):
    """Evaluated, where it was planned so, with the same errors; rendered, always."""
    config = tiny_config(capture, f"train.pixels_place={place}", "train.iterations=2")
    outcome = run.train(config, tmp_path / "run")
    to, moved = Photos.to, []
    monkeypatch.setattr(Photos, "to", lambda photos, device: moved.append(device) or to(photos, device))
    evaluate_run(tmp_path / "run", "cpu")
    measured = json.loads((tmp_path / "run/metrics.json").read_text())
    assert measured["mean"]["psnr"] == outcome.history[-1].psnr and len(measured["views"]) == 1
    assert moved == ([] if place == "host" else [CPU])
    render_run(tmp_path / "run", "train", "cpu", False)
    assert len(moved) == (place == "device")


def test_maps_of_both_kinds_say_the_same():
    """Through everything that `ErrorMaps` offers, and over the turn of the stamps' range."""
    generator = torch.Generator().manual_seed(3)
    images = [torch.rand(height, width, generator=generator) for width, height in SIZES.tolist()]
    both = [kind.from_images(images, beta=0.3) for kind in (ErrorMaps, OffloadedErrorMaps)]
    sampler, choose = ErrorGuidedPixelSampler(), random.Random(1)
    for iteration in [*range(20), AGE_MAX - 1, AGE_MAX + 30, *range(2 * AGE_MAX + 60, 2 * AGE_MAX + 70)]:
        step = Step(iteration, 10**6, 10**6, seed=4)
        views = tuple(choose.sample(range(len(SIZES)), choose.randint(1, 3)))
        samples = [sampler.sample(maps, views, 0.3, step) for maps in both]
        assert torch.equal(samples[0].pixel_ids, samples[1].pixel_ids)
        errors = torch.rand(len(samples[0]), generator=generator) * 3
        errors[::5] = torch.nan
        for maps, drawn in zip(both, samples, strict=True):
            maps.update(drawn, errors, step)
        if iteration % 3 == 0:
            view = choose.randrange(len(SIZES))
            assert torch.equal(both[0].ages(view, step), both[1].ages(view, step))
            assert torch.equal(both[0].view_errors(view), both[1].view_errors(view))
            assert both[0].view_means().mean() == both[1].view_means().mean()
    assert both[0].stamp_base == both[1].stamp_base == 2 * AGE_MAX + 60
    assert_identical(both[0].state_dict(), both[1].state_dict())


class Stream:
    """A stream of a simulated GPU, with what copies of `offload` ask of one."""

    def __init__(self, machine: "Machine") -> None:
        self.queue, self.latest = deque(), []
        machine.streams.append(self)

    def wait(self, events) -> None:
        self.queue += events

    def copy(self, target, source) -> None:
        self.queue.append(lambda: target.copy_(source))

    def mark(self) -> list[Event]:
        self.latest = [Event()]
        self.queue.append(self.latest[0].set)
        return self.latest


class Machine:
    """A GPU's streams: of those that may go on, chance says which one does."""

    def __init__(self, seed: int) -> None:
        self.choose, self.streams = random.Random(seed), []
        self.compute = Stream(self)

    def run(self, steps: float = np.inf) -> None:
        """At most `steps` of what is enqueued. An event that is not set stops its stream."""
        while steps > 0:
            queues = [stream.queue for stream in self.streams if stream.queue]
            ready = [queue for queue in queues if not isinstance(queue[0], Event) or queue[0].is_set()]
            if not ready:
                assert not queues, "the streams wait for each other"
                return
            work = self.choose.choice(ready).popleft()
            if not isinstance(work, Event):
                work()
            steps -= 1


@pytest.fixture
def machine(monkeypatch):
    """The copies of `offload` go through a simulated machine."""

    def make(seed: int) -> Machine:
        machine = Machine(seed)
        monkeypatch.setattr(offload, "_Stream", lambda device, own: Stream(machine) if own else machine.compute)
        monkeypatch.setattr(offload, "synchronize", lambda device: machine.run())
        return machine

    return make


@pytest.mark.parametrize("written", [True, False])
@pytest.mark.parametrize("seed", range(8))
def test_no_copy_is_too_early_or_too_late(machine, seed, written):
    """Work on the window, and copies in and out, in any order that the events allow: what a plain array gives."""
    gpu, choose, starts = machine(seed), random.Random(seed), pixel_offsets(SIZES)
    truth = torch.arange(int(starts[-1]), dtype=torch.int64)
    window = ViewWindow((truth.clone(),), SIZES, CPU, written=written)
    seen = []

    def work(place: int, start: int, end: int, amount: int) -> None:
        inside = window.arrays[0][place:][: end - start]  # as kernels get it: the waiting is enqueued before the work
        expected = truth[start:end].clone()

        def change() -> None:
            seen.append(torch.equal(inside, expected))
            inside.add_(amount if written else 0)

        gpu.compute.queue.append(change)
        truth[start:end] += amount if written else 0

    for turn in range(60):
        views = choose.sample(range(len(SIZES)), choose.choice([1, 1, 2, 3]))
        window.fetch(views)
        for view in views:
            start, end = starts[view : view + 2].tolist()
            work(int(window.offsets[view]), start, end, 1000 * turn + view)
        gpu.run(choose.choice([0, 0, 3, 10, 40]))
        if turn % 20 == 19:
            assert torch.equal(window.flush()[0], truth)
        if turn == 30 and written:
            window.change_all(0, lambda values: -values)
            truth.neg_()
    assert torch.equal(window.flush()[0], truth)
    assert all(seen) and len(seen) > 60


def test_nothing_waits_for_the_device_once_the_window_has_its_size(machine):
    """Until somebody asks for the whole maps, the simulated device may stand still for ever."""
    gpu = machine(0)
    window = ViewWindow((torch.zeros(int(SIZES.prod(axis=1).sum())),), SIZES, CPU, written=True)
    window.fetch([0, 1])
    gpu.run = None  # any waiting would call it
    for turn in range(50):
        window.fetch([turn % 7, (turn + 1 + turn // 7 % 6) % 7])
