"""Results of cells on the disk: one small JSON a cell, read back strictly."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, get_type_hints

from turbogs_plugin.config.schema import build_dataclass, convert, nearest
from turbogs_plugin.errors import InputError
from turbogs_plugin.files import write_text_atomically
from turbogs_plugin.report.provenance import Provenance
from turbogs_plugin.study.grid import Ablation, CellKey
from turbogs_plugin.train.history import Evaluation

FORMAT = 1


@dataclass
class CellResult:
    """What one training gave.

    Args:
        scene, variant, seed: which.
        config: its configuration, as plan and budgets resolved it.
        asked: the sections of it that were asked for otherwise, as they were asked for.
        history: every evaluation, the last one of the final model.
        lpips: NaN where it was not computed.
        lpips_reason: why not; empty where it was.
        fps: test views rendered a second, one after the other; NaN where it was not recorded.
        peak_bytes: peak of the GPU's tensors while training, or None where it was not measured.
        warmup_iterations: iterations of the same configuration before the clock started, on a model thrown away.
        provenance: machine, versions and commit, or None where they were not recorded.
        capture: `capture_digest` of the scene, or "" where it was not recorded.
    """

    scene: str
    variant: str
    seed: int
    config: dict[str, Any]
    history: list[Evaluation]
    asked: dict[str, dict[str, Any]] = field(default_factory=dict)
    lpips: float = math.nan
    lpips_reason: str = ""
    fps: float = math.nan
    peak_bytes: int | None = None
    warmup_iterations: int = 0
    provenance: Provenance | None = None
    capture: str = ""

    @property
    def key(self) -> CellKey:
        return CellKey(self.scene, self.variant, self.seed)

    @property
    def final(self) -> Evaluation:
        """The evaluation of the final model."""
        return self.history[-1]

    @property
    def asked_config(self) -> dict[str, Any]:
        """The configuration that was asked for: by it a finished cell is recognised."""
        return {**self.config, **self.asked}

    @property
    def time_budget(self) -> str:
        """As it was written, for instance 20s; empty where there is none."""
        return self.config["budget"]["time"]


@dataclass
class Failure:
    """A cell that gave no result, and why."""

    key: CellKey
    reason: str


@dataclass
class Study:
    """An ablation with the results that are there, of all its variants or some.

    Args:
        ablation: titles, variants, baseline.
        results: of finished cells, in the order of the grid.
        failures: of broken ones.
    """

    ablation: Ablation
    results: list[CellResult]
    failures: list[Failure] = field(default_factory=list)

    @property
    def scenes(self) -> list[str]:
        return list(dict.fromkeys(result.scene for result in self.results))

    def of(self, scene: str, variant: str) -> list[CellResult]:
        """The results of all seeds."""
        return [result for result in self.results if (result.scene, result.variant) == (scene, variant)]


class StudyFolder:
    """Where a study is kept: ``ablation.json``, ``cells/SCENE/VARIANT--seedN.json``, and the report beside them."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.cells = path / "cells"

    def require_usable(self) -> None:
        """Raises `InputError` where the folder holds anything but a study, or cannot be one."""
        if self.path.exists() and not self.path.is_dir():
            raise InputError(f"--out '{self.path}' is a file: choose a folder")
        if self.path.is_dir() and any(self.path.iterdir()) and not (self.path / "ablation.json").is_file():
            raise InputError(f"--out '{self.path}' is not empty and holds no ablation: choose a new folder")

    def write_ablation(self, ablation: Ablation) -> None:
        self.path.mkdir(parents=True, exist_ok=True)
        write_text_atomically(self.path / "ablation.json", json.dumps(asdict(ablation), indent=2) + "\n")

    def read_ablation(self) -> Ablation:
        """Raises `InputError` where there is none."""
        path = self.path / "ablation.json"
        if not path.is_file():
            raise InputError(f"'{self.path}' holds no ablation: there is no ablation.json")
        return build_dataclass(Ablation, _read_json(path), str(path))

    def write(self, result: CellResult) -> None:
        """Keep a result; a failure of the same cell is forgotten."""
        path = self.cells / result.key.file
        path.parent.mkdir(parents=True, exist_ok=True)
        mapping = {"format": FORMAT, **_without_nan(asdict(result))}
        write_text_atomically(path, json.dumps(mapping) + "\n")
        self._failure_file(result.key).unlink(missing_ok=True)

    def write_failure(self, failure: Failure) -> None:
        path = self._failure_file(failure.key)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text_atomically(path, failure.reason + "\n")

    def read_results(self) -> dict[CellKey, CellResult]:
        """The finished cells."""
        results = map(_read_result, sorted(self.cells.glob("*/*.json")))
        return {result.key: result for result in results}

    def read_study(self) -> Study:
        """Everything that is there, variants in the order of the ablation, scenes and seeds sorted."""
        ablation = self.read_ablation()
        order = {name: number for number, name in enumerate(ablation.variants)}
        results = list(self.read_results().values())
        for result in results:
            if result.variant not in ablation.variants:
                raise InputError(
                    f"'{self.cells / result.key.file}' is of no variant of the ablation: "
                    f"'{result.variant}', {nearest(result.variant, ablation.variants)}"
                )
        results.sort(key=lambda result: (result.scene, order[result.variant], result.seed))
        return Study(ablation, results, self._failures())

    def _failures(self) -> list[Failure]:
        failures = []
        for path in sorted(self.cells.glob("*/*.failed")):
            variant, _, seed = path.stem.rpartition("--seed")
            failures.append(Failure(CellKey(path.parent.name, variant, int(seed)), path.read_text().strip()))
        return failures

    def _failure_file(self, key: CellKey) -> Path:
        return self.cells / key.file.with_suffix(".failed")


