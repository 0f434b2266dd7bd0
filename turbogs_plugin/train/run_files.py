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
        self.renders, self.aside = path / "renders", Path(f"{path}.replaced")
        self._mark = ".replaced"  # the name of a file in the run that lies in `aside`, so that no other is removed
        self._begun = (self.asked, self.config, self.plan, self.history, self.checkpoints)

    def require_new(self, overwrite: bool = False) -> None:
        """Raise `InputError` if the folder cannot be made, or holds more than a run without a checkpoint leaves; or, to
        `overwrite`, more than a run and its exports."""
        if self.path.exists() and not (self.path.is_dir() and self._unclaimed()):
            if not overwrite or not self.asked.is_file() or self.path.is_symlink():
                remedy = "choose a new folder; --resume goes on with a run, --overwrite replaces one"
                raise InputError(f"--out '{self.path}' is not empty: {remedy}")
            ours = {*self._begun, self.lock, self.owner, self.wall, self.metrics, self.model, self.report, self.renders}
            ours |= {*map(self.path.joinpath, ("report", "export.ply", self._mark)), *self.path.glob("model.*")}
            if others := {*self.path.iterdir()} - ours:
                raise InputError(f"--overwrite: '{min(others)}' is of no training: take it out of the folder first")
            if self.aside.exists():
                raise InputError(f"--overwrite: '{self.aside}' is there, an older run: move it or remove it")
            require_writable(self.aside, f"--overwrite: '{self.aside}'")
        elif self.older() and not overwrite:
            raise InputError(f"'{self.aside}' is there, an older run: move it, or go on from there by --overwrite")
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
    def replaced(self) -> Iterator[None]:
        """Put the run that the folder holds into `aside`, until the new one is finished (`owned`). At the end it comes
        back where the new one has no checkpoint. Raises `InputError` where another process writes to it."""
        if self.path.exists() and not self._unclaimed():
            with self.owned():
                self.owner.unlink()
                (self.path / self._mark).touch()
                self.path.rename(self.aside)
            print(f"turbogs: the older run lies in '{self.aside}' until this one is finished", file=sys.stderr)
        try:
            yield
        finally:
            if self.older() and (not self.path.exists() or self._unclaimed()):
                shutil.rmtree(self.path, ignore_errors=True)
                (self.aside / self._mark).unlink(missing_ok=True)
                self.aside.rename(self.path)

    def older(self) -> str:
        """Where the run lies that this one replaces, for a message; nothing where there is none."""
        return f"; the older run is in '{self.aside}'" if (self.aside / self._mark).is_file() else ""

    @contextmanager
    def owned(self, new: bool = False) -> Iterator[None]:
        """The folder, which is made where it is `new`, is this process's alone while entered. A line on stderr tells of
        an owner that was killed, whose lock the system has freed, and of a disk that knows no locks. Raises
        `InputError` where another process writes to it, or has written to a new one meanwhile. A new one that ends by
        an `InputError` before its first checkpoint is removed; so is the run in `aside` once its model is there."""
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
                taken = f"'{self.path}' is taken over from it{self.older()}"
                print(f"turbogs: {before[:80]!a} was killed: {taken}", file=sys.stderr)
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
            if self.model.is_file() and self.older():
                shutil.rmtree(self.aside, ignore_errors=True)
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
