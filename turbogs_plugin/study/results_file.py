"""``results.json``: a study in one small file, which its page and its plots are made from.

What cells share is written once: machines and versions, captures, and a common configuration. A cell has its difference
from that, so that its complete configuration can be restored. The measures of its evaluations are columns, with as many
digits as a reader can use. A file that is read and written again comes out the same to the letter.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, get_type_hints

from turbogs_plugin.config.schema import build_dataclass, convert, dataclass_mapping, nearest
from turbogs_plugin.errors import InputError
from turbogs_plugin.report.provenance import Provenance
from turbogs_plugin.study.difference import common_configuration, difference, flattened, nested, restored
from turbogs_plugin.study.grid import Ablation
from turbogs_plugin.study.results import CellResult, Failure, Study
from turbogs_plugin.train.history import Evaluation

FORMAT = 2
"""Raised where an older reader would take a file for something else."""

DECIMALS = {"train_seconds": 6, "psnr": 5, "worst_psnr": 5, "ssim": 7, "l1": 7, "lpips": 7, "fps": 3}
"""Digits behind the point that are kept of a measure: for errors those that float32 has."""

SHARED = ("provenance", "resolved", "warmup_iterations", "lpips_reason")
"""Fields of a cell that are written once, as ``common``, and in a cell only where its value is another one."""

_EVALUATION_TYPES = get_type_hints(Evaluation)
_EVALUATION_DEFAULTS = {entry.name: entry.default for entry in fields(Evaluation)}


@dataclass
class StoredCell:
    """A cell as a file has it, together with what is common.

    Args:
        scene, variant, seed, capture, resolved, warmup_iterations, lpips_reason, peak_bytes: as in `CellResult`.
        provenance: place in the document's list.
        config: its difference from the document's.
        asked: the difference of what was asked for from the cell's own configuration.
        lpips, fps: null where not computed or not recorded.
        history: field of `Evaluation` -> its values. A field that has its default all along is left out.
    """

    scene: str
    variant: str
    seed: int
    capture: str
    provenance: int
    resolved: bool
    warmup_iterations: int
    lpips_reason: str
    config: dict[str, Any] = field(default_factory=dict)
    asked: dict[str, Any] = field(default_factory=dict)
    lpips: float | None = None
    fps: float | None = None
    peak_bytes: int | None = None
    history: dict[str, list[Any]] = field(default_factory=dict)


@dataclass
class Document:
    """The parts of the file.

    Args:
        ablation, targets, failures: of the study.
        provenances: the different ones; null: not recorded.
        captures: scene -> digest of its capture, for cells that name no other.
        common: field in `SHARED` -> its value in cells that name no other.
        config: the common configuration, ``section.key`` -> value.
        cells: fields of `StoredCell`, without what is common, nulls and empty differences.
    """

    format: int
    ablation: Ablation
    targets: list[float]
    provenances: list[Provenance | None]
    captures: dict[str, str]
    common: dict[str, Any]
    config: dict[str, Any]
    failures: list[Failure]
    cells: list[dict[str, Any]]


def study_to_json(study: Study) -> str:
    """The text of the file."""
    provenances: list[Provenance | None] = []
    captures: dict[str, str] = {}
    cells = []
    for result in study.results:
        if result.provenance not in provenances:
            provenances.append(result.provenance)
        captures[result.scene] = captures.get(result.scene) or result.capture
        cells.append(_stored(result, provenances.index(result.provenance)))
    common = {name: Counter(getattr(cell, name) for cell in cells).most_common(1)[0][0] for name in SHARED if cells}
    config = common_configuration([cell.config for cell in cells])
    document = Document(
        format=FORMAT,
        ablation=study.ablation,
        targets=list(study.targets),
        provenances=provenances,
        captures=captures,
        common=common,
        config=config,
        failures=study.failures,
        cells=[_reduced(cell, common | {"capture": captures[cell.scene]}, config) for cell in cells],
    )
    return _two_levels(dataclass_mapping(document))


def study_from_json(path: Path) -> Study:
    """The study of a file. Raises `InputError`, naming the place in it, where it is none of this version's."""
    try:
        mapping = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read '{path}': {error}") from None
    if not isinstance(mapping, dict) or "format" not in mapping:
        raise InputError(f"'{path}' does not hold the results of a study")
    if mapping["format"] != FORMAT:
        raise InputError(f"'{path}' is of format {mapping['format']}: this version of TurboGS reads format {FORMAT}")
    document = build_dataclass(Document, mapping, str(path))
    results = [_result(document, number, f"{path}.cells[{number}]") for number in range(len(document.cells))]
    return Study(document.ablation, results, document.failures, document.targets)


