"""The wall clock of a run: seconds from the start of its process until its model is written, and where they went."""

from __future__ import annotations

import json
import math
import os
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

from turbogs_plugin.errors import InputError
from turbogs_plugin.files import process_started, read_text, write_text_atomically

_IMPORTED = time.perf_counter()

LONGEST_START = 120.0
"""More seconds than an interpreter takes until it imports this. A larger age is of another clock than the system's."""


def process_age() -> float:
    """Seconds since this process began, to a hundredth; where the system does not say, since this module was imported.

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
    """Runs from its making, or from before, and says what the time went into.

    Args:
        age: seconds that it has run for when it is made; `process_age` for a command.

    Attributes:
        parts: what -> seconds that went into it, in the order in which they first ended.
    """

    def __init__(self, age: float = 0.0) -> None:
        self._started = self._marked = time.perf_counter() - age
        self.parts: dict[str, float] = {}

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._started

    def mark(self, part: str) -> None:
        """The time since the last mark went into this part."""
        now = time.perf_counter()
        self.parts[part] = self.parts.get(part, 0.0) + now - self._marked
        self._marked = now


@dataclass
class WallRecord:
    """``wall.json`` of a run.

    Args:
        train_seconds: training, as in the history.
        wall_seconds: from the start of the process until the model was written, or until the run was stopped; the sum
            over processes for a resumed run, NaN where one of them was killed before it could say.
        parts: of the newest process: what -> seconds.
    """

    train_seconds: float
    wall_seconds: float = math.nan
    parts: dict[str, float] = field(default_factory=dict)

    def write(self, path: Path) -> None:
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
