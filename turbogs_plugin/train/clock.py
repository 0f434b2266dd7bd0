"""The two clocks of a run: seconds of training, which decide what counts as time, and seconds on the wall, from the
start of the process until the model is written, with what they went into.

A command makes its wall clock before it loads torch, so this module does without.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from turbogs_plugin.errors import InputError
from turbogs_plugin.files import process_started, read_text, write_text_atomically

if TYPE_CHECKING:
    import torch

_IMPORTED = time.perf_counter()

LONGEST_START = 120.0
"""Largest plausible age of a process at this module's import, in seconds. A larger one is of another system's clock."""


class TrainingClock:
    """Seconds of training. Use it as a context around training alone; it waits for the GPU at both ends.

    Args:
        seconds: training time that passed before.
    """

    def __init__(self, device: torch.device, seconds: float = 0.0) -> None:
        self.device = device
        self.seconds = seconds

    def __enter__(self) -> TrainingClock:
        _wait_for(self.device)
        self._started = time.perf_counter()
        return self

    def __exit__(self, *error: object) -> None:
        _wait_for(self.device)
        self.seconds += time.perf_counter() - self._started

    def now(self) -> float:
        """Seconds so far, within the context. Does not wait for the GPU, which is never far behind the trainer."""
        return self.seconds + time.perf_counter() - self._started

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """Within the clock's own context: time spent inside is not training and does not count."""
        _wait_for(self.device)
        began = time.perf_counter()
        try:
            yield
        finally:
            self._started += time.perf_counter() - began


def _wait_for(device: torch.device) -> None:
    from turbogs_plugin.device import synchronize  # imports torch

    synchronize(device)


def process_age() -> float:
    """Seconds since this process began, to a hundredth; where the system does not say, since this module's import.

    Linux counts a process's start in ticks since the machine was booted (proc_pid_stat(5), field 22).
    """
    imported = time.perf_counter() - _IMPORTED
    try:
        ticks = int(process_started(os.getpid()))
        age = time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, AttributeError):
        return imported
    return age if imported <= age <= imported + LONGEST_START else imported


class WallClock:
    """Seconds on the wall since its making, and what they went into.

    Args:
        age: seconds to begin with; `process_age` for a command.

    Attributes:
        parts: name -> seconds that went into it, in the order in which they first ended.
    """

    def __init__(self, age: float = 0.0) -> None:
        self._started = self._marked = time.perf_counter() - age
        self.parts: dict[str, float] = {}

    @property
    def seconds(self) -> float:
        """Seconds so far."""
        return time.perf_counter() - self._started

    def mark(self, part: str) -> None:
        """Book the time since the last mark on this part."""
        now = time.perf_counter()
        self.parts[part] = self.parts.get(part, 0.0) + now - self._marked
        self._marked = now


@dataclass
class WallRecord:
    """``wall.json`` of a run.

    Args:
        train_seconds: training, as in the history.
        wall_seconds: from the start of the process until the model was written or the run was stopped; the sum over
            processes for a resumed run, NaN where one of them was killed before it could say.
        parts: name -> seconds, of the newest process.
    """

    train_seconds: float
    wall_seconds: float = math.nan
    parts: dict[str, float] = field(default_factory=dict)

    def write(self, path: Path) -> None:
        """Write the file; NaN becomes null."""
        parts = {name: round(seconds, 3) for name, seconds in self.parts.items()}
        wall = None if math.isnan(self.wall_seconds) else round(self.wall_seconds, 3)
        mapping = asdict(self) | {"train_seconds": round(self.train_seconds, 6), "wall_seconds": wall, "parts": parts}
        write_text_atomically(path, json.dumps(mapping, indent=1) + "\n")

    @staticmethod
    def read(path: Path) -> WallRecord | None:
        """The record of a run, or None where it has none. Raises `InputError` if the file is not one."""
        text = read_text(path)
        if text is None:
            return None
        try:
            mapping = json.loads(text)
            wall = mapping["wall_seconds"]
            parts = {str(name): float(seconds) for name, seconds in mapping["parts"].items()}
            return WallRecord(float(mapping["train_seconds"]), math.nan if wall is None else float(wall), parts)
        except (ValueError, KeyError, TypeError, AttributeError):
            raise InputError(f"'{path}' is not a record of the wall clock: remove it") from None

    def text(self) -> str:
        """``trained 5.0 s, 9.1 s on the wall``."""
        trained = f"trained {self.train_seconds:.1f} s"
        return trained if math.isnan(self.wall_seconds) else f"{trained}, {self.wall_seconds:.1f} s on the wall"
