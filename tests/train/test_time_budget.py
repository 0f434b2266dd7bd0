"""Whole runs within budgets."""

import os
import signal
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.framework_runs import stop_after, tiny_config
from helpers.refusals import assert_refused
from helpers.simulated_time import SimulatedTime

from turbogs_plugin.captures import load_scene
from turbogs_plugin.config.scaling import with_iterations
from turbogs_plugin.config.sections import TrainConfig
from turbogs_plugin.train import pace as pacing
from turbogs_plugin.train import run, session
from turbogs_plugin.train.checkpoint import latest_checkpoint, load_checkpoint
from turbogs_plugin.train.history import read_history
from turbogs_plugin.train.loop import Listener
from turbogs_plugin.train.saved_model import load_model
from turbogs_plugin.train.trainer import Trainer

pytestmark = pytest.mark.usefixtures("plotted")


def growing(trainer: Trainer) -> float:
    """Seconds of an iteration on a machine that is the slower the larger the model."""
    return 0.1 + 3e-4 * len(trainer.gaussians)


def test_a_time_budget_holds(turbogs, capture, tmp_path, monkeypatch):
    """Within a tenth, with a schedule that completes and a model that has learned."""
    clock = SimulatedTime(monkeypatch, tick=1e-6)
    clock.in_iterations(monkeypatch, growing)
    out = tmp_path / "run"
    options = ["--config", "demo", "--out", out, "--device", "cpu", "--time-budget", "6s", "train.evaluate_at=[0.5]"]
    began = clock.now
    code, _, error = turbogs("train", capture, *options)
    assert code == 0, error
    start, middle, end = read_history(out / "history.jsonl")
    assert end.train_seconds == pytest.approx(6.0, rel=0.1)
    assert end.train_seconds == pytest.approx(clock.now - began, abs=0.01)  # iterations that were timed before count
    assert 2.7 <= middle.train_seconds <= 4.2
    assert end.psnr > start.psnr + 3.0 and end.num_gaussians > start.num_gaussians
    state = load_checkpoint(latest_checkpoint(out / "checkpoints"))
    assert state["trainer"]["iteration"] == state["pace"]["iterations"] == end.iteration
    assert state["pace"]["refine_until"] < end.iteration
    assert (out / "report.md").is_file() and "6 s of training: about" in error
    assert turbogs("train", "--resume", out)[1] == f"{out} is finished: its model is {out / 'model.ply'}\n"


def test_settings_that_count_iterations_are_scaled_to_the_time(capture, tmp_path, monkeypatch):
    """By iterations that are timed beforehand, which change neither the model nor what is drawn."""
    SimulatedTime(monkeypatch, tick=1e-9).in_iterations(monkeypatch, lambda trainer: 0.1)
    lengths = ("budget.time=10.05s", "train.iterations=1000", "train.refine_until=700")
    config = tiny_config(capture, *lengths).without_plan()
    scene, device = load_scene(capture), torch.device("cpu")
    fitted, seconds = pacing.fitted_to_time(config, scene, device)
    assert seconds == pytest.approx(0.4, abs=1e-3) and (fitted.train.iterations, fitted.train.refine_until) == (96, 67)
    assert fitted == with_iterations(config, 96)
    assert pacing.fitted_to_time(tiny_config(capture).without_plan(), scene, device)[1] == 0.0


def test_a_run_by_time_goes_on_after_a_stop(capture, tmp_path, monkeypatch):
    """The clock goes on as well: stopped and resumed, it ends with its time, and evaluates nothing twice."""
    clock = SimulatedTime(monkeypatch, tick=1e-6)
    clock.in_iterations(monkeypatch, growing)
    began, step = clock.now, Trainer.step

    def stopping(trainer):
        step(trainer)
        if trainer.iteration == 16 and trainer.config.density["type"] != "none":  # not those that are timed before
            os.kill(os.getpid(), signal.SIGINT)

    config = tiny_config(capture, "budget.time=4s", "density.max_gaussians=2000", "train.evaluate_at=[0.3, 0.6]")
    monkeypatch.setattr(Trainer, "step", stopping)
    first = run.train(config, tmp_path / "run")
    assert first.signal == signal.SIGINT
    pace, lengths = load_checkpoint(latest_checkpoint(tmp_path / "run" / "checkpoints"))["pace"], []

    def recording(trainer):
        lengths.append((trainer.now.total, trainer.now.refine_until))
        step(trainer)

    monkeypatch.setattr(Trainer, "step", recording)
    second = run.resume(tmp_path / "run")
    assert second.signal is None
    assert lengths[0] == (pace["iterations"], pace["refine_until"])  # as it was fitted before the stop
    assert lengths[0][0] != first.trainer.config.train.iterations
    assert second.history[-1].train_seconds == pytest.approx(4.0, rel=0.1)
    assert second.history[-1].train_seconds == pytest.approx(clock.now - began, abs=0.01)
    iterations = [entry.iteration for entry in second.history]
    assert len(iterations) == 4 and iterations == sorted(set(iterations))


