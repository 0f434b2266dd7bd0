"""``results.json``: a study in one small file, which its page and its plots are made from.

What cells share is written once: machines and versions, captures, and a common configuration. A cell has its difference
from that, so that its complete configuration can be restored. The measures of its evaluations are columns, with as many
digits as a reader can use. A file that is read and written again comes out the same to the letter.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Any, get_type_hints

from turbogs_plugin.config.typed import build_dataclass, convert, dataclass_mapping
from turbogs_plugin.errors import InputError, nearest
from turbogs_plugin.report.provenance import Provenance
from turbogs_plugin.study.difference import common_configuration, difference, flattened, nested, restored
from turbogs_plugin.study.grid import Ablation
from turbogs_plugin.study.results import CellResult, Failure, Study
from turbogs_plugin.train.history import Evaluation, FurtherErrors

FORMAT = 2
"""Raised by one whenever an older version of TurboGS would misread a new file."""

DECIMALS = {"train_seconds": 6, "psnr": 5, "worst_psnr": 5, **dict.fromkeys(("ssim", "l1", "lpips", "flip"), 7)}
DECIMALS |= dict.fromkeys(("fps", "wall_seconds", "cell_seconds"), 3)
DECIMALS |= {field.name: DECIMALS[field.name.partition("_")[2]] for field in fields(FurtherErrors)}
"""Digits behind the point that are kept of a measure: for errors those that float32 has."""

LEFT_OUT = ("memory_bytes",)
"""Measures of evaluations that the file does not have: a cell's `peak_bytes` is the peak of all of them."""

SHARED = ("provenance", "resolved", "warmup_iterations", "lpips_reason", "asked")
"""Fields of a cell that are written once, as ``common``, and in a cell only where its value is another one."""


@dataclass
class Document:
    """The parts of the file.

    Args:
        ablation, targets, failures: of the study.
        provenances: the different ones; null: not recorded.
        captures: scene -> digest of its capture, for cells that name no other.
        common: field in `SHARED` -> its value in cells that name no other.
        config: the common configuration, ``section.key`` -> value.
        cells: of each, what is not common: fields of `CellResult`, but for ``provenance``, which is a place in
            `provenances`; ``config``, the difference from `config`; ``asked``, the difference from the cell's own
            configuration; and ``history``: field of `Evaluation`, but for `LEFT_OUT`, -> its values, null for NaN, or
            one number where only the last evaluation has one. What is absent has the default.
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
    captures: dict[str, str] = {}
    for result in study.results:
        captures[result.scene] = captures.get(result.scene) or result.capture
    provenances = study.provenances
    cells = [_complete(result, provenances) for result in study.results]
    common = {name: _most_common([cell[name] for cell in cells]) for name in SHARED if cells}
    config = common_configuration([cell["config"] for cell in cells])
    reduced = [_reduced(cell, common | {"capture": captures[cell["scene"]]}, config) for cell in cells]
    shared = (provenances, captures, common, config)
    document = Document(FORMAT, study.ablation, list(study.targets), *shared, study.failures, reduced)
    return _text(dataclass_mapping(document), 2) + "\n"


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
    results = [_result(document, cell, f"{path}.cells[{number}]") for number, cell in enumerate(document.cells)]
    return Study(document.ablation, results, document.failures, document.targets)


def _complete(result: CellResult, provenances: Sequence[Provenance | None]) -> dict[str, Any]:
    """All of a result as the file has it, its configuration complete and flat."""
    config = _placeless(result.config)
    return {name: _rounded(name, value) for name, value in vars(result).items()} | {
        "provenance": provenances.index(result.provenance),
        "config": config,
        "asked": difference(config, _placeless(result.asked)),
        "history": _columns(result.history),
    }


def _placeless(config: Mapping[str, Any]) -> dict[str, Any]:
    """Flat, and with the capture's name for its path: where it lay is of no interest elsewhere."""
    flat = flattened(config)
    if "scene.path" in flat:
        flat["scene.path"] = Path(flat["scene.path"]).name
    return flat


