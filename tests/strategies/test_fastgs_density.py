"""Multi-view-consistent density control: votes and events."""

import pytest
import torch
from helpers.bridge_host import make_splats

from turbogs_plugin.strategies.density import fastgs
from turbogs_plugin.strategies.density.fastgs import FastGsDensity
from turbogs_plugin.types import Gaussians, Step

COUNT = 8


@pytest.fixture
def gaussians() -> Gaussians:
    return Gaussians(**{name: value.detach() for name, value in make_splats(COUNT).items()})


def add_batch(
    density: FastGsDensity, errors: list[float], weights: list[float] | None = None, gradient: float = 1.0
) -> None:
    """Fill in what the backward pass of one iteration would."""
    stats = density.stats
    weights = torch.tensor(weights or [1.0] * COUNT)
    stats.weight_sums += weights
    stats.error_sums += torch.tensor(errors) * weights
    stats.grad_sums += gradient * (weights > 0)
    stats.view_counts += weights > 0


def run_batches(density: FastGsDensity, gaussians: Gaussians, batches: list[list[float]], first: int = 1):
    """The updates of iterations `first`, `first` + 1, ... with these errors."""
    updates = []
    for iteration, errors in enumerate(batches, start=first):
        add_batch(density, errors)
        updates.append(density.update(gaussians, Step(iteration, 1000, 500)))
        if updates[-1] is not None:
            density.apply(updates[-1])
    return updates


LOW, HIGH = 0.1, 0.9
OFTEN = [HIGH, LOW, LOW, LOW, LOW, LOW, LOW, LOW]
ONCE = [HIGH, HIGH, LOW, LOW, LOW, LOW, LOW, LOW]


def density_of(gaussians: Gaussians, **settings: int) -> FastGsDensity:
    density = FastGsDensity(**settings)
    density.setup(gaussians)
    return density


@pytest.mark.parametrize(("consistency", "splits"), [(0.5, 1), (0.25, 2)])
def test_only_what_most_batches_mark_is_densified(monkeypatch, gaussians, consistency, splits):
    """Gaussian 0 stands out in all four batches, Gaussian 1 in one, though all gradients are high."""
    monkeypatch.setattr(fastgs, "CONSISTENCY", consistency)
    density = density_of(gaussians, refine_from=4, refine_every=4)
    *before, update = run_batches(density, gaussians, [OFTEN, ONCE, OFTEN, OFTEN])
    assert before == [None, None, None]
    assert update.num_split == splits and update.num_cloned == update.num_pruned == 0
    assert sorted(update.source[update.fresh].tolist()) == sorted(2 * [*range(splits)])
    assert len(density.stats.weight_sums) == 8 + splits and not density.stats.weight_sums.any()


@pytest.mark.parametrize(("error_threshold", "splits"), [(2.9, 2), (3.1, 0)])
def test_a_mark_is_an_error_of_so_many_means(monkeypatch, gaussians, error_threshold, splits):
    """The two Gaussians of `ONCE` that stand out have three times the mean error."""
    monkeypatch.setattr(fastgs, "ERROR_THRESHOLD", error_threshold)
    density = density_of(gaussians, refine_from=2, refine_every=2)
    update = run_batches(density, gaussians, [ONCE, ONCE])[-1]
    assert (0 if update is None else update.num_split) == splits


def test_batches_that_did_not_see_it_do_not_count(gaussians):
    density = density_of(gaussians, refine_from=4, refine_every=4)
    unseen = [0.0] + [1.0] * (COUNT - 1)
    for iteration in range(1, 5):
        add_batch(density, OFTEN, None if iteration == 1 else unseen)
        update = density.update(gaussians, Step(iteration, 1000, 500))
    assert update.num_split == 1


def test_a_low_gradient_is_not_densified(gaussians):
    density = density_of(gaussians, refine_from=1, refine_every=1)
    add_batch(density, OFTEN, gradient=1e-6)
    assert density.update(gaussians, Step(1, 1000, 500)) is None


@pytest.mark.parametrize("second", [OFTEN, [0.01, 0.09, *[0.01] * (COUNT - 2)]])
def test_after_densification_the_most_blamed_go(gaussians, second):
    """Blame counts by the error of its batch: Gaussian 1 stands out in batches of small errors alone."""
    density = density_of(gaussians, refine_every=1)
    updates = run_batches(density, gaussians, [OFTEN, *[second] * 5], first=501)
    assert updates[:5] == [None] * 5
    assert updates[5].source.tolist() == list(range(1, COUNT))
    assert updates[5].num_pruned == 1 and not updates[5].fresh.any()


def test_an_event_that_changes_nothing_begins_a_new_window_too(gaussians):
    density = density_of(gaussians, refine_from=2, refine_every=2)
    assert run_batches(density, gaussians, [[LOW] * COUNT] * 2) == [None, None]
    assert not any(value.any() for part in density.state_dict().values() for value in part.values())


def test_a_resumed_window_goes_on_exactly(gaussians):
    straight, first, second = (density_of(gaussians, refine_from=4, refine_every=4) for _ in range(3))
    expected = run_batches(straight, gaussians, [OFTEN, ONCE, OFTEN, OFTEN])[-1]
    run_batches(first, gaussians, [OFTEN, ONCE])
    second.load_state_dict(first.state_dict())
    actual = run_batches(second, gaussians, [OFTEN, OFTEN], first=3)[-1]
    assert torch.equal(actual.source, expected.source)
    assert torch.equal(actual.values["means"], expected.values["means"])
