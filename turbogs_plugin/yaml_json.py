"""YAML and JSON from untrusted sources, read as plain values in bounded memory; and YAML as it is written.

Every module that reads or writes YAML or JSON goes through this one.
"""

from __future__ import annotations

import json
import math
import re
from contextlib import suppress
from copy import deepcopy
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from turbogs_plugin.errors import InputError, nearest

SIZE_LIMIT, DEPTH_LIMIT = 64 * 1024, 16
"""Bytes of a configuration file, of which the packaged ones have about three thousand, and levels of its nesting."""
JSON_LIMIT = 64 * 2**20
"""Bytes of a JSON file, and letters of a JSON text. A photo of a transforms.json takes about one thousand."""
FLOAT = re.compile(
    r"""(?:[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?  # 0.25, 1e-4, .5
    |[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$""",
    re.VERBOSE,
)
"""A number of YAML 1.2. PyYAML's own rule, of YAML 1.1, takes 1e-4 for text."""
SYNTAX = "; write one key: value a line, those of a section indented alike by spaces, and close brackets and quotes"


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader with numbers of YAML 1.2, dates as text, and no key twice."""

    yaml_implicit_resolvers = {  # noqa: RUF012 - PyYAML's own form
        first: [(tag, rule) for tag, rule in rules if not tag.endswith(":timestamp")]
        for first, rules in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        result = super().construct_mapping(node, deep)
        if len(result) < len(node.value):
            keys = [key.value for key, _ in node.value]
            twice = next((key for at, (key, _) in enumerate(node.value) if key.value in keys[:at]), node)
            raise yaml.constructor.ConstructorError(None, None, "a key is there twice: keep one", twice.start_mark)
        return result

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        value = super().construct_yaml_int(node)
        if abs(value) >> 63:  # no float, nor text, has room for any number
            raise yaml.constructor.ConstructorError(None, None, "a whole number of more than 63 bits", node.start_mark)
        return value


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)


class _Dumper(yaml.SafeDumper):
    """PyYAML's safe dumper, with quotes around text that `_Loader` would take for a number."""


for _kind in (_Loader, _Dumper):
    _kind.add_implicit_resolver("tag:yaml.org,2002:float", FLOAT, [*"-+.0123456789"])


def packaged_names(package: str) -> list[str]:
    """Names of the YAML files that come with TurboGS in a package."""
    entries = resources.files(package).iterdir()
    return sorted(entry.name.removesuffix(".yaml") for entry in entries if entry.name.endswith(".yaml"))


def read_named_yaml(name_or_file: str, package: str, kind: str) -> dict[str, Any]:
    """The mapping in a packaged YAML file, or in one on the disk.

    `kind` is what such files are, for messages. Raises `InputError` for an unknown name, or an unreadable file.
    """
    known = packaged_names(package)
    if name_or_file in known:
        text = (resources.files(package) / f"{name_or_file}.yaml").read_text(encoding="utf-8")
        return parse_yaml(text, f"{kind} '{name_or_file}'")
    path = Path(name_or_file)
    if path.suffix in (".yaml", ".yml") or path.is_file():
        return read_yaml(path, kind)
    raise InputError(f"unknown {kind} '{name_or_file}': {nearest(name_or_file, known)}, or a .yaml file")


def read_yaml(path: Path, kind: str = "config") -> dict[str, Any]:
    """The mapping in a YAML file. Raises `InputError`: no such file, too large, no UTF-8, refused by `parse_yaml`."""
    try:
        with open(path, "rb") as file:
            data = file.read(SIZE_LIMIT + 1)
    except OSError as error:
        raise InputError(f"cannot read {kind} '{path}': {error.strerror}") from None
    if len(data) > SIZE_LIMIT:
        raise InputError(f"{kind} '{path}' has more than {SIZE_LIMIT} bytes")
    try:
        return parse_yaml(data.decode("utf-8"), f"{kind} '{path}'")
    except UnicodeDecodeError:
        raise InputError(f"{kind} '{path}' is not UTF-8 text") from None


