"""Which of several processes trains a cell: claim files in the study's folder, which nodes may share.

A claim is a file that only one process can create (``O_EXCL``): ``claims/SCENE/VARIANT--seedN.GENERATION``. It names
host, process and start, and its holder touches it every few seconds. A claim that was not touched for `STALE_SECONDS`,
or whose process is gone from this very host, is dead; whoever creates the next generation takes the cell over. So two
processes that see the same dead claim cannot both have it, and a holder that was only asleep finds a newer generation
and throws its result away. Ages are taken between times of the same file system, as clocks of hosts differ.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from turbogs_plugin.files import process_started
from turbogs_plugin.study.grid import CellKey

HEARTBEAT_SECONDS = 5.0
STALE_SECONDS = 60.0


@dataclass(frozen=True)
class Claim:
    """A cell that this process may train.

    Args:
        base: the path of its claims, without the generation.
        generation: of this claim.
    """

    base: Path
    generation: int

    @property
    def path(self) -> Path:
        return _path(self.base, self.generation)

    @property
    def held(self) -> bool:
        """Whether nobody has taken the cell over meanwhile."""
        return _latest(self.base) == self.generation

    @contextlib.contextmanager
    def kept(self) -> Iterator[None]:
        """While entered, the claim is alive. Afterwards it is gone, and so are the dead ones before it."""
        end = threading.Event()

        def beat() -> None:
            while not end.wait(HEARTBEAT_SECONDS):
                with contextlib.suppress(OSError):
                    os.utime(self.path)

        heart = threading.Thread(target=beat, daemon=True)
        heart.start()
        try:
            yield
        finally:
            end.set()
            heart.join()
            # The newest goes last, so that a cell never looks claimed by a dead process alone.
            for generation in range(self.generation + 1):
                _path(self.base, generation).unlink(missing_ok=True)


class Claims:
    """The claims of a study.

    Args:
        folder: of the claims; made when needed.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def take(self, key: CellKey) -> Claim | None:
        """A claim of a cell; None while another process has one that is alive."""
        base = self._folder / key.file.with_suffix("")
        base.parent.mkdir(parents=True, exist_ok=True)
        latest = _latest(base)
        if latest is not None and self._alive(_path(base, latest)):
            return None
        claim = Claim(base, 0 if latest is None else latest + 1)
        process = os.getpid()
        holder = {"host": socket.gethostname(), "process": process, "started": process_started(process)}
        with contextlib.suppress(FileExistsError), open(claim.path, "x", encoding="utf-8") as file:
            json.dump(holder, file)
            return claim
        return None

    def _alive(self, path: Path) -> bool:
        try:
            text, touched = path.read_text(encoding="utf-8"), path.stat().st_mtime
        except FileNotFoundError:
            return True  # its holder has just ended; the next look tells more
        if self._now() - touched > STALE_SECONDS:
            return False
        try:
            holder = json.loads(text)
            here = holder["host"] == socket.gethostname()
            return not here or process_started(holder["process"]) == holder["started"]
        except (ValueError, KeyError, TypeError):
            return True  # not yet written

    def _now(self) -> float:
        """The time of the file system."""
        with tempfile.NamedTemporaryFile(dir=self._folder, prefix=".now-") as probe:
            return os.stat(probe.name).st_mtime


def _path(base: Path, generation: int) -> Path:
    return base.with_name(f"{base.name}.{generation}")


def _latest(base: Path) -> int | None:
    """The newest generation of a cell's claims; None where there is none."""
    # By name, not by a pattern: variants may hold its characters.
    found = [path.name[len(base.name) + 1 :] for path in base.parent.iterdir() if path.name.startswith(f"{base.name}.")]
    return max((int(text) for text in found if text.isdigit()), default=None)