def _stored(result: CellResult, provenance: int) -> StoredCell:
    """All of a result, its configuration complete and flat."""
    config = _placeless(result.config)
    return StoredCell(
        scene=result.scene,
        variant=result.variant,
        seed=result.seed,
        capture=result.capture,
        provenance=provenance,
        resolved=result.resolved,
        warmup_iterations=result.warmup_iterations,
        lpips_reason=result.lpips_reason,
        config=config,
        asked=difference(config, _placeless(result.asked_config)),
        lpips=_rounded("lpips", result.lpips),
        fps=_rounded("fps", result.fps),
        peak_bytes=result.peak_bytes,
        history=_columns(result.history),
    )


def _placeless(config: Mapping[str, Any]) -> dict[str, Any]:
    """Flat, and with the capture's name for its path: where it lay is of no interest elsewhere."""
    flat = flattened(config)
    if "scene.path" in flat:
        flat["scene.path"] = Path(flat["scene.path"]).name
    return flat


def _reduced(cell: StoredCell, common: Mapping[str, Any], config: Mapping[str, Any]) -> dict[str, Any]:
    """What a cell's line says."""
    changed = replace(cell, config=difference(config, cell.config))
    return {
        name: value
        for name, value in dataclass_mapping(changed).items()
        if value is not None and value != {} and not (name in common and value == common[name])
    }


def _result(document: Document, number: int, where: str) -> CellResult:
    own = document.cells[number]
    captured = {"capture": document.captures.get(str(own.get("scene")), "")}
    cell = build_dataclass(StoredCell, document.common | captured | own, where)
    if not 0 <= cell.provenance < len(document.provenances):
        raise InputError(f"{where}.provenance: there is no provenance {cell.provenance}")
    flat = restored(document.config, cell.config)
    try:
        config, asked = nested(flat), nested(restored(flat, cell.asked))
    except (AttributeError, TypeError):
        raise InputError(f"{where}: its configuration cannot be restored") from None
    return CellResult(
        scene=cell.scene,
        variant=cell.variant,
        seed=cell.seed,
        config=config,
        history=_evaluations(cell.history, f"{where}.history"),
        asked={name: section for name, section in asked.items() if section != config.get(name)},
        resolved=cell.resolved,
        lpips=math.nan if cell.lpips is None else cell.lpips,
        lpips_reason=cell.lpips_reason,
        fps=math.nan if cell.fps is None else cell.fps,
        peak_bytes=cell.peak_bytes,
        warmup_iterations=cell.warmup_iterations,
        provenance=document.provenances[cell.provenance],
        capture=cell.capture,
    )


def _columns(history: list[Evaluation]) -> dict[str, list[Any]]:
    columns = {
        name: [_rounded(name, getattr(evaluation, name)) for evaluation in history] for name in _EVALUATION_DEFAULTS
    }
    return {
        name: values
        for name, values in columns.items()
        if (default := _EVALUATION_DEFAULTS[name]) is MISSING
        or any(value != _rounded(name, default) for value in values)
    }


def _evaluations(columns: Mapping[str, list[Any]], where: str) -> list[Evaluation]:
    for name in columns:
        if name not in _EVALUATION_TYPES:
            raise InputError(f"unknown key '{where}.{name}': {nearest(name, _EVALUATION_TYPES)}")
    for name, default in _EVALUATION_DEFAULTS.items():
        if default is MISSING and name not in columns:
            raise InputError(f"{where}: key '{name}' is missing")
    lengths = {len(values) for values in columns.values()}
    if len(lengths) > 1 or 0 in lengths:
        raise InputError(f"{where}: columns of one length are needed, with one evaluation at least")
    return [
        Evaluation(**{name: _number(values[row], name, f"{where}.{name}[{row}]") for name, values in columns.items()})
        for row in range(lengths.pop())
    ]


def _number(value: Any, name: str, where: str) -> float:
    kind = _EVALUATION_TYPES[name]
    return math.nan if value is None and kind is float else convert(value, kind, where)


def _rounded(name: str, value: float) -> float | None:
    """With the digits that are kept; null where it is not finite, which JSON has no word for."""
    if isinstance(value, int):
        return value
    return round(value, DECIMALS[name]) if math.isfinite(value) else None


def _two_levels(mapping: Mapping[str, Any]) -> str:
    """JSON with a line for each entry of what stands at the top."""
    parts = []
    for name, value in mapping.items():
        if isinstance(value, dict) and value:
            inner = ",\n".join(f"  {_compact(key)}: {_compact(item)}" for key, item in value.items())
            parts.append(f" {_compact(name)}: {{\n{inner}\n }}")
        elif isinstance(value, list) and value:
            inner = ",\n".join(f"  {_compact(item)}" for item in value)
            parts.append(f" {_compact(name)}: [\n{inner}\n ]")
        else:
            parts.append(f" {_compact(name)}: {_compact(value)}")
    return "{\n" + ",\n".join(parts) + "\n}\n"


def _compact(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"))
