"""Reading YAML from untrusted sources: plain values only, in bounded memory."""

from __future__ import annotations

from copy import deepcopy
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from turbogs_plugin.config.schema import nearest
from turbogs_plugin.errors import InputError

SIZE_LIMIT = 64 * 1024
"""Bytes of a configuration file. Ours have about three thousand."""

DEPTH_LIMIT = 16
"""Levels of nesting, well above what any configuration has."""


def packaged_names(package: str) -> list[str]:
    """Names of the YAML files that come with TurboGS in a package."""
    entries = resources.files(package).iterdir()
    return sorted(entry.name.removesuffix(".yaml") for entry in entries if entry.name.endswith(".yaml"))


def read_named_yaml(name_or_file: str, package: str, kind: str) -> dict[str, Any]:
    """The mapping in a packaged YAML file, or in one on the disk.

    Args:
        kind: what such files are, for messages.

    Raises:
        InputError: an unknown name, or an unreadable file.
    """
    known = packaged_names(package)
    if name_or_file in known:
        text = (resources.files(package) / f"{name_or_file}.yaml").read_text(encoding="utf-8")
        return parse_yaml(text, f"{kind} '{name_or_file}'")
    path = Path(name_or_file)
    if path.suffix in (".yaml", ".yml") or path.is_file():
        return read_yaml(path)
    raise InputError(f"unknown {kind} '{name_or_file}': {nearest(name_or_file, known)}, or a .yaml file")


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file.

    Raises:
        InputError: no such file, too large, not UTF-8, or refused by `parse_yaml`.
    """
    try:
        with open(path, "rb") as file:
            data = file.read(SIZE_LIMIT + 1)
    except OSError as error:
        raise InputError(f"cannot read config '{path}': {error.strerror}") from None
    if len(data) > SIZE_LIMIT:
        raise InputError(f"config '{path}' has more than {SIZE_LIMIT} bytes")
    try:
        return parse_yaml(data.decode("utf-8"), f"config '{path}'")
    except UnicodeDecodeError:
        raise InputError(f"config '{path}' is not UTF-8 text") from None


def parse_yaml(text: str, where: str) -> dict[str, Any]:
    """The mapping in a YAML text, numbers as YAML 1.2 reads them (``1e-4`` is a float).

    Tags, anchors and aliases are refused before anything is built: they can run code or grow without bound.
    ``${...}`` stays text.

    Args:
        where: what the text is, for messages: ``config 'my.yaml'``.

    Raises:
        InputError: not YAML, not one mapping, nested too deeply, or with tags, anchors or aliases.
    """
    return deepcopy(_parsed(text, where))


@lru_cache(maxsize=128)  # bases of variants and texts of overrides come again and again
def _parsed(text: str, where: str) -> dict[str, Any]:
    try:
        _refuse_unsafe(text, where)
        return OmegaConf.to_container(OmegaConf.create(text), resolve=False)
    except (yaml.YAMLError, OmegaConfBaseException, ValueError) as error:
        if isinstance(error, InputError):
            raise
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        mark = getattr(error, "problem_mark", None)
        place = f" (line {mark.line + 1})" if mark else ""
        raise InputError(f"{where} is not valid YAML{place}: {problem}") from None


def _refuse_unsafe(text: str, where: str) -> None:
    depth, roots = 0, []
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        place = f"{where} (line {event.start_mark.line + 1})"
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
            raise InputError(f"{place}: anchors and aliases are not allowed")
        if getattr(event, "tag", None):
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
        raise InputError(f"{where}: expected a mapping of sections, got {found}")