def parse_yaml(text: str, where: str) -> dict[str, Any]:
    """The mapping in a YAML text, numbers as YAML 1.2 reads them (``1e-4`` is a float). `where` is what the text is,
    for messages: ``config 'my.yaml'``. Raises `InputError`: not YAML, not one mapping, nested too deeply; or with tags,
    anchors or aliases, which can run code or grow without bound and are refused before anything is built."""
    return deepcopy(_parsed(text, where))


@lru_cache(maxsize=128)  # bases of variants and texts of overrides come again and again
def _parsed(text: str, where: str) -> dict[str, Any]:
    try:
        _refuse_unsafe(text, where)
        return yaml.load(text, _Loader)
    except InputError:
        raise
    except (yaml.YAMLError, ValueError, OverflowError) as error:  # the last two: digits that Python does not convert
        place, problem = "", str(error).splitlines()[0]
        if isinstance(error, yaml.MarkedYAMLError):
            unclosed = re.search("flow|quoted", error.context or "")  # which is told by its beginning
            mark = error.context_mark if unclosed else error.problem_mark
            place = f" (line {mark.line + 1})" if mark else ""
            problem = str(error.problem).replace(r"character '\t' that cannot start any token", "a tab")
            problem += SYNTAX if isinstance(error, yaml.scanner.ScannerError | yaml.parser.ParserError) else ""
        raise InputError(f"{where} is not valid YAML{place}: {problem}") from None


def _refuse_unsafe(text: str, where: str) -> None:
    depth, roots = 0, []
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        place = f"{where} (line {event.start_mark.line + 1})" if event.start_mark else where
        if isinstance(event, yaml.AliasEvent) or (isinstance(event, yaml.NodeEvent) and event.anchor):
            raise InputError(f"{place}: anchors and aliases are not allowed")
        if isinstance(event, yaml.ScalarEvent | yaml.CollectionStartEvent) and event.tag:
            raise InputError(f"{place}: tags are not allowed: {event.tag}")
        if depth == 0 and isinstance(event, yaml.NodeEvent):
            roots.append(event)
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > DEPTH_LIMIT:
            raise InputError(f"{where} is nested more than {DEPTH_LIMIT} levels deep")
    if len(roots) != 1:
        raise InputError(f"{where}: expected one YAML document, found {len(roots)}")
    if not isinstance(roots[0], yaml.MappingStartEvent):
        found = f"the text '{roots[0].value[:40]}'" if isinstance(roots[0], yaml.ScalarEvent) else "a list"
        raise InputError(f"{where}: expected keys and values, as KEY: VALUE, got {found}")


def yaml_text(mapping: dict[str, Any]) -> str:
    """A mapping of plain values as YAML, in its own order; `parse_yaml` gives the mapping back."""
    return yaml.dump(mapping, Dumper=_Dumper, sort_keys=False, allow_unicode=True)


def require_json_size(path: Path) -> None:
    """Raise `InputError` where a file is longer than `JSON_LIMIT`, before it is read."""
    with suppress(OSError):  # whoever reads it says why that cannot be
        _require_length(path.stat().st_size, str(path))


def _require_length(length: int, where: str) -> None:
    if length > JSON_LIMIT:
        raise InputError(f"{where} has more than {JSON_LIMIT >> 20} MiB: take out what is not needed")


def _whole(digits: str) -> int | float:
    """A number without a point; a float where it has more digits than 63 bits. `ValueError`: no float has as many."""
    if not math.isfinite(number := float(digits)):
        raise ValueError(f"a number of {len(digits)} digits")
    return int(digits) if len(digits) < 19 else number


def parse_json(text: str, where: str) -> Any:
    """The value in a JSON text. Raises `InputError`: longer than `JSON_LIMIT`, not JSON, or nested more deeply than
    Python's parser follows. `where` is what the text is, for messages: ``'transforms.json'``."""
    _require_length(len(text), where)
    try:
        return json.loads(text, parse_int=_whole)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where} is not valid JSON: {error}") from None
