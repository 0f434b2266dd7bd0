"""Time that is more than the configured iterations take: first it buys pixels an iteration, then iterations."""

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.framework_runs import tiny_capture, tiny_config
from helpers.simulated_time import SimulatedTime

from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.distributed.in_place import SharedModel
from turbogs_plugin.distributed.peer_memory import PeerMemory
from turbogs_plugin.engine.base import BaseEngine
from turbogs_plugin.plan.caps import EXPECTED_GROWTH, growth_cap, growth_room
from turbogs_plugin.plan.memory import MemoryDemand
from turbogs_plugin.plan.pixels import TOLERANCE, pixel_budget_range, pixels_for_time, with_pixel_budget
from turbogs_plugin.plan.time import IterationCost
from turbogs_plugin.report.pages import write_report
from turbogs_plugin.scene import Scene, load_scene
from turbogs_plugin.strategies.pixel_sampling import ErrorGuidedPixelSampler
from turbogs_plugin.train import calibration, run

CPU = torch.device("cpu")
BASE, PER_IMAGE = 0.75e-3, 0.55e-3
"""Seconds of an iteration, about as on fox."""


def fits(seconds: float, tried: list[float], largest: float = 10.0):
    """How many iterations fit with a lambda, of which no more than `largest` costs anything."""

    def fitting(pixel_budget: float) -> int:
        tried.append(pixel_budget)
        return int(seconds / (BASE + PER_IMAGE * min(pixel_budget, largest)))

    return fitting


@pytest.mark.parametrize("seconds", [0.5, 3.0, 6.4, 7.0])
def test_a_time_short_or_just_enough_leaves_lambda(seconds):
    tried = []
    assert pixels_for_time(1.0, 10.0, 5000, 3, fits(seconds, tried)) == 1.0
    assert tried == [1.0]


@pytest.mark.parametrize(("configured", "seconds"), [(1.0, 8.0), (1.0, 12.0), (1.0, 20.0), (1.0, 30.0), (0.5, 20.0)])
def test_time_for_more_iterations_buys_pixels(configured, seconds):
    tried = []
    fitting = fits(seconds, tried)
    chosen = pixels_for_time(configured, 10.0, 5000, 3, fitting)
    assert configured < chosen < 10.0 and len(tried) <= 4
    assert fitting(chosen) == pytest.approx(5000, rel=TOLERANCE)
    assert [*tried[:-1], chosen] == sorted(tried)  # never too far, so never back


def test_time_for_more_than_all_pixels_buys_iterations():
    fitting = fits(60.0, [])
    assert pixels_for_time(1.0, 10.0, 5000, 3, fitting) == 10.0
    assert fitting(10.0) > 1.5 * 5000


def test_fewer_raises_stop_on_the_way():
    fitting = fits(20.0, [])
    one, two = (pixels_for_time(1.0, 10.0, 5000, raises, fitting) for raises in (1, 2))
    assert one == pytest.approx(fitting(1.0) / 5000, abs=1e-3)
    assert two == pytest.approx(one * fitting(one) / 5000, abs=1e-3)
    assert 1.0 < one < two


def test_a_lambda_that_costs_too_many_iterations_is_not_taken():
    """A measurement disturbed, or a cost that jumps."""
    lengths = {1.0: 10_000, 2.0: 4400}
    assert pixels_for_time(1.0, 10.0, 5000, 3, lengths.__getitem__) == 1.0
    lengths = {1.0: 10_000, 2.0: 7500, 3.0: 4400}
    assert pixels_for_time(1.0, 10.0, 5000, 3, lengths.__getitem__) == 2.0


@pytest.mark.parametrize(
    ("overrides", "views", "expected"),
    [
        ((), 43, (1.0, 10.0)),
        ((), 6, (1.0, 6.0)),
        (("schedule.pixel_budget=0.5", "schedule.max_views=4"), 43, (0.5, 4.0)),
        (("schedule.pixel_budget=12",), 43, (12.0, 12.0)),
        (("schedule.type=fixed", "schedule.views=5"), 43, (1.0, 5.0)),
        (("pixel_sampler.type=dense",), 43, (1.0, 1.0)),
        (("pixel_sampler.type=random",), 43, (1.0, 10.0)),
    ],
)
def test_no_more_pixels_than_the_views_have(overrides, views, expected):
    assert pixel_budget_range(load_config("turbogs", overrides), views) == expected


def test_memory_for_pixels_is_what_the_gaussians_leave():
    config = load_config("turbogs", ["train.sh_degree=3", "pixel_sampler.multiple=1"])

    def demand(pixel_budget: float) -> MemoryDemand:
        sizes = np.full((100, 2), 1000)
        return MemoryDemand.of(with_pixel_budget(config, pixel_budget), sizes, sizes[:10])

    limit = 4 * 2**30
    more = demand(1.0).more_images(limit, 500_000)
    assert 1.0 < more < 9.0
    assert demand(1.0 + more).gaussians(limit) == pytest.approx(500_000, abs=1)
    assert demand(1.0).more_images(limit, 2_000_000) == 0.0


