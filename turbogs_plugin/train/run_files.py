"""The files of a run on the disk, and whether the run is finished."""

from __future__ import annotations

import shlex
from pathlib import Path

from turbogs_plugin.config.configuration import Config, resolve_complete
from turbogs_plugin.errors import InputError
from turbogs_plugin.files import read_text, require_writable
from turbogs_plugin.plan import Plan
from turbogs_plugin.train.checkpoint import latest_checkpoint, load_checkpoint
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
        self.plan = path / "plan.json"
        self.history = path / "history.jsonl"
        self.wall = path / "wall.json"
        self.checkpoints = path / "checkpoints"
        self.report = path / "report.md"
        self.model = path / "model.ply"
        self.renders = path / "renders"
        self.tensorboard = path / "tensorboard"

    def require_new(self) -> None:
        """Raise `InputError` if the folder holds anything, or cannot be made."""
        if self.config.exists():
            quoted = shlex.quote(str(self.path))
            raise InputError(f"'{self.path}' holds another run: choose a new --out, or go on with --resume {quoted}")
        if self.path.exists() and not self.path.is_dir():
            raise InputError(f"--out '{self.path}' is a file: choose a folder")
        if self.path.is_dir() and any(self.path.iterdir()):
            raise InputError(f"--out '{self.path}' is not empty: choose a new folder")
        require_writable(self.path, f"--out '{self.path}'")

    def require_unfinished(self) -> None:
        """Raise `InputError` where a run has its model but no checkpoint: training anew would replace its history."""
        if self.model.is_file():
            raise InputError(
                f"'{self.path}' is finished, for its {self.model.name} is there, and has no checkpoint to go on from: "
                "use that model, or train anew with another --out"
            )

    def finished_text(self, reported: bool) -> str:
        """``RUN is finished: N of N iterations`` where nothing of a run is left to do, else "".

        Args:
            reported: whether its report is asked for.
        """
        if not self.model.is_file() or (reported and not self.report.is_file()):
            return ""
        config, checkpoint = self.read_config(), latest_checkpoint(self.checkpoints)
        if checkpoint is None:
            return ""
        state = load_checkpoint(checkpoint)
        try:
            iteration = state["trainer"]["iteration"]
            total = state["pace"].get("iterations", config.train.iterations)  # of a time budget, the pace knows better
            return f"{self.path} is finished: {iteration} of {total} iterations" if iteration >= total else ""
        except (KeyError, TypeError, AttributeError):
            return ""  # a resume from this checkpoint says what is wrong with it

    def discard(self) -> None:
        """Remove what a run wrote that never came to a checkpoint, and the folder if nothing else is in it."""
        for path in (self.asked, self.config, self.plan, self.history, self.wall):
            path.unlink(missing_ok=True)
        if self.path.is_dir() and not any(self.path.iterdir()):
            self.path.rmdir()

    def read_config(self) -> Config:
        """The resolved configuration of the run. Raises `InputError` if this is no run, or part of it is missing."""
        if not self.config.is_file():
            lacks = "config.yaml in it" if self.path.exists() else "such folder"
            raise InputError(f"'{self.path}' holds no run: there is no {lacks}; give a folder that train --out made")
        return resolve_complete(read_yaml(self.config), str(self.config), decided=True)

    def read_asked(self) -> Config:
        """The configuration that was asked for. Raises `InputError` if it is missing or incomplete."""
        if not self.asked.is_file():
            raise InputError(f"'{self.path}' has no {self.asked.name}, which says what was asked for: train anew")
        return resolve_complete(read_yaml(self.asked), str(self.asked))

    def read_plan(self) -> Plan | None:
        """The plan made when the run began, or None. Raises `InputError` if it cannot be read."""
        text = read_text(self.plan)
        try:
            return None if text is None else Plan.from_json(text)
        except InputError as error:
            raise InputError(f"cannot read the plan '{self.plan}': {error}") from None
