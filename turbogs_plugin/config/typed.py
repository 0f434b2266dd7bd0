"""Mappings (from YAML) to dataclasses, strictly: unknown keys and wrong types are errors that name the place.

A dataclass is its own configuration: its init fields are the keys, their hints the types, their defaults the only
defaults. A field with ``metadata={"setting": False}`` is for callers in Python alone. OmegaConf's structured
configurations know neither `Literal` nor unions with it (``int | Literal["auto"]``).
"""

from __future__ import annotations

import math
import types
import typing
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import cache
from typing import Any, Literal, TypeVar

from turbogs_plugin.errors import InputError, nearest
from turbogs_plugin.yaml_json import FLOAT

T = TypeVar("T")
UNIONS = (typing.Union, types.UnionType)
NAMES = {float: "a number", int: "a whole number", bool: "true or false", str: "text", type(None): "null"}
"""Type -> what it is called in messages."""


def settings_of(cls: type) -> dict[str, Field[Any]]:
    """The fields of a dataclass that a configuration may set, by name."""
    return {field.name: field for field in fields(cls) if field.init and field.metadata.get("setting", True)}


def build_dataclass(cls: type[T], mapping: Any, where: str, apart: Collection[str] = ()) -> T:
    """An instance of dataclass `cls` from a mapping of its settings as plain YAML values, nested dataclasses as nested
    mappings; those not named keep their defaults. `where` is the dotted place, for messages. Keys that stand `apart`
    are the caller's. Raises `InputError`: an unknown key (naming the nearest), a missing one, a wrong type, or a value
    that the dataclass itself refuses."""
    if not isinstance(mapping, Mapping):
        raise InputError(f"{where}: expected {_named(dict)}, got {mapping!r}")
    try:
        hints = _type_hints(cls)
    except Exception as error:  # whatever the names of a third party's types lead to
        raise InputError(f"{where}: a type of {cls.__name__}'s fields cannot be resolved: {error}") from error
    settings = settings_of(cls)
    for key in mapping:
        if key not in settings and key not in apart:
            raise InputError(f"unknown key '{where}.{key}': {nearest(key, [*settings, *apart])}")
    for name, field in settings.items():
        if name not in mapping and field.default is MISSING and field.default_factory is MISSING:
            raise InputError(f"{where}: key '{name}' is missing")
    values = {key: convert(value, hints[key], f"{where}.{key}") for key, value in mapping.items() if key in settings}
    try:
        return cls(**values)
    except (ValueError, TypeError) as error:
        raise InputError(f"{where}: {error}") from error


_type_hints: Callable[[Any], dict[str, Any]] = cache(typing.get_type_hints)  # evaluates every annotation anew


def dataclass_mapping(instance: Any) -> dict[str, Any]:
    """The settings of a dataclass as plain YAML values: the inverse of `build_dataclass`."""
    return {name: _plain(getattr(instance, name)) for name in settings_of(type(instance))}


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return dataclass_mapping(value)
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return value


def convert(value: Any, hint: Any, where: str) -> Any:
    """`value` as the type that a hint asks for. Raises `InputError` where it is of another type.

    A whole number becomes a float where one is asked for, and ``5e3`` an integer; nothing else changes its type. A hint
    that is no YAML type is not checked here: the dataclass checks such a field itself.
    """
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if is_dataclass(hint) and isinstance(hint, type):
        return build_dataclass(hint, value, where)
    if origin in UNIONS:
        for argument in arguments:
            with suppress(InputError):
                return convert(value, argument, where)
    elif origin in (tuple, list):
        if isinstance(value, tuple | list):
            return origin(convert(item, arguments[0], f"{where}[{place}]") for place, item in enumerate(value))
    elif origin is dict:
        if isinstance(value, Mapping):
            items = value.items()
            return {convert(key, str, where): convert(item, arguments[1], f"{where}.{key}") for key, item in items}
    elif hint in (float, int):
        if number and not math.isnan(value) and (hint is float or (abs(value) < 2**63 and value == int(value))):
            return hint(value)
    elif origin is Literal:
        if value in arguments:
            return value
    elif hint not in NAMES or isinstance(value, hint):
        return value
    quoted = isinstance(value, str) and FLOAT.match(value)
    raise InputError(f"{where}: expected {_named(hint)}, got {value!r}{': leave out its quotes' if quoted else ''}")


def _named(hint: Any) -> str:
    """What values of a type are called in messages."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in UNIONS:
        return " or ".join(map(_named, arguments))
    if origin is Literal:
        return " or ".join(map(str, arguments))
    if origin in (tuple, list):
        return "a list, as [A, B]"
    return NAMES.get(hint, "keys and values, as {KEY: VALUE} or each in a line of its own")