def test_dense_samples_take_the_memory_of_whole_views():
    """Whatever lambda."""
    sizes = np.full((100, 2), 1000)
    sparse, dense, clipped = (
        MemoryDemand.of(load_config("turbogs", ["schedule.max_views=5", *overrides]), sizes, sizes[:10]).fixed
        for overrides in (["schedule.pixel_budget=5"], ["pixel_sampler.type=dense"], ["schedule.pixel_budget=50"])
    )
    assert sparse == dense == clipped


def test_the_cap_that_growth_is_expected_to_reach():
    assert growth_cap(load_config("turbogs", ["density.max_gaussians=8000"]), 50) == 8000
    assert growth_cap(load_config("turbogs", ["density.type=none"]), 50) == 50
    assert growth_cap(load_config("turbogs", ["density.type=gsplat_default"]), 50) == 0


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    return load_scene(tiny_capture(tmp_path_factory.mktemp("pixels")))


class SyntheticTrial:
    """A machine with 1000 Gaussians at the start, on which an iteration takes 10 ms and 5 ms more for each image."""

    gaussians = 1000

    def __init__(self, config, scene, device, ranks) -> None:
        self.configured = config.schedule["pixel_budget"]

    def initialisation(self) -> float:
        return 0.01

    def cost(self, seconds: float) -> IterationCost:
        return IterationCost(self.seconds_with(self.configured, seconds), 0.0)

    def seconds_with(self, pixel_budget: float, seconds: float) -> float:
        return 0.010 + 0.005 * pixel_budget


def planned(scene: Scene, monkeypatch, *overrides: str):
    monkeypatch.setattr(calibration, "_Trial", SyntheticTrial)
    settings = ("schedule.pixel_budget=1", "schedule.max_views=7", "train.iterations=300", "train.epochs=40")
    config = tiny_config(Path("capture"), *settings, *overrides)
    return calibration.within_budget(config.without_plan(), scene, CPU)


@pytest.mark.parametrize(
    ("seconds", "overrides", "pixel_budget", "iterations"),
    [
        (2, (), 1.0, 130),
        (8, (), 3.0, 320),
        (30, (), 7.0, 660),
        (8, ("pixel_sampler.type=dense",), 1.0, 530),
        (8, ("train.epochs=60",), 1.47, 460),  # of 7 views: too few of 300 iterations, so 420 first
    ],
)
def test_a_configuration_for_its_time(scene, monkeypatch, seconds, overrides, pixel_budget, iterations):
    config, measured = planned(scene, monkeypatch, f"budget.time={seconds}s", *overrides)
    assert config.schedule["pixel_budget"] == measured.pixel_budget == pytest.approx(pixel_budget, rel=0.1)
    assert config.train.iterations == pytest.approx(iterations, rel=0.1)
    told = f"with schedule.pixel_budget {measured.pixel_budget:g} instead of 1"
    assert (told in calibration.budget_text(config, measured)) == (pixel_budget > 1.0)


@pytest.mark.parametrize(("seconds", "told"), [(1.0234, "1020 ms"), (0.0013, "1.3 ms"), (0.0156789, "15.7 ms")])
def test_milliseconds_are_told_as_plain_numbers(seconds, told):
    measured = calibration.Calibration(1.0, 0.1, IterationCost(seconds, 0.0), 100, 1.0, 1.0)
    config = load_config("turbogs", ["budget.time=9s"])
    assert f"for one takes {told} with 100 Gaussians" in calibration.budget_text(config, measured)


@pytest.mark.parametrize(("seconds", "longest"), [(30, 1.2), (3600, 5.0), (360_000, 5.0)])
def test_a_long_time_is_not_spent_on_calibration(scene, monkeypatch, seconds, longest):
    asked, cost = [], SyntheticTrial.cost
    monkeypatch.setattr(SyntheticTrial, "cost", lambda trial, share: asked.append(share) or cost(trial, share))
    planned(scene, monkeypatch, f"budget.time={seconds}s")
    assert asked == [pytest.approx(0.5 * longest)]


