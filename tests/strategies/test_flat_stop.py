"""Densification that ends once the error no longer falls: `ErrorDrivenDensity.stop_when_flat`."""

import math

import pytest
import torch
from helpers.framework_runs import tiny_capture, tiny_config
from helpers.optimizers import make_gaussians
from turbogs_plugin.strategies.density.error_driven import FLAT_EVENTS, ErrorDrivenDensity

from turbogs_plugin.errors import InputError
from turbogs_plugin.scene import load_scene
from turbogs_plugin.train.checkpoint import require_like
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import Step

EVERY, UNTIL, TOTAL = 10, 400, 500


def run(
    errors, stop: float, start: ErrorDrivenDensity | None = None, first: int = 0, **options
) -> tuple[list[int], ErrorDrivenDensity]:
    """Events of a run whose windows have mean errors ``errors(event)``; two Gaussians of unequal weight."""
    gaussians = make_gaussians(2)
    options = {"refine_from": EVERY, "refine_every": EVERY, "final_keep": 1.0, "opacity_decay": 0.01, **options}
    density = start or ErrorDrivenDensity(stop_when_flat=stop, **options)
    if start is None:
        density.setup(gaussians)
    events = []
    for iteration in range(first, TOTAL):
        if density.stats is not None and iteration % EVERY == 0 and iteration:
            error = errors(iteration // EVERY)
            density.stats.weight_sums[:] = torch.tensor([1.0, 3.0])
            density.stats.error_sums[:] = torch.tensor([0.4, 3.6]) * error  # of mean 1 by the weights
        update = density.update(gaussians, Step(iteration, TOTAL, UNTIL))
        if update is not None:
            events.append(iteration)
    return events, density


def falling(event: int) -> float:
    return 0.5 * math.exp(-0.05 * event)


def settling(event: int) -> float:
    """Falls by 5 % an event until event 20, then stays."""
    return falling(min(event, 20))


def test_an_error_that_falls_lets_density_control_go_on():
    events, density = run(falling, 0.1)
    assert events == list(range(EVERY, UNTIL + 1, EVERY)) and density.stopped_at == 0


@pytest.mark.parametrize(
    ("stop", "last"),
    [
        # Over the last 5 events the error has fallen by 1 - exp(-0.05 (5 - n)), n events after the 20th.
        (0.20, 21),  # exp(-0.20) = .819: fallen by .181 < .20 at the 21st
        (0.10, 23),  # exp(-0.10) = .905: .095 at the 23rd
        (0.001, 25),  # no fall at all
    ],
)
def test_it_ends_where_the_fall_is_less_than_asked_for(stop, last):
    events, density = run(settling, stop)
    assert density.stopped_at == last * EVERY
    assert events == list(range(EVERY, last * EVERY, EVERY))
    assert density.stats is None, "nothing needs statistics any more"


def test_it_never_ends_before_there_is_a_record():
    events, density = run(lambda event: 0.3, 0.5)
    assert len(events) == FLAT_EVENTS and density.stopped_at == (FLAT_EVENTS + 1) * EVERY


def test_a_rising_error_is_no_fall_and_off_is_off():
    assert run(lambda event: 0.1 * event, 0.01)[1].stopped_at == (FLAT_EVENTS + 1) * EVERY
    events, density = run(lambda event: 0.3, 0.0)
    assert len(events) == UNTIL // EVERY and density.stopped_at == 0 and density.window_errors == []


def test_non_finite_statistics_have_no_part():
    def spoiled(event: int) -> float:
        return math.inf if event % 3 == 0 else falling(event)

    _, density = run(spoiled, 0.1)
    assert density.stopped_at == 0 and min(density.window_errors) > 0


def test_final_pruning_goes_on_after_an_early_end():
    _, density = run(lambda event: 0.3, 0.1, final_keep=0.9, final_every=20)
    assert density.stopped_at and density.stats is None  # taken until the last pruning, which is before the run's end
    stopped = ErrorDrivenDensity(stop_when_flat=0.1, final_keep=0.9, final_every=20, refine_every=EVERY)
    stopped.stopped_at = 100
    assert stopped.due(Step(UNTIL + 20, TOTAL, UNTIL)) == (False, True)
    assert stopped._last_event(Step(0, TOTAL, UNTIL)) == 480


@pytest.mark.parametrize("resume_at", [105, 205, 215, 300])
def test_a_resumed_record_is_the_same(resume_at):
    whole, _ = run(settling, 0.2)
    gaussians = make_gaussians(2)
    options = {"refine_from": EVERY, "refine_every": EVERY, "final_keep": 1.0, "opacity_decay": 0.01}
    first = ErrorDrivenDensity(stop_when_flat=0.2, **options)
    first.setup(gaussians)
    events = []
    for iteration in range(resume_at):
        if first.stats is not None and iteration % EVERY == 0 and iteration:
            first.stats.weight_sums[:] = 1.0
            first.stats.error_sums[:] = settling(iteration // EVERY)
        if first.update(gaussians, Step(iteration, TOTAL, UNTIL)) is not None:
            events.append(iteration)
    second = ErrorDrivenDensity(stop_when_flat=0.2, **options)
    second.setup(gaussians)
    require_like(first.state_dict(), second.state_dict(), "density")
    second.load_state_dict(first.state_dict())
    rest, second = run(settling, 0.2, start=second, first=resume_at)
    assert events + rest == whole and second.stopped_at == 210


@pytest.mark.parametrize("value", [-0.1, 1.0])
def test_a_share_out_of_range_is_refused(value):
    with pytest.raises(InputError, match="stop_when_flat"):
        ErrorDrivenDensity(stop_when_flat=value)


def test_a_run_that_stops_early_has_fewer_gaussians(tmp_path):
    capture = tiny_capture(tmp_path)
    scene = load_scene(capture)
    counts = []
    for stop in (0.0, 0.99):
        overrides = ("train.iterations=24", "train.refine_until=24", "density.refine_every=2", "density.final_keep=1")
        config = tiny_config(capture, *overrides, f"density.stop_when_flat={stop}").without_plan()
        trainer = Trainer(config, scene, torch.device("cpu"))
        trainer.initialise_maps()
        while trainer.iteration < 15:
            trainer.step()
        counts.append(len(trainer.gaussians))
        assert bool(trainer.density.stopped_at) == (stop > 0)
    assert counts[1] < counts[0]
