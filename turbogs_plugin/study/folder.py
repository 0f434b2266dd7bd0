"""Where a study is on the disk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from turbogs_plugin.errors import InputError, nearest
from turbogs_plugin.files import write_text_atomically
from turbogs_plugin.study.grid import Ablation, CellKey
from turbogs_plugin.study.results import CellResult, Failure, Study
from turbogs_plugin.study.results_file import study_from_json, study_to_json


class StudyFolder:
    """``results.json``, and the page and plots beside it.

    Where a study is trained, each cell also has a file of the same form from the moment that it ends,
    ``cells/SCENE/VARIANT--seedN.json``: no finished cell is lost, whatever stops the process. These files go into
    ``results.json`` whenever that is written; nothing else needs them. While cells are trained, ``claims`` says by
    whom (`turbogs_plugin.study.claims`). Where `report.tensorboard` is on, ``tensorboard/SCENE/VARIANT--seedN/`` has a
    cell's event files.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.file = path / "results.json"
        self.cells = path / "cells"
        self.claims = path / "claims"
        self.tensorboard = path / "tensorboard"

    def require_usable(self) -> None:
        """Raises `InputError` where the folder holds anything but a study, or cannot be one."""
        if self.path.exists() and not self.path.is_dir():
            raise InputError(f"--out '{self.path}' is a file: choose a folder")
        if self.path.is_dir() and any(self.path.iterdir()) and not self.file.is_file():
            raise InputError(f"--out '{self.path}' is not empty and holds no study: choose a new folder")

    def write(self, outcome: CellResult | Failure) -> None:
        """Keep a result, or the reason why there is none; a failure of a cell is forgotten when it has a result."""
        path = self.cells / outcome.key.file
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text_atomically(path, _cell_text(outcome))

    def written(self, key: CellKey) -> int:
        """When a cell's file was last written, whatever it says: nanoseconds; 0: never."""
        path = self.cells / key.file
        return path.stat().st_mtime_ns if path.is_file() else 0

    def write_study(self, study: Study) -> None:
        """Write ``results.json``."""
        self.path.mkdir(parents=True, exist_ok=True)
        write_text_atomically(self.file, study_to_json(study))

    def read_study(self) -> Study:
        """Everything that is there, variants in the order of the ablation, scenes and seeds sorted.

        Raises:
            InputError: no study, or a file that is wrong, which is named.
        """
        if not self.file.is_file():
            raise InputError(f"'{self.path}' holds no study: there is no {self.file.name}")
        study = study_from_json(self.file)
        results: dict[CellKey, CellResult] = {}
        failures: dict[CellKey, Failure] = {}
        for path in (self.file, *sorted(self.cells.glob("*/*.json"))):
            part = study if path == self.file else study_from_json(path)
            for result in part.results:
                if result.variant not in study.ablation.variants:
                    hint = nearest(result.variant, study.ablation.variants)
                    raise InputError(f"'{path}' is of no variant of the ablation: '{result.variant}', {hint}")
                results[result.key] = result
            failures |= {failure.key: failure for failure in part.failures}
        order = {name: number for number, name in enumerate(study.ablation.variants)}
        found = sorted(results.values(), key=lambda result: (result.scene, order[result.variant], result.seed))
        broken = [failure for key, failure in failures.items() if key not in results]
        return replace(study, results=found, failures=broken)


def _cell_text(outcome: CellResult | Failure) -> str:
    """A cell's file is a study of that cell alone."""
    ablation = Ablation(title=str(outcome.key), variants={outcome.key.variant: []})
    failed = isinstance(outcome, Failure)
    return study_to_json(Study(ablation, [], [outcome]) if failed else Study(ablation, [outcome]))


def merged(folders: Sequence[StudyFolder]) -> Study:
    """The cells of several studies as one; title and baseline are the first one's.

    Raises:
        InputError: a folder without a study, a variant with two meanings, two different results of one cell, or two
            captures of one name.
    """
    studies = [folder.read_study() for folder in folders]
    ablation = studies[0].ablation
    for folder, other in zip(folders[1:], (study.ablation for study in studies[1:]), strict=True):
        if other.base != ablation.base:
            raise InputError(
                f"'{folder.path}' has the base '{other.base}' and '{folders[0].path}' '{ablation.base}': merge studies "
                "of one base"
            )
        for name, overrides in other.variants.items():
            if ablation.variants.get(name, overrides) != overrides:
                raise InputError(
                    f"variant '{name}' of '{folder.path}' has other settings than in those before: rename one of them"
                )
            ablation.variants.setdefault(name, overrides)
        ablation.notes = {**other.notes, **ablation.notes}
    results: dict[CellKey, CellResult] = {}
    captures: dict[str, str] = {}
    for result in (result for study in studies for result in study.results):
        if result.capture and captures.setdefault(result.scene, result.capture) != result.capture:
            raise InputError(f"two different captures are called '{result.scene}' in what is to be merged")
        if _cell_text(results.setdefault(result.key, result)) != _cell_text(result):
            raise InputError(f"two different results of the cell {result.key}")
    return Study(ablation, list(results.values()))
