"""One owner of a run's folder, and files that are written there whatever links lie there."""

import os
import signal
import socket
import subprocess
import sys

import numpy as np
import pytest
import torch
from helpers.framework_runs import tiny_config
from helpers.refusals import assert_refused

from turbogs_plugin.errors import InputError, TrainingStopped
from turbogs_plugin.files import write_text_atomically
from turbogs_plugin.report.curves import plot_against_seconds
from turbogs_plugin.report.images import save_image
from turbogs_plugin.train import run
from turbogs_plugin.train.history import Evaluation, append_evaluation, read_history
from turbogs_plugin.train.run_files import RunFolder
from turbogs_plugin.train.trainer import Trainer

HOLDING = """
import sys, time
from pathlib import Path
from turbogs_plugin.train.run_files import RunFolder
with RunFolder(Path(sys.argv[1])).owned(new=True):
    print("held", flush=True)
    time.sleep(100)
"""


@pytest.fixture
def holder(tmp_path):
    """A process that writes to the run `tmp_path / "run"`."""
    words = [sys.executable, "-c", HOLDING, tmp_path / "run"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "held\n"
        yield other
        other.kill()


def test_a_folder_has_one_owner_and_a_dead_one_has_none(holder, tmp_path, capsys):
    folder = RunFolder(tmp_path / "run")
    for new in (False, True):
        with pytest.raises(InputError, match=f"process {holder.pid} of .* writes to .*: wait"), folder.owned(new):
            pytest.fail("two own it")
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    with folder.owned(new=True):
        assert f"process {holder.pid} of " in capsys.readouterr().err
    with folder.owned():  # left by its owner
        assert not capsys.readouterr().err
    assert [file.name for file in folder.path.iterdir()] == [folder.lock.name]


def test_a_run_and_its_resume_are_refused_while_another_writes(holder, capture, tmp_path, monkeypatch):
    folder = RunFolder(tmp_path / "run")
    monkeypatch.setattr(RunFolder, "require_new", lambda folder, overwrite: None)  # both began at once
    config = tiny_config(capture, "train.iterations=2")
    assert_refused("writes to", run.train, config, folder.path)
    folder.config.write_text(config.without_plan().to_yaml())
    before = sorted(folder.path.iterdir())
    assert_refused("writes to", run.resume, folder.path)
    assert sorted(folder.path.iterdir()) == before


def test_a_new_folder_that_another_has_written_to_and_a_lock_that_is_a_link_are_refused(tmp_path):
    folder, victim = RunFolder(tmp_path), tmp_path / "victim"
    victim.write_text("mine")
    with pytest.raises(InputError, match="not empty"), folder.owned(new=True):
        pytest.fail("two own it")
    folder.lock.unlink(missing_ok=True)
    folder.renders.mkdir()
    for place in (folder.lock, folder.checkpoints, folder.renders / "test", folder.report.with_suffix("")):
        place.symlink_to(victim)
        with pytest.raises(InputError, match="is a link: remove it"), folder.owned():
            pytest.fail("it was followed")
        place.unlink()
    assert victim.read_text() == "mine"


def test_a_run_that_ends_before_its_first_checkpoint_does_not_claim_its_folder(capture, tmp_path, monkeypatch):
    folder, config = RunFolder(tmp_path / "run"), tiny_config(capture, "train.iterations=2", "train.evaluate_at=[]")
    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "step", lambda trainer: (_ for _ in ()).throw(torch.cuda.OutOfMemoryError))
        words = r"too small for \d+ Gaussians; try --max-gaussians \d+; no checkpoint"
        with pytest.raises(TrainingStopped, match=words):
            run.train(config, folder.path)
    run.train(config, folder.path)
    assert [line.iteration for line in read_history(folder.history)] == [0, 2]
    assert_refused("is not empty: choose a new folder", run.train, config, folder.path)


@pytest.mark.parametrize(("error", "killed"), [(InputError("bad"), False), (IndexError("bad"), True)])
def test_an_overwritten_run_comes_back_where_the_new_one_fails(capture, tmp_path, monkeypatch, error, killed):
    """And goes where the new one is finished, be it after a stop. Nothing but a run is overwritten. A call that was
    killed has left the older run aside: only --overwrite goes on from there."""
    folder, config = RunFolder(tmp_path / "run"), tiny_config(capture, "train.iterations=2", "train.evaluate_at=[]")
    run.train(config, folder.path)
    before = {path.name: path.stat().st_ino for path in folder.path.iterdir()}
    if killed:
        (folder.path / ".replaced").touch()
        folder.path.rename(folder.aside)
        assert_refused(str(folder.aside), run.train, config, folder.path)
    with monkeypatch.context() as patch, pytest.raises(type(error), match="bad"):
        patch.setattr(Trainer, "step", lambda trainer: (_ for _ in ()).throw(error))
        run.train(config, folder.path, overwrite=True)
    assert {path.name: path.stat().st_ino for path in folder.path.iterdir()} == before and not folder.aside.exists()
    for other in (folder.path / "notes.txt", folder.aside):
        other.touch()
        assert_refused(str(other), run.train, config, folder.path, overwrite=True)
        other.unlink()
    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "step", lambda each, step=Trainer.step: (signal.raise_signal(signal.SIGINT), step(each)))
        run.train(config.changed(train={"seed": 5}), folder.path, overwrite=True)
    assert folder.older() and RunFolder(folder.aside).finished(reported=False)
    run.resume(folder.path)
    assert folder.read_config().train.seed == 5 and not folder.aside.exists()


WRITERS = {
    "text": lambda path: write_text_atomically(path, "new"),
    "picture.png": lambda path: save_image(path, np.zeros((4, 4, 3), np.uint8)),
    "plot.png": lambda path: plot_against_seconds(path, [0.0, 1.0], [1.0, 2.0], "label", "title"),
    "history": lambda path: append_evaluation(path, Evaluation(0, 0.0, 20.0, 0.8, 0.1, 5)),
}


@pytest.mark.parametrize("name", WRITERS)
def test_no_link_is_followed(tmp_path, name):
    """Neither one in the place of the file, nor one with a name that the partial file might have."""
    victim, file = tmp_path / "victim", tmp_path / "run" / name
    victim.write_text("mine")
    file.parent.mkdir()
    file.symlink_to(victim)
    (file.parent / f".{name}.{socket.gethostname()}.{os.getpid()}.part").symlink_to(victim)
    if name == "history":
        with pytest.raises(OSError, match="symbolic"):
            WRITERS[name](file)
    else:
        WRITERS[name](file)
        assert not file.is_symlink() and file.stat().st_size
    assert victim.read_text() == "mine"
