"""What the cells of a study gave, and the files that keep it.

A folder of a study has ``results.json``, from which its page is made, and ``cells/SCENE/VARIANT--seedN.json``, written
when a cell ends: whatever stops the process, no finished cell is lost. Both are JSON of one form. Settings are flat
there, ``section.key`` -> value: ``settings`` has the first cell's, and each cell what is different in its own.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from turbogs_plugin.config.typed import build_dataclass
from turbogs_plugin.errors import InputError
from turbogs_plugin.files import read_text, write_text_atomically
from turbogs_plugin.report.provenance import Provenance
from turbogs_plugin.study.grid import Ablation, CellKey
from turbogs_plugin.train.history import Evaluation, measure
from turbogs_plugin.yaml_json import parse_json

FORMAT = 3
"""Version of ``results.json``: raised whenever an older version of TurboGS would misread a new file."""
CURVE = {"iteration": "iteration", "seconds": "train_seconds", "gaussians": "num_gaussians"}
CURVE |= {name: name for name in ("psnr", "ssim", "l1")}
"""Column of a cell's curve -> field of `Evaluation`."""
LAST = ("worst_psnr", "refined_psnr", "refined_ssim", "nonfinite_losses", "skipped_updates")
"""Fields of the last `Evaluation` that a cell's `final` has besides the curve's columns."""
DIGITS = {"seconds": 3, "psnr": 3, "ssim": 5, "l1": 6, "lpips": 5, "fps": 1}
"""Digits behind the point that the files keep of a measure, by the last word of its name."""


@dataclass(kw_only=True)
class CellResult:
    """Result of one training.

    Args:
        scene, variant, seed: which cell.
        capture: `capture_digest` of the capture; "" where it was not recorded.
        provenance: None where it was not recorded.
        settings: the configuration that was asked for, flat; `planned`: what plan and budgets changed of it.
        curve: column, of `CURVE`, -> [E] its values at the evaluations, in the order of training.
        final: measure -> value of the final model, where it was taken: the curve's last values; the others of `LAST`;
            ``lpips``; ``fps``, test views rendered a second; ``peak_mib``, peak of the GPU's tensors while training;
            ``wall_seconds`` of a run, from its process's start until its model was written; ``cell_seconds`` of a cell:
            loading its capture, plan, training and evaluations.
        lpips_reason: why LPIPS was not computed; empty where it was.
    """

    scene: str
    variant: str
    seed: int
    capture: str = ""
    provenance: Provenance | None = None
    settings: dict[str, Any]
    planned: dict[str, Any] = field(default_factory=dict)
    curve: dict[str, list[float]]
    final: dict[str, float]
    lpips_reason: str = ""

    @property
    def key(self) -> CellKey:
        return CellKey(self.scene, self.variant, self.seed)


@dataclass
class Study:
    """An ablation with its finished cells: captures by name, variants in the ablation's order, seeds ascending."""

    ablation: Ablation
    results: list[CellResult]

    @property
    def scenes(self) -> list[str]:
        return list(dict.fromkeys(result.scene for result in self.results))

    @property
    def provenances(self) -> list[Provenance | None]:
        """Different provenances of the results, in the results' order."""
        made = [result.provenance for result in self.results]
        return [entry for number, entry in enumerate(made) if entry not in made[:number]]

    def of(self, scene: str, variant: str) -> list[CellResult]:
        """Results of all seeds of a variant on a capture."""
        return [result for result in self.results if (result.scene, result.variant) == (scene, variant)]


def curve_and_final(history: Sequence[Evaluation]) -> tuple[dict[str, list[float]], dict[str, float]]:
    """`CellResult.curve` and the part of `CellResult.final` that a history has, which has one evaluation or more."""
    curve = {name: [getattr(entry, source) for entry in history] for name, source in CURVE.items()}
    values = {name: column[-1] for name, column in curve.items()} | {name: getattr(history[-1], name) for name in LAST}
    return curve, measured(values)


def measured(values: Mapping[str, float | None]) -> dict[str, float]:
    """The values that are there and finite."""
    return {name: value for name, value in values.items() if value is not None and math.isfinite(value)}


def flat_settings(mapping: Mapping[str, Any], place: str = "") -> dict[str, Any]:
    """``section.key`` -> value of a nested configuration (`Config.to_mapping`), without what is null, and with the
    capture's name for its path: where a capture lies is no part of a result."""
    flat: dict[str, Any] = {}
    for key, value in mapping.items():
        path = f"{place}.{key}" if place else key
        if isinstance(value, dict) and value:
            flat |= flat_settings(value, path)
        elif value is not None:
            flat[path] = Path(value).name if path == "scene.path" else value
    return flat


