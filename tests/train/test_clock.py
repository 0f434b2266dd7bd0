"""The clock on the wall: from the start of a process until its model is written, over stops and resumes."""

import math
import os
import threading
import time
from pathlib import Path

import pytest
import torch
from helpers.framework_runs import stop_after, tiny_config
from helpers.simulated_time import SimulatedTime

from turbogs_plugin.distributed.ranks import ProcessRanks, Ranks
from turbogs_plugin.errors import InputError, TrainingStopped
from turbogs_plugin.report.run_report import write_report
from turbogs_plugin.train import clock as clocks
from turbogs_plugin.train import inputs, run
from turbogs_plugin.train import session as sessions
from turbogs_plugin.train.clock import WallClock, WallRecord, process_age

pytestmark = pytest.mark.usefixtures("plotted")


def test_a_process_is_as_old_as_the_system_says(monkeypatch):
    """Its start in ticks since boot, behind a name with brackets and spaces in it; the import's time elsewhere."""
    clock = SimulatedTime(monkeypatch)
    monkeypatch.setattr(clocks, "_IMPORTED", clock.now)
    fields = " ".join(["S", *(["0"] * 18), str(3 * os.sysconf("SC_CLK_TCK")), "0"])  # the 3rd to the 23rd
    monkeypatch.setattr(Path, "read_text", lambda *_, **__: f"12 (a) b) {fields}")
    monkeypatch.setattr(time, "clock_gettime", lambda _: 10.0)
    clock.passes(2.0)
    assert process_age() == 7.0
    monkeypatch.setattr(time, "clock_gettime", lambda _: 4.0)  # younger than its imports
    assert process_age() == 2.0
    monkeypatch.setattr(time, "clock_gettime", lambda _: 1e6)
    assert process_age() == 2.0
    monkeypatch.setattr(Path, "read_text", lambda *_, **__: "nonsense")
    assert process_age() == 2.0


def test_parts_are_the_times_between_marks(monkeypatch):
    clock = SimulatedTime(monkeypatch)
    wall_clock = WallClock(age=4.0)
    for part, seconds in (("imports", 0.0), ("training", 2.0), ("evaluations", 1.0), ("training", 3.0)):
        clock.passes(seconds)
        wall_clock.mark(part)
    assert wall_clock.parts == {"imports": 4.0, "training": 5.0, "evaluations": 1.0}
    assert wall_clock.seconds == 10.0


@pytest.mark.parametrize("seconds", [9.125, math.nan])
def test_a_record_is_read_as_it_was_written(tmp_path, seconds):
    record = WallRecord(5.25, seconds, {"photos": 0.5})
    record.write(tmp_path / "wall.json")
    assert repr(WallRecord.read(tmp_path / "wall.json")) == repr(record)
    assert ("on the wall" in record.text()) == (seconds == seconds) and "trained 5.2 s" in record.text()
    assert WallRecord.read(tmp_path / "absent.json") is None


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"train_seconds": 1, "wall_seconds": "x", "parts": {}}'])
def test_a_file_that_is_no_record_is_named(tmp_path, text):
    (tmp_path / "wall.json").write_text(text)
    with pytest.raises(InputError, match=r"wall\.json"):
        WallRecord.read(tmp_path / "wall.json")


def test_a_run_records_the_wall_until_its_model_and_the_parts_of_its_report(capture, tmp_path, monkeypatch):
    clock = SimulatedTime(monkeypatch, tick=1e-8)
    clock.in_iterations(monkeypatch, lambda trainer: 1.0)
    save, report_at = sessions.save_ply, []

    def saving(*arguments) -> None:
        clock.passes(10.0)
        save(*arguments)

    def reporting(session: sessions.RunSession) -> None:
        session.finish_model()  # or the simulated seconds of two threads would mix
        report_at.append(session.clock.seconds)
        clock.passes(100.0)
        write_report(session)

    monkeypatch.setattr(sessions, "save_ply", saving)
    session = run.train(tiny_config(capture), tmp_path / "run", reporting, WallClock(age=1000.0))
    record = WallRecord.read(session.folder.wall)
    assert record.train_seconds == pytest.approx(14.07, abs=1e-3)
    assert record.train_seconds == pytest.approx(session.history[-1].train_seconds)
    assert record.wall_seconds == pytest.approx(1024.07, abs=2e-3) == pytest.approx(report_at[0], abs=2e-3)
    parts = record.parts
    expected = {
        "interpreter and imports": 1000.0,
        "initial maps": 0.07,
        "training": 14.0,
        sessions.MODEL: 10.0,
        "report": 100.0,
    }
    assert {name: parts[name] for name in expected} == pytest.approx(expected, abs=2e-3)
    assert {"photos", "plan", "initial model", "first evaluation", "evaluations", "checkpoints"} <= set(parts)
    assert "| 1024.1 |" in session.folder.report.read_text()