def _reduced(cell: dict[str, Any], common: Mapping[str, Any], config: Mapping[str, Any]) -> dict[str, Any]:
    """What a cell's line says."""
    cell = cell | {"config": difference(config, cell["config"])}
    own = {name: value for name, value in cell.items() if name not in common or value != common[name]}
    return {name: value for name, value in own.items() if name in common or value not in (None, {}, [])}


def _most_common(values: Sequence[Any]) -> Any:
    """Of equal ones, the first; values may be dicts."""
    texts = [json.dumps(value, sort_keys=True) for value in values]
    return values[texts.index(Counter(texts).most_common(1)[0][0])]


def _result(document: Document, cell: dict[str, Any], where: str) -> CellResult:
    cell = document.common | {"capture": document.captures.get(str(cell.get("scene")), "")} | cell
    changes, asked_changes = (
        convert(cell.get(name, {}), dict[str, Any], f"{where}.{name}") for name in ("config", "asked")
    )
    flat = restored(document.config, changes)
    try:
        cell["config"], cell["asked"] = nested(flat), nested(restored(flat, asked_changes))
    except (AttributeError, TypeError):
        raise InputError(f"{where}: its configuration cannot be restored") from None
    place = convert(cell.get("provenance"), int, f"{where}.provenance")
    if not 0 <= place < len(document.provenances):
        raise InputError(f"{where}.provenance: there is no provenance {place}")
    history = _evaluations(cell.get("history", {}), f"{where}.history")
    result = build_dataclass(CellResult, cell | {"provenance": None, "history": []}, where)
    return replace(result, provenance=document.provenances[place], history=history)


def _columns(history: Sequence[Evaluation]) -> dict[str, list[Any]]:
    columns = {}
    for entry in (entry for entry in fields(Evaluation) if entry.name not in LEFT_OUT):
        values = [_rounded(entry.name, getattr(evaluation, entry.name)) for evaluation in history]
        optional = entry.default is not MISSING
        if optional and all(value == _rounded(entry.name, entry.default) for value in values):
            continue
        late = optional and len(values) > 1 and set(values[:-1]) == {None}
        columns[entry.name] = values[-1] if late else values
    return columns


def _evaluations(history: Mapping[str, Any], where: str) -> list[Evaluation]:
    known, types = {entry.name: entry for entry in fields(Evaluation)}, get_type_hints(Evaluation)
    columns: dict[str, list[Any]] = {}
    read = convert(history, dict[str, Any], where)
    count = max((len(values) for values in read.values() if isinstance(values, list)), default=0)
    for name, values in read.items():
        if name not in known:
            raise InputError(f"unknown key '{where}.{name}': {nearest(name, known)}")
        if known[name].default is not MISSING and not isinstance(values, list):
            values = [None] * (count - 1) + [values]
        column = list[int] if types[name] is int else list[float | None]  # null: NaN
        columns[name] = convert(values, column, f"{where}.{name}")
    for name, entry in known.items():
        if entry.default is MISSING and name not in columns:
            raise InputError(f"{where}: key '{name}' is missing")
    lengths = {len(values) for values in columns.values()}
    if len(lengths) != 1 or 0 in lengths:
        raise InputError(f"{where}: columns of one length are needed, with one evaluation at least")
    return [
        Evaluation(**{name: math.nan if value is None else value for name, value in zip(columns, row, strict=True)})
        for row in zip(*columns.values(), strict=True)
    ]


def _rounded(name: str, value: Any) -> Any:
    """A float with the digits that are kept; null where it is not finite, which JSON has no word for."""
    if not isinstance(value, float):
        return value
    return round(value, DECIMALS[name]) if math.isfinite(value) else None


def _text(value: Any, levels: int, indent: str = "") -> str:
    """JSON with a line for each entry of so many levels."""
    if not levels or not value or not isinstance(value, dict | list):
        return json.dumps(value, ensure_ascii=False, separators=(",", ":"))
    below = levels - 1, indent + " "
    if isinstance(value, dict):
        entries = [f"{_text(key, 0)}: {_text(item, *below)}" for key, item in value.items()]
    else:
        entries = [_text(item, *below) for item in value]
    start, end = "{}" if isinstance(value, dict) else "[]"
    return f"{start}\n" + ",\n".join(f"{indent} {entry}" for entry in entries) + f"\n{indent}{end}"
