"""`turbogs bench wall`: where each second of `turbogs train` goes, by the marks that the command keeps."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from turbogs_plugin.errors import InputError, TrainingStopped
from turbogs_plugin.train.run_files import RunFolder
from turbogs_plugin.train.wall import WallRecord

REST = "start of the process, and its end"
"""What a process cannot measure of itself."""


@dataclass
class WallRun:
    """One run of the command."""

    seconds: float  # from its start to its end, seen from outside
    train_seconds: float  # training, as the run's history has it
    model_seconds: float  # from the start of its command until the model was written
    parts: dict[str, float]  # what -> seconds that went into it; together they are `seconds`

    @property
    def ready_seconds(self) -> float:
        """From the start of the command until model, checkpoint, report and pictures are there."""
        return self.seconds - self.parts.get(REST, 0.0)

    @property
    def beside_training(self) -> float:
        """Seconds of `ready_seconds` that are not training."""
        return self.ready_seconds - self.train_seconds


def time_command(arguments: Sequence[str]) -> WallRun:
    """Run `turbogs train` with these arguments into a folder that is thrown away.

    Raises:
        InputError: the command refused its input, in its own words.
        TrainingStopped: it ended in another way without a model.
    """
    with tempfile.TemporaryDirectory() as place:
        out = Path(place) / "run"
        command = [sys.executable, "-m", "turbogs_plugin", "train", *arguments, "--out", str(out)]
        started = time.perf_counter()
        ended = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        seconds = time.perf_counter() - started
        record = WallRecord.read(RunFolder(out).wall)
    if ended.returncode or record is None or record.wall_seconds is None:
        last = (ended.stderr.strip().splitlines() or ["it said nothing"])[-1].removeprefix("turbogs: error: ")
        raise InputError(last) if ended.returncode == 2 else TrainingStopped(f"turbogs train: {last}")
    parts = record.parts | {REST: seconds - sum(record.parts.values())}
    return WallRun(seconds, record.train_seconds, record.wall_seconds, parts)


def bench_wall(arguments: Sequence[str], repeats: int) -> dict[str, Any]:
    """Time the command several times, one after the other.

    Args:
        arguments: of `turbogs train`, the capture's folder first; the record has the folder's name alone.

    Returns:
        ``runs``, and ``median``, the one in the middle by its seconds; the lower one of two.
    """
    runs = [time_command(arguments) for _ in range(repeats)]
    middle = sorted(runs, key=lambda run: run.seconds)[(len(runs) - 1) // 2]
    command = ["turbogs", "train", Path(arguments[0]).name, *arguments[1:]]
    return {"command": command, "runs": [vars(run) for run in runs], "median": vars(middle)}


def wall_lines(measured: dict[str, Any]) -> list[str]:
    """The run in the middle, part by part, and the sums of all runs."""
    middle, runs = WallRun(**measured["median"]), [WallRun(**run) for run in measured["runs"]]
    sums = {
        "whole command": middle.seconds,
        "training alone": middle.train_seconds,
        "until model, report and pictures are there": middle.ready_seconds,
        "beside training, until then": middle.beside_training,
    }
    width = max(map(len, (*middle.parts, *sums)))
    parts, totals = (
        [f"{name:<{width}}  {each:7.2f} s" for name, each in rows.items()] for rows in (middle.parts, sums)
    )
    each = ", ".join(f"{run.beside_training:.2f}" for run in runs)
    last = f"beside training, until then, of {len(runs)} runs: {each} s; the one in the middle is shown"
    return [*parts, "-" * (width + 11), *totals, last]