def test_checkpoint_and_model_are_written_while_the_report_is_made(capture, tmp_path, monkeypatch):
    reporting, together = threading.Event(), []

    def late(write):
        def wait_and_write(*arguments) -> object:
            together.append(reporting.wait(20.0))
            return write(*arguments)

        return wait_and_write

    for name in ("save_ply", "save_checkpoint"):
        monkeypatch.setattr(sessions, name, late(getattr(sessions, name)))
    session = run.train(tiny_config(capture, "train.checkpoint_every=0"), tmp_path / "run", lambda _: reporting.set())
    assert together == [True, True] and session.folder.model.is_file()
    assert run.latest_checkpoint(session.folder.checkpoints) is not None


def test_a_model_that_cannot_be_written_stops_the_run(capture, tmp_path, monkeypatch):
    monkeypatch.setattr(sessions, "save_ply", lambda *_: (_ for _ in ()).throw(TrainingStopped("the disk is full")))
    with pytest.raises(TrainingStopped, match=r"the disk is full; the last good checkpoint is '.*iteration-000014"):
        run.train(tiny_config(capture), tmp_path / "run", None)
    assert not (tmp_path / "run" / "wall.json").exists()


def test_a_resumed_run_adds_its_processes_and_a_killed_one_is_not_forgotten(capture, tmp_path, monkeypatch):
    clock = SimulatedTime(monkeypatch, tick=1e-8)
    clock.in_iterations(monkeypatch, lambda trainer: 1.0)
    folder = run.RunFolder(tmp_path / "run")
    with monkeypatch.context() as stopping:
        stop_after(stopping, 6)
        first = run.train(tiny_config(capture), folder.path, None, WallClock(100.0))
    assert first.signal is not None and WallRecord.read(folder.wall).wall_seconds == pytest.approx(106.07, abs=2e-3)
    with monkeypatch.context() as killing:
        killing.setattr(run.TrainingLoop, "run", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        kept = folder.wall.read_text()
        with pytest.raises(KeyboardInterrupt):
            run.resume(folder.path, None, WallClock(100.0))
        assert not folder.wall.exists()
    folder.wall.write_text(kept)  # as if it had not been started
    second = run.resume(folder.path, None, WallClock(100.0))
    assert second.wall.wall_seconds == pytest.approx(106.07 + 100.0 + 8.0, abs=4e-3)
    third = run.resume(folder.path, write_report, WallClock(100.0))  # finished before: only its report is new
    assert third.wall.wall_seconds == pytest.approx(second.wall.wall_seconds, abs=2e-3)
    folder.wall.unlink()
    assert math.isnan(run.resume(folder.path, write_report, WallClock(100.0)).wall.wall_seconds)
    assert "not recorded" in folder.report.read_text()


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


def test_cuda_that_is_absent_is_named_before_photos_are_read(capture, tmp_path, monkeypatch):
    monkeypatch.setattr(run.torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(inputs, "load_and_find", lambda *_, **__: pytest.fail("photos were read"))
    with pytest.raises(InputError, match="CUDA was asked for and is absent"):
        run.train(tiny_config(capture, "train.device=cuda"), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_the_device_starts_while_photos_are_read(capture, tmp_path, monkeypatch):
    """Each waits for the other: neither would go on if one came after the other."""
    import threading

    meet = threading.Barrier(2, timeout=60)
    resolve, load = run.resolve_device, inputs.load_and_find
    monkeypatch.setattr(run, "resolve_device", lambda *arguments: (meet.wait(), resolve(*arguments))[1])
    monkeypatch.setattr(inputs, "load_and_find", lambda *a, **b: (meet.wait(), load(*a, **b))[1])
    assert run.train(tiny_config(capture, "train.iterations=1"), tmp_path / "run").wall.train_seconds > 0


def test_processes_connect_their_gpus_beside_the_photos():
    """In the thread that starts the device. On a CPU nothing is exchanged there: gloo would mix it up with what the
    main thread exchanges meanwhile."""
    met = []

    class Noting(Ranks):
        def meet(self, device):
            met.append((device, threading.current_thread() is threading.main_thread()))

    device = torch.device("cpu")
    with inputs.starting(lambda: device, Noting()) as started:
        assert started.result() == device
    assert met == [(device, False)]
    ProcessRanks.meet(None, device)  # uses nothing of the processes
