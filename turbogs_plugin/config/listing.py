"""Every setting of a configuration as text, with what it means: the first sentence of its docstring."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator, Mapping
from dataclasses import is_dataclass
from textwrap import fill
from typing import Any, get_type_hints

from turbogs_plugin.config.components import KINDS, strategy_class
from turbogs_plugin.config.configuration import SECTION_CLASSES, Config
from turbogs_plugin.config.typed import settings_of
from turbogs_plugin.strategies import TYPES

WIDTH = 120


def settings_text(config: Config) -> str:
    """Lines ``section.key = value``, each above its meaning; at the end the number of settings of all types.

    A strategy's section shows the settings of its type. The number counts a setting that several types inherit, or
    learning rates, once.
    """
    classes = {kind: strategy_class(kind, getattr(config, kind)["type"]) for kind in KINDS}
    lines: list[str] = []
    for section, values in config.to_mapping().items():
        if section in KINDS:
            lines.append(f"{section}.type = {values.pop('type')}  (one of {', '.join(TYPES[section])})")
        lines += _lines(section, values, classes.get(section) or SECTION_CLASSES[section])
    return "\n".join([*lines, "", f"{len(all_settings())} settings over the types of all sections"]) + "\n"


def all_settings() -> set[tuple[type, str]]:
    """(class that has it, name) of each setting of the sections and of every built-in strategy."""
    found: set[tuple[type, str]] = set()
    strategies = (strategy_class(kind, name) for kind, types in TYPES.items() for name in types)
    waiting = [*SECTION_CLASSES.values(), *strategies]
    while waiting:
        cls = waiting.pop()
        hints = get_type_hints(cls)
        for name in settings_of(cls):
            if is_dataclass(hints[name]):
                waiting.append(hints[name])
            else:
                found.add((next(owner for owner in reversed(cls.__mro__) if name in vars(owner)), name))
    return found


def _lines(place: str, values: Mapping[str, Any], cls: type) -> Iterator[str]:
    meanings, hints = _meanings(cls), get_type_hints(cls)
    for name, value in values.items():
        if is_dataclass(hints[name]):
            yield from _lines(f"{place}.{name}", value, hints[name])
        else:
            yield f"{place}.{name} = {value}"
            yield fill(meanings.get(name, ""), WIDTH, initial_indent="    ", subsequent_indent="    ")


def _meanings(cls: type) -> dict[str, str]:
    """Setting -> the first sentence that the docstring of a class, or of one that it inherits from, has about it."""
    found: dict[str, str] = {}
    for owner in reversed(cls.__mro__):
        _, _, arguments = (inspect.cleandoc(owner.__doc__ or "")).partition("Args:\n")
        for names, text in re.findall(r"^    (\w[\w, \n]*): (.*(?:\n {6,}.*)*)", arguments, re.MULTILINE):
            sentence = re.split(r"(?<=[a-z0-9)`])\. (?=[A-Z`0-9])", " ".join(text.split()))[0].rstrip(".")
            found |= {name.strip(): sentence for name in names.split(",")}
    return found