def changes(common: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """What `own` has other than `common`, both flat; None for a setting that `own` has not."""
    changed = {path: value for path, value in own.items() if path not in common or common[path] != value}
    return changed | {path: None for path in common if path not in own}


def with_changes(common: Mapping[str, Any], changed: Mapping[str, Any]) -> dict[str, Any]:
    """Settings that have these `changes` from `common`."""
    return {path: value for path, value in {**common, **changed}.items() if value is not None}


class StudyFolder:
    """Files of a study: ``results.json``, the page and the plots beside it, and the cells' own files."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.file = path / "results.json"
        self.cells = path / "cells"

    def write(self, result: CellResult) -> None:
        """Keep a cell's result, as a study of that cell alone."""
        path = self.cells / result.key.file
        path.parent.mkdir(parents=True, exist_ok=True)
        ablation = Ablation(title=str(result.key), variants={result.variant: []})
        write_text_atomically(path, _text(Study(ablation, [result])))

    @contextmanager
    def claimed(self, key: CellKey) -> Iterator[bool]:
        """Whether the cell is this process's to train while entered. The system frees a killed process's lock."""
        path = (self.cells / key.file).with_suffix(".lock")
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            lock = FileLock(path, blocking=False).acquire()
        except Timeout:
            yield False
        else:
            with lock:
                yield True

    def write_study(self, study: Study) -> None:
        """Write ``results.json``."""
        self.path.mkdir(parents=True, exist_ok=True)
        write_text_atomically(self.file, _text(study))

    def read_study(self) -> Study:
        """Everything that the folder has, of ``results.json`` and of the cells' own files. Raises `InputError`: no
        study, or a file that is wrong, which is named."""
        if not self.file.is_file():
            is_run = (self.path / "config.yaml").is_file()
            hint = "; it is a run: give two or more, and --out NEW" if is_run else ""
            raise InputError(f"'{self.path}' holds no study: there is no {self.file.name}{hint}")
        study = _parsed(self.file)
        parts = [study, *(_parsed(path) for path in self.cells.glob("*/*.json"))]
        found = {result.key: result for part in parts for result in part.results}
        order = {name: number for number, name in enumerate(study.ablation.variants)}
        if strange := [key for key in found if key.variant not in order]:
            raise InputError(f"'{self.path}' has a cell of another ablation ({strange[0]}): choose a new --out")
        results = sorted(found.values(), key=lambda result: (result.scene, order[result.variant], result.seed))
        return Study(study.ablation, results)


def _text(study: Study) -> str:
    """JSON of a study, a line for each cell."""
    provenances = study.provenances
    common = study.results[0].settings if study.results else {}
    document: dict[str, Any] = {"format": FORMAT, **asdict(study.ablation)}
    document["provenances"] = [entry and asdict(entry) for entry in provenances]
    document["settings"] = common
    lines = [f"{json.dumps(name)}: {json.dumps(value, ensure_ascii=False)}" for name, value in document.items()]
    cells = []
    for result in study.results:
        entry = vars(result) | {
            "provenance": provenances.index(result.provenance),
            "settings": changes(common, result.settings),
            "curve": {name: [_rounded(name, value) for value in column] for name, column in result.curve.items()},
            "final": {name: _rounded(name, value) for name, value in result.final.items()},
        }
        cells.append(json.dumps(entry, ensure_ascii=False, separators=(",", ":")))
    lines.append('"cells": [\n' + ",\n".join(cells) + "\n]")
    return "{\n" + ",\n".join(lines) + "\n}\n"


def _rounded(name: str, value: float) -> float | None:
    """A measure with the digits that are kept; None, which JSON calls null, where it is not finite."""
    if not math.isfinite(value):
        return None
    return round(value, DIGITS.get(name.rpartition("_")[2], 1)) if isinstance(value, float) else value


def _parsed(path: Path) -> Study:
    """Study of a file that `_text` made."""
    document = parse_json(read_text(path) or "", f"'{path}'")
    try:
        if (version := document["format"]) == FORMAT:
            settings = {entry.name: document[entry.name] for entry in fields(Ablation)}
            made = [entry and build_dataclass(Provenance, entry, "provenances") for entry in document["provenances"]]
            results = [_result(entry, document["settings"], made) for entry in document["cells"]]
            return Study(build_dataclass(Ablation, settings, "study"), results)
    except (KeyError, TypeError, AttributeError, IndexError, InputError) as error:
        raise InputError(f"'{path}' does not hold results of a study ({error!r}): choose a new --out") from None
    raise InputError(f"'{path}' is of format {version}: this version reads format {FORMAT}")


def _result(entry: dict[str, Any], common: dict[str, Any], provenances: Sequence[Provenance | None]) -> CellResult:
    result = build_dataclass(CellResult, entry | {"provenance": None, "curve": {}, "final": {}}, "cells")
    curve = {name: [measure(value) for value in entry["curve"][name]] for name in CURVE}
    if len(lengths := {len(column) for column in curve.values()}) > 1 or 0 in lengths:
        raise TypeError(f"columns of a curve have {sorted(lengths)} numbers")
    final = {name: measure(value) for name, value in entry["final"].items()}
    settings, made_by = with_changes(common, result.settings), provenances[entry["provenance"]]
    return replace(result, settings=settings, curve=curve, final=final, provenance=made_by)
