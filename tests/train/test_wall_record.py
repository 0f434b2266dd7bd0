"""The clock on the wall: from the start of a process until its model is written, over stops and resumes."""

import threading

import pytest
import torch
from helpers.framework_runs import stop_after, tiny_config
from helpers.simulated_time import SimulatedTime

from turbogs_plugin.distributed.ranks import ProcessRanks, Ranks
from turbogs_plugin.errors import InputError, TrainingStopped
from turbogs_plugin.report.run_report import write_report
from turbogs_plugin.train import inputs, run
from turbogs_plugin.train import session as sessions
from turbogs_plugin.train.wall import WallClock, WallRecord

pytestmark = pytest.mark.usefixtures("plotted")


def test_a_run_records_the_wall_until_its_model_and_the_parts_of_its_report(capture, tmp_path, monkeypatch):
    clock = SimulatedTime(monkeypatch, tick=1e-8)
    clock.in_iterations(monkeypatch, lambda trainer: 1.0)
    save, wall = sessions.save_ply, WallClock()
    monkeypatch.setattr(sessions, "save_ply", lambda *model: (clock.passes(10.0), save(*model)))
    clock.passes(1000.0)
    wall.mark("interpreter and imports")
    report = lambda session: (clock.passes(100.0), write_report(session))  # noqa: E731
    session = run.train(tiny_config(capture), tmp_path / "run", report, wall)
    record = WallRecord.read(session.folder.wall)
    assert record.train_seconds == pytest.approx(14.07, abs=1e-3)
    assert record.train_seconds == pytest.approx(session.history[-1].train_seconds)
    assert record.wall_seconds == pytest.approx(1024.07, abs=2e-3)
    expected = {"interpreter and imports": 1000.0, "initial maps": 0.07, "training": 14.0, "model": 10.0, "report": 100}
    assert {name: record.parts[name] for name in expected} == pytest.approx(expected, abs=2e-3)
    assert {"photos", "plan", "initial model", "first evaluation", "evaluations", "checkpoints"} <= set(record.parts)
    assert "| 1024.1 |" in session.folder.report.read_text()


def test_a_model_that_cannot_be_written_stops_the_run(capture, tmp_path, monkeypatch):
    monkeypatch.setattr(sessions, "save_ply", lambda *_: (_ for _ in ()).throw(OSError(28, "No space", "model.ply")))
    with pytest.raises(TrainingStopped, match=r"'model.ply': No space; .* make room; the last .* '.*iteration-000010"):
        run.train(tiny_config(capture), tmp_path / "run", None)
    assert not (tmp_path / "run" / "wall.json").exists()


def test_a_resumed_run_does_not_say_what_several_commands_took(capture, tmp_path, monkeypatch):
    folder = run.RunFolder(tmp_path / "run")
    with monkeypatch.context() as stopping:
        stop_after(stopping, 6)
        first = run.train(tiny_config(capture), folder.path)
    assert first.signal is not None and WallRecord.read(folder.wall).wall_seconds > 0
    assert run.resume(folder.path, write_report).wall.wall_seconds is None
    assert WallRecord.read(folder.wall).wall_seconds is None and "not recorded" in folder.report.read_text()
    whole = run.train(tiny_config(capture), tmp_path / "whole").wall
    assert run.resume(tmp_path / "whole", write_report).wall == whole == WallRecord.read(tmp_path / "whole/wall.json")


def test_the_report_takes_the_last_evaluation(capture, tmp_path, monkeypatch):
    """Views are rendered for its pictures alone; a process that did not evaluate the model does it for the report."""
    rendered = []
    from turbogs_plugin.report import run_report

    evaluate = run_report.evaluate
    monkeypatch.setattr(run_report, "evaluate", lambda *given, **named: rendered.append(1) or evaluate(*given, **named))
    session = run.train(tiny_config(capture, "train.iterations=2"), tmp_path / "run", write_report)
    page = session.folder.report.read_text()
    assert not rendered and f"{session.history[-1].psnr:.2f}" in page
    run.resume(tmp_path / "run", write_report)
    assert rendered == [1] and f"{session.history[-1].psnr:.2f}" in session.folder.report.read_text()


def test_the_device_starts_and_processes_connect_while_photos_are_read(capture, tmp_path, monkeypatch):
    """Each waits for the other: neither would go on if one came after the other. On a CPU nothing is exchanged in the
    thread: gloo would mix it up with what the main thread exchanges meanwhile."""
    together, met, load = threading.Barrier(2, timeout=60), [], inputs.load_scene

    class Noting(Ranks):
        def meet(self, device):
            met.append((device, threading.current_thread() is threading.main_thread()))
            together.wait()

    monkeypatch.setattr(inputs, "load_scene", lambda *a, **b: (together.wait(), load(*a, **b))[1])
    device = torch.device("cpu")
    scene, started = inputs.open_started(tiny_config(capture, "train.device=cpu"), WallClock(), Noting())
    assert len(scene.train) == 7 and started == device and met == [(device, False)]
    ProcessRanks.meet(None, device)  # uses nothing of the processes


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"train_seconds": 1, "walls": 2}'])
def test_a_file_that_is_no_record_is_named(tmp_path, text):
    (tmp_path / "wall.json").write_text(text)
    with pytest.raises(InputError, match=r"wall\.json"):
        WallRecord.read(tmp_path / "wall.json")
