"""The files of a run on the disk, and whether the run is finished."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from turbogs_plugin.config.configuration import Config, resolve_complete
from turbogs_plugin.errors import InputError
from turbogs_plugin.files import read_text, require_writable, write_text_atomically
from turbogs_plugin.yaml_json import read_yaml


class RunFolder:
    """The paths of a run's files.

    Attributes:
        asked: the configuration as the user asked for it.
        config: the resolved configuration, after plan and budgets.
        lock, owner: locked by the process that writes the run, and its name while it does.
        wall: the `WallRecord`.
        tensorboard: folder of event files, where they are asked for.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.asked = path / "asked.yaml"
        self.config = path / "config.yaml"
        self.plan = path / "plan.txt"
        self.history = path / "history.jsonl"
        self.lock = path / ".lock"
        self.owner = path / ".owner"
        self.wall = path / "wall.json"
        self.checkpoints = path / "checkpoints"
        self.report = path / "report.md"
        self.model = path / "model.ply"
        self.renders = path / "renders"
        self.tensorboard = path / "tensorboard"

    def require_new(self) -> None:
        """Raise `InputError` if the folder holds anything, or cannot be made."""
        if self.path.exists() and not (self.path.is_dir() and not any(self.path.iterdir())):
            raise InputError(f"--out '{self.path}' is not empty: choose a new folder, or go on with a run by --resume")
        require_writable(self.path, f"--out '{self.path}'")

    @contextmanager
    def owned(self, new: bool = False) -> Iterator[None]:
        """The folder is this process's alone while entered. A line on stderr tells of an owner that was killed, whose
        lock the system has freed, and of a disk that knows no locks.

        Args:
            new: the folder is made.

        Raises:
            InputError: another process writes to it; or it is not `new`, for one has written to it meanwhile.
        """
        from filelock import FileLock, Timeout  # of the extra `train`

        self.path.mkdir(parents=new, exist_ok=True)
        if self.lock.is_symlink():
            raise InputError(f"'{self.lock}' is a link: remove it")
        lock = FileLock(self.lock)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            by = read_text(self.owner) or "another process"
            raise InputError(f"{by} writes to '{self.path}': wait for it, or choose another folder") from None
        except (OSError, NotImplementedError) as error:
            print(f"turbogs: '{self.path}' cannot be locked ({error}): let one process write to it", file=sys.stderr)
        try:
            if new and {*self.path.iterdir()} - {self.lock, self.owner}:
                raise InputError(f"--out '{self.path}' is not empty: another process has written to it meanwhile")
            if before := read_text(self.owner):
                print(f"turbogs: {before[:80]} was killed: '{self.path}' is taken over from it", file=sys.stderr)
            write_text_atomically(self.owner, f"process {os.getpid()} of {socket.gethostname()}")
            yield
        finally:
            self.owner.unlink(missing_ok=True)
            lock.release()

    def discard(self) -> None:
        """Remove what a run wrote that never came to a checkpoint, and the folder if nothing else is in it."""
        for file in (self.asked, self.config, self.plan, self.history, self.owner, self.lock):
            file.unlink(missing_ok=True)
        if self.path.is_dir() and not any(self.path.iterdir()):
            self.path.rmdir()

    def finished(self, reported: bool) -> bool:
        """Whether nothing of the run is left to do: its model is there, which is written at the end, and its report if
        that is `reported`."""
        return self.model.is_file() and (self.report.is_file() or not reported)

    def read_config(self, built: bool = False, trusted: bool = False) -> Config:
        """The resolved configuration of the run. Raises `InputError` if this is no run, or part of it is missing.
        Arguments as of `resolve_complete`."""
        return self._read(self.config, True, built, trusted)

    def read_asked(self) -> Config:
        """The configuration that was asked for. Raises `InputError` if it is missing or incomplete."""
        return self._read(self.asked, False)

    def _read(self, file: Path, *how: bool) -> Config:
        if not file.is_file():
            lacks = f"{file.name} in it" if self.path.exists() else "such folder"
            raise InputError(f"'{self.path}' holds no run: there is no {lacks}; give a folder that train --out made")
        return resolve_complete(read_yaml(file), str(file), *how)
