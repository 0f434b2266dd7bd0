"""The files of a run on the disk, and whether the run is finished."""

from __future__ import annotations

from pathlib import Path

from turbogs_plugin.config.configuration import Config, resolve_complete
from turbogs_plugin.errors import InputError
from turbogs_plugin.files import require_writable
from turbogs_plugin.yaml_json import read_yaml


class RunFolder:
    """The paths of a run's files.

    Attributes:
        asked: the configuration as the user asked for it.
        config: the resolved configuration, after plan and budgets.
        wall: the `WallRecord`.
        tensorboard: folder of event files, where they are asked for.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.asked = path / "asked.yaml"
        self.config = path / "config.yaml"
        self.plan = path / "plan.txt"
        self.history = path / "history.jsonl"
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

    def discard(self) -> None:
        """Remove what a run wrote that never came to a checkpoint, and the folder if nothing else is in it."""
        for file in (self.asked, self.config, self.plan, self.history):
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