def test_pixels_and_gaussians_share_the_memory(scene, monkeypatch):
    """A generous time raises lambda as far as the expected Gaussians leave room, and the cap is that of this lambda."""
    monkeypatch.setattr(calibration, "hold_to", lambda limit, device: None)
    config, _ = planned(scene, monkeypatch)
    demand = calibration._memory_demand(config, scene)
    expected = int(EXPECTED_GROWTH * SyntheticTrial.gaussians)
    most = growth_room(config) * expected  # what it has while it grows
    rounding = 1e-3 + demand.per_gaussian / demand.per_image  # the cap is whole Gaussians: lambda gets what is left
    for room, raised in ((1.5, 2.5), (-0.5, 1.0)):
        limit = int(demand.fixed + most * demand.per_gaussian + room * demand.per_image)
        config, _ = planned(scene, monkeypatch, f"budget.max_memory='{limit}'", "budget.time=30s")
        assert config.schedule["pixel_budget"] == pytest.approx(raised, abs=rounding)
        needed = calibration._memory_demand(config, scene)
        cap = config.density["max_gaussians"]
        assert cap == int((limit - needed.fixed) // needed.per_gaussian / growth_room(config))
        assert room < 0 or cap == pytest.approx(expected, rel=0.01)


def test_iterations_are_timed_with_the_lambda_asked_for(scene):
    settings = ("schedule.pixel_budget=1", "schedule.min_views=7", "schedule.max_views=7")
    config = tiny_config(Path("capture"), *settings).without_plan()
    trial = calibration._Trial(config, scene, CPU)
    rates, sampler = [], trial._trainer.pixel_sampler
    draw = sampler.sample
    sampler.sample = lambda maps, view_ids, rate, step: rates.append(rate) or draw(maps, view_ids, rate, step)
    with torch.no_grad():
        trial.cost(0.0)
        assert rates and rates == pytest.approx([1 / 7] * len(rates))
        rates.clear()
        trial.seconds_with(3.5, 0.0)
    assert rates and rates == pytest.approx([0.5] * len(rates))


def test_half_the_model_and_all_of_it_are_of_one_model(scene, monkeypatch):
    """Also where a trainer places one model over the other, as several processes that share memory do."""
    ranks = SimpleNamespace(rank=0, count=2)
    shared = SharedModel(ranks, lambda ranks, size, device: PeerMemory([torch.zeros(size) for _ in range(2)], print))
    monkeypatch.setattr(BaseEngine, "place", lambda engine, gaussians: shared.place(gaussians))
    trial = calibration._Trial(tiny_config(Path("capture")).without_plan(), scene, CPU)
    first = trial._model.map(torch.clone)
    with torch.no_grad():
        trial.cost(0.0)
    for name, value in trial._model.items():
        assert torch.equal(value, getattr(first, name)), name


def test_what_passes_before_the_first_iteration_is_not_planned_with(scene, monkeypatch):
    measured = calibration.Calibration(1.0, 4.0, IterationCost(0.01, 0.0), 50, 1.0, 1.0)
    monkeypatch.setattr(calibration, "calibrate", lambda *arguments: measured)
    config = tiny_config(Path("capture"), "budget.time=10s").without_plan()
    assert calibration.within_budget(config, scene, CPU)[0].train.iterations == 500


def test_the_maps_of_several_processes_are_made_beside_one_another(scene, monkeypatch):
    trial = calibration._Trial(tiny_config(Path("capture")).without_plan(), scene, CPU)
    SimulatedTime(monkeypatch).in_iterations(monkeypatch, lambda trainer: 0.0)
    for count in (1, 2):
        monkeypatch.setattr(trial, "_ranks", SimpleNamespace(count=count, agree=lambda value: value))
        assert trial.initialisation() == pytest.approx(0.01 * math.ceil(len(scene.train) / count))


def test_a_run_with_time_for_more_looks_at_more_pixels(plotted, tmp_path, monkeypatch):
    """It ends with its time after about the configured iterations, and all that a run writes says with which lambda."""
    clock, draw = SimulatedTime(monkeypatch, tick=1e-6), ErrorGuidedPixelSampler.sample

    def drawing(sampler, *arguments):
        samples = draw(sampler, *arguments)
        clock.passes(0.03 * len(samples) / (48 * 40))  # an image
        return samples

    clock.in_iterations(monkeypatch, lambda trainer: 0.04)
    monkeypatch.setattr(ErrorGuidedPixelSampler, "sample", drawing)
    monkeypatch.setattr(calibration, "CALIBRATION_SHARE", 0.3)  # so few iterations take long to measure for otherwise
    overrides = ("budget.time=5s", "density.max_gaussians=300", "schedule.min_views=3", "schedule.max_views=3")
    lengths = ("train.iterations=30", "train.refine_until=20", "train.epochs=4", "schedule.pixel_budget=1")
    outcome = run.train(tiny_config(tiny_capture(tmp_path), *overrides, *lengths), tmp_path / "run", write_report)
    end = outcome.history[-1]
    assert end.train_seconds == pytest.approx(5.0, rel=0.1)
    assert 0.7 * 30 <= end.iteration <= 1.5 * 30
    pixel_budget = outcome.folder.read_config().schedule["pixel_budget"]
    assert 1.5 < pixel_budget <= 3.0
    assert f"pixel_budget: {pixel_budget}" in outcome.folder.report.read_text()
