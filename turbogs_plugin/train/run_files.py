"""The files of a run on the disk, and whether the run is finished."""

from __future__ import annotations

import os
import shutil
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from turbogs_plugin.config.configuration import Config, resolve_complete
from turbogs_plugin.errors import InputError
from turbogs_plugin.files import read_text, require_writable, write_text_atomically
from turbogs_plugin.train.checkpoint import latest_checkpoint
from turbogs_plugin.yaml_json import read_yaml


class RunFolder:
    """The paths of a run's files: among them the configuration as it was `asked` for, and `config` after plan and
    budgets; `lock`, which the process that writes the run holds, and `owner`, its name while it does."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.asked, self.config, self.plan = path / "asked.yaml", path / "config.yaml", path / "plan.txt"
        self.history, self.wall, self.metrics = path / "history.jsonl", path / "wall.json", path / "metrics.json"
        self.lock, self.owner = path / ".lock", path / ".owner"
        self.checkpoints, self.model, self.report = path / "checkpoints", path / "model.ply", path / "report.md"
        self.renders = path / "renders"
        self._begun = (self.asked, self.config, self.plan, self.history, self.checkpoints)

    def require_new(self) -> None:
        """Raise `InputError` if the folder cannot be made, or holds more than a run without a checkpoint leaves."""
        if self.path.exists() and not (self.path.is_dir() and self._unclaimed()):
            raise InputError(f"--out '{self.path}' is not empty: choose a new folder, or go on with a run by --resume")
        require_writable(self.path, f"--out '{self.path}'")

    def require_own(self) -> None:
        """Raise `InputError` where a folder, into which commands write, or the lock is a link out of the run."""
        folders = (self.checkpoints, self.path / "report", self.renders, *self.renders.glob("*"))
        for place in (self.lock, *folders):
            if place.is_symlink():
                raise InputError(f"'{place}' is a link: remove it")

    def _unclaimed(self) -> bool:
        """Whether nothing is here but what a run leaves that ended before its first checkpoint."""
        there = {*self.path.iterdir()} - {self.lock, self.owner}
        begun = self.asked in there and there <= {*self._begun} and latest_checkpoint(self.checkpoints) is None
        return begun or not there

    @contextmanager
    def owned(self, new: bool = False) -> Iterator[None]:
        """The folder, which is made where it is `new`, is this process's alone while entered. A line on stderr tells of
        an owner that was killed, whose lock the system has freed, and of a disk that knows no locks. Raises
        `InputError` where another process writes to it, or has written to a new one meanwhile. A new one that ends by
        an `InputError`, from a strategy of one's own, say, before its first checkpoint is removed."""
        from filelock import FileLock, Timeout  # of the extra `train`

        self.path.mkdir(parents=new, exist_ok=True)
        self.require_own()
        lock = FileLock(self.lock)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            by = read_text(self.owner) or "another process"
            raise InputError(f"{by} writes to '{self.path}': wait for it, or choose another folder") from None
        except (OSError, NotImplementedError) as error:
            print(f"turbogs: '{self.path}' cannot be locked ({error}): let one process write to it", file=sys.stderr)
        try:
            if new and not self._unclaimed():
                raise InputError(f"--out '{self.path}' is not empty: another process has written to it meanwhile")
            if before := read_text(self.owner):
                print(f"turbogs: {before[:80]!a} was killed: '{self.path}' is taken over from it", file=sys.stderr)
            if new:  # what a run that failed has left
                for file in (self.config, self.history):
                    file.unlink(missing_ok=True)
            write_text_atomically(self.owner, f"process {os.getpid()} of {socket.gethostname()}")
            yield
        except InputError:
            if new and self._unclaimed():
                shutil.rmtree(self.path, ignore_errors=True)
            raise
        finally:
            self.owner.unlink(missing_ok=True)
            lock.release()

    def finished(self, reported: bool) -> bool:
        """Whether the run's model, which is written at the end, is there, and its report if that is `reported`."""
        return self.model.is_file() and (self.report.is_file() or not reported)

    def read_config(self, built: bool = False, trusted: bool = False) -> Config:
        """The resolved configuration of the run. Arguments and errors as of `resolve_complete`."""
        return self._read(self.config, True, built, trusted)

    def read_asked(self) -> Config:
        """The configuration that was asked for. Errors as of `resolve_complete`."""
        return self._read(self.asked, False)

    def _read(self, file: Path, *how: bool) -> Config:
        if not file.is_file():
            lacks = f"{file.name} in it" if self.path.exists() else "such folder"
            raise InputError(f"'{self.path}' holds no run: there is no {lacks}; give a folder that train --out made")
        return resolve_complete(read_yaml(file), str(file), *how)
