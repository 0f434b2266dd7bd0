"""A launcher that is killed outright, as by the kernel when memory is short: nothing that it started goes on."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.framework_runs import ENDLESS, TINY
from helpers.processes import comes_true

from turbogs_plugin.train.checkpoint import latest_checkpoint, load_checkpoint

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="by a call of Linux")

SECONDS = 60.0
"""Far more than anything here takes."""


def state(process: int) -> tuple[str, int]:
    """(letter, parent) of a process; X where there is none. One that ended and was not yet waited for is a Z."""
    try:
        words = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return "X", 0
    return words[0], int(words[1])


def running(processes: list[int]) -> list[int]:
    return [process for process in processes if state(process)[0] not in "XZ"]


def started_by(process: int) -> list[int]:
    return sorted(int(path.name) for path in Path("/proc").glob("[0-9]*") if state(int(path.name))[1] == process)


def left_after_its_kill(words: list[str], folder: Path, working: Callable[[], bool]) -> list[int]:
    """Start a command, and kill it alone as soon as its processes are `working`: which of them stay.

    One of them hangs then, as in a call of a GPU, and hears nothing but SIGKILL; in a training the other waits for it.
    """
    with (folder / "told").open("w") as told:
        command = [sys.executable, "-m", "turbogs_plugin", *words]
        launcher = subprocess.Popen(command, stdout=told, stderr=told, start_new_session=True)
    processes: list[int] = []
    try:
        assert comes_true(lambda: working() or launcher.poll() is not None, SECONDS), "it does not begin"
        processes = started_by(launcher.pid)
        assert launcher.poll() is None and len(processes) >= 2, (folder / "told").read_text()
        os.kill(processes[-1], signal.SIGSTOP)
        launcher.kill()
        launcher.wait()
        comes_true(lambda: not running(processes), SECONDS)
        return running(processes)
    finally:
        launcher.kill()
        launcher.wait()
        for process in running(processes):
            os.kill(process, signal.SIGKILL)


def test_processes_of_a_training_end_with_their_launcher(capture, tmp_path):
    checkpoints = tmp_path / "run/checkpoints"
    words = ["train", str(capture), "--out", str(tmp_path / "run"), "--gpus", "2", "--device", "cpu", "--no-report"]
    words += [*TINY, *ENDLESS]
    assert not left_after_its_kill(words, tmp_path, lambda: latest_checkpoint(checkpoints) is not None)
    newest = latest_checkpoint(checkpoints)
    iteration = load_checkpoint(newest)["trainer"]["iteration"]
    assert iteration >= 3 and newest.name == f"iteration-{iteration:06d}.pt"
