"""Seconds on the wall, from the start of a command, before it loads torch, until the model is written, by parts."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

from turbogs_plugin.config.typed import build_dataclass
from turbogs_plugin.files import read_text
from turbogs_plugin.yaml_json import parse_json


class WallClock:
    """Seconds on the wall since its making, and what they went into."""

    def __init__(self) -> None:
        self._started = self._marked = time.perf_counter()
        self.parts: dict[str, float] = {}
        """Name -> seconds that went into it, in the order in which they first ended."""

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
    """``wall.json`` of a run."""

    train_seconds: float
    """Training, as in the history."""
    wall_seconds: float | None = None
    """From the start of the command until the model was written or the run stopped; None for a resumed run."""
    parts: dict[str, float] = field(default_factory=dict)
    """Name -> seconds, of the newest command."""

    @staticmethod
    def read(path: Path) -> WallRecord | None:
        """The record of a run, or None where it has none. Raises `InputError` if the file is not one."""
        text = read_text(path)
        return None if text is None else build_dataclass(WallRecord, parse_json(text, f"'{path}'"), f"'{path}'")