@pytest.mark.parametrize("cap", [50, 120])
def test_a_cap_holds_for_the_finished_model(capture, tmp_path, cap):
    """By the initial model, too, where the capture has more points than that; and what stops growth is the room that
    the cap and the final prunings leave, which the larger cap's run fills."""
    points, most, counts = len(load_scene(capture).points), int(cap / 0.95**2), []

    class Counting(Listener):
        def begun(self, loop):
            counts.append(len(loop.trainer.gaussians))

        advanced = begun

    config = tiny_config(capture, f"density.max_gaussians={cap}", "train.camera_clearance=false")
    outcome = run.train(config, tmp_path / "run", watch=[lambda session: Counting()])
    assert counts[0] == min(points, cap)
    assert cap <= max(counts) <= most != points and (max(counts) == most or cap < points)
    assert outcome.history[-1].num_gaussians == counts[-1] <= cap
    assert load_model(tmp_path / "run", torch.device("cpu")).config.density["max_gaussians"] == cap


@pytest.fixture
def stopped(capture, tmp_path, monkeypatch) -> Path:
    """The folder of a run with a checkpoint of its fifth iteration."""
    with monkeypatch.context() as context:
        stop_after(context, 5)
        run.train(tiny_config(capture), tmp_path / "run")
    return tmp_path / "run"


@pytest.mark.parametrize("place", [(Trainer, "__init__"), (Trainer, "load_state_dict"), (session, "place_views")])
def test_a_capture_that_does_not_fit_is_refused(capture, stopped, tmp_path, monkeypatch, place):
    def full(*arguments, **options):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(*place, full)
    assert_refused(r"'capture' does not fit .*: use train\.pixels_place=host", run.resume, stopped)
    if place[1] != "load_state_dict":
        assert_refused(r"does not fit into the device's memory", run.train, tiny_config(capture), tmp_path / "new")
        assert not (tmp_path / "new").exists()


def test_a_resumed_run_is_held_to_its_memory(stopped, monkeypatch):
    """Before anything of it is on the device."""
    limited = run.RunFolder(stopped).read_config().changed(budget={"max_memory": "2GiB"})
    (stopped / "config.yaml").write_text(limited.to_yaml())
    held, build = [], Trainer.__init__

    def building(trainer, *arguments, **options):
        assert held == [2**31]
        build(trainer, *arguments, **options)

    monkeypatch.setattr(run, "hold_to_limit", lambda config, device: held.append(config.budget.memory_bytes()))
    monkeypatch.setattr(Trainer, "__init__", building)
    assert run.resume(stopped).signal is None


@pytest.mark.parametrize("every", [0, 1, 4, 5, 10, 11])
def test_stops_by_iterations_evaluate_and_save_where_asked(every):
    train = TrainConfig(iterations=10, evaluate_at=(0.01, 0.3, 0.5), checkpoint_every=every)
    pace, iteration, dues = pacing.Pace(train), 0, {}
    while iteration < pace.iterations:
        iteration = pace.next_mark(iteration, 0.0)
        dues[iteration] = pace.reached(iteration, 0.0)
    saves = {*range(every, 10, every), 10} if every else {10}
    assert {iteration for iteration, due in dues.items() if due[1]} == saves
    assert {iteration for iteration, due in dues.items() if due[0]} == {1, 3, 5, 10}
    assert dues.keys() == saves | {1, 3, 5, 10}


@pytest.mark.parametrize("cost", [0.002, 0.4, 30.0, 150.0])
def test_at_most_five_minutes_are_at_risk(cost):
    """Where iterations become slower, fourfold over the run, and after a resume."""
    pace = pacing.Pace(TrainConfig(iterations=1000, evaluate_at=(), checkpoint_every=10_000))
    iteration, seconds, saved = 0, 5000.0, [5000.0]
    for _ in range(10_000):
        mark = pace.next_mark(iteration, seconds)
        seconds += cost * sum(1.0 + 3.0 * step / 1000 for step in range(iteration, mark))
        iteration = mark
        saved += [seconds] if pace.reached(iteration, seconds)[1] else []
        if iteration == pace.iterations:
            break
    assert iteration == 1000 and np.diff(saved).max() <= max(300.0, 4.0 * cost)
    assert len(saved) <= 2 + (seconds - 5000.0) / pacing.SAVE_AFTER


def test_stops_by_time_evaluate_once_a_fraction_and_save_at_intervals():
    train = TrainConfig(iterations=100, refine_until=70, evaluate_at=(0.25, 0.5), checkpoint_every=40)
    pace = pacing.Pace(train, 10.0)
    iteration, seconds, dues = 0, 0.0, []
    while iteration < pace.iterations:
        mark = pace.next_mark(iteration, seconds)
        seconds += 0.05 * (mark - iteration)  # twice as fast as planned
        iteration = mark
        dues.append((iteration, seconds, pace.reached(iteration, seconds)))
    evaluated = [seconds for _, seconds, due in dues if due[0]]
    assert evaluated == pytest.approx([2.5, 5.0, 10.0], abs=0.31)
    saved = [iteration for iteration, _, due in dues if due[1]]
    assert len(saved) == 200 // 40 and saved[-1] == pace.iterations == pytest.approx(200, abs=2)
    assert pace.refine_until == pytest.approx(140, abs=3)
    assert (train.iterations, train.refine_until) == (100, 70), "the configuration stays what was resolved"