_HINTS = get_type_hints(CellResult)


def merge_studies(sources: list[StudyFolder], target: StudyFolder) -> None:
    """Put the cells of several studies into one; title and baseline are the first one's. The target may be a source.

    Raises:
        InputError: a folder without a study, a variant with two meanings, two different results of one cell, or two
            captures of one name.
    """
    ablations = [source.read_ablation() for source in sources]
    merged = ablations[0]
    for ablation in ablations[1:]:
        for name, overrides in ablation.variants.items():
            if (merged.base, merged.variants.get(name, overrides)) != (ablation.base, overrides):
                raise InputError(f"variant '{name}' has two meanings in what is to be merged")
            merged.variants.setdefault(name, overrides)
        merged.notes = {**ablation.notes, **merged.notes}
    results: dict[CellKey, CellResult] = {}
    captures: dict[str, str] = {}
    for source in sources:
        for result in source.read_study().results:
            if result.capture and captures.setdefault(result.scene, result.capture) != result.capture:
                raise InputError(f"two different captures are called '{result.scene}' in what is to be merged")
            if not _equal(results.setdefault(result.key, result), result):
                raise InputError(f"two different results of the cell {result.key}")
    target.write_ablation(merged)
    for result in results.values():
        target.write(result)


def _equal(first: CellResult, second: CellResult) -> bool:
    """Equality that takes NaN for NaN."""
    return json.dumps(_without_nan(asdict(first))) == json.dumps(_without_nan(asdict(second)))


def _read_result(path: Path) -> CellResult:
    mapping = _read_json(path)
    try:
        if mapping.pop("format") != FORMAT:
            raise ValueError("of another version")
        history = [
            Evaluation(**{name: _number(value) for name, value in entry.items()}) for entry in mapping["history"]
        ]
        if not history:
            raise ValueError("without an evaluation")
        made = mapping["provenance"]
        mapping["provenance"] = None if made is None else Provenance(**made)
        for name in ("scene", "variant", "seed", "asked"):
            mapping[name] = convert(mapping[name], _HINTS[name], name)
        mapping.update(history=history, lpips=_number(mapping["lpips"]), fps=_number(mapping["fps"]))
        return CellResult(**mapping)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"'{path}' is not the result of a cell: {error}") from None


def _read_json(path: Path) -> dict[str, Any]:
    try:
        mapping = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read '{path}': {error}") from None
    if not isinstance(mapping, dict):
        raise InputError(f"'{path}' is not a JSON object")
    return mapping


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _without_nan(value: Any) -> Any:
    """JSON has no NaN: null in its place."""
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
