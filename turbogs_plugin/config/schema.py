"""Mappings (from YAML) to dataclasses, strictly: unknown keys and wrong types are errors that name the place."""

from __future__ import annotations

import difflib
import math
import types
import typing
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from typing import Any, TypeVar

from turbogs_plugin.errors import InputError

T = TypeVar("T")


def nearest(name: str, known: Iterable[str]) -> str:
    """A hint for an unknown name: the nearest known one, where one is near, and all of them."""
    known = sorted(known)
    close = difflib.get_close_matches(str(name), known, n=1, cutoff=0.5)
    all_known = ", ".join(known) or "none"
    return f"did you mean '{close[0]}'? (known: {all_known})" if close else f"known are {all_known}"


def build_dataclass(cls: type[T], mapping: Mapping[str, Any], where: str) -> T:
    """An instance of dataclass `cls` from a mapping of its init fields; fields not named keep their defaults.

    Args:
        cls: a dataclass with resolvable type hints.
        mapping: plain YAML values; nested dataclasses are nested mappings.
        where: dotted place, for messages.

    Raises:
        InputError: an unknown key (naming the nearest), a missing one, a wrong type, or a value that the
            dataclass itself refuses.
    """
    if not isinstance(mapping, Mapping):
        raise InputError(f"{where}: expected a mapping of keys, got {mapping!r}")
    try:
        hints = _type_hints(cls)
    except Exception as error:  # whatever the names of a third party's types lead to
        raise InputError(f"{where}: a type of {cls.__name__}'s fields cannot be resolved: {error}") from error
    init_fields = {field.name: field for field in fields(cls) if field.init}
    for key in mapping:
        if key not in init_fields:
            named = f"{where}: unknown key '{key}'" if "'" in where else f"unknown key '{where}.{key}'"
            raise InputError(f"{named}: {nearest(key, init_fields)}")
    for name, field in init_fields.items():
        if name not in mapping and field.default is MISSING and field.default_factory is MISSING:
            raise InputError(f"{where}: key '{name}' is missing")
    values = {key: convert(value, hints[key], f"{where}.{key}") for key, value in mapping.items()}
    try:
        return cls(**values)
    except (ValueError, TypeError) as error:
        raise InputError(f"{where}: {error}") from error


_type_hints = cache(typing.get_type_hints)  # it evaluates every annotation of the class again


def dataclass_mapping(instance: Any) -> dict[str, Any]:
    """The init fields of a dataclass as plain YAML values: the inverse of `build_dataclass`."""
    return {field.name: _plain(getattr(instance, field.name)) for field in fields(instance) if field.init}


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return dataclass_mapping(value)
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return value


def convert(value: Any, hint: Any, where: str) -> Any:
    """`value` as the type that a hint asks for.

    A whole number becomes a float where one is asked for, and ``5e3`` an integer; nothing else changes its type. A hint
    that is no YAML type is not checked here: the dataclass checks such a field itself.
    """
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if is_dataclass(hint):
        return build_dataclass(hint, value, where)
    if origin in (typing.Union, types.UnionType):
        return _convert_union(value, arguments, where)
    if origin is typing.Literal:
        if value not in arguments:
            raise InputError(f"{where}: {value!r} is not one of {', '.join(map(repr, arguments))}")
        return value
    if origin in (tuple, list):
        return _convert_sequence(value, origin, arguments, where)
    if origin is dict:
        if not isinstance(value, Mapping):
            raise InputError(f"{where}: expected a mapping of keys, got {value!r}")
        for key in value:
            if arguments[0] is str and not isinstance(key, str):
                raise InputError(f"{where}: the name {key!r} is not text: put it in quotes, '{key}'")
        return {key: convert(item, arguments[1], f"{where}.{key}") for key, item in value.items()}
    return _convert_scalar(value, hint, where)


SCALARS = {float: "a number", int: "a whole number", bool: "true or false", str: "text", type(None): "null"}
"""Type -> what it is called in messages."""


def _named(hint: Any) -> str:
    """What a scalar or the values of a `Literal` are called in messages; "" for any other type."""
    if typing.get_origin(hint) is typing.Literal:
        return " or ".join(map(str, typing.get_args(hint)))
    return SCALARS.get(hint, "")


def _convert_scalar(value: Any, hint: Any, where: str) -> Any:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if hint is float and number and not math.isnan(value):
        return float(value)
    if hint is int and number and math.isfinite(value) and value == int(value):
        return int(value)
    if hint in (int, float) or (hint in SCALARS and not isinstance(value, hint)):
        raise InputError(f"{where}: expected {SCALARS[hint]}, got {value!r}")
    return value


def _convert_sequence(value: Any, origin: type, arguments: tuple, where: str) -> Any:
    if not isinstance(value, list | tuple):
        remedy = f": write [{value}]" if isinstance(value, str) else ""
        raise InputError(f"{where}: expected a list, got {value!r}{remedy}")
    if origin is tuple and not (len(arguments) == 2 and arguments[1] is Ellipsis):
        if len(value) != len(arguments):
            raise InputError(f"{where}: expected {len(arguments)} values, got {len(value)}")
        items = zip(value, arguments, strict=True)
    else:
        items = ((item, arguments[0]) for item in value)
    return origin(convert(item, hint, f"{where}[{index}]") for index, (item, hint) in enumerate(items))


def _convert_union(value: Any, arguments: tuple, where: str) -> Any:
    messages = []
    for argument in arguments:
        try:
            return convert(value, argument, where)
        except InputError as error:
            messages.append(str(error))
    named = [_named(argument) for argument in arguments]
    if all(named):
        raise InputError(f"{where}: expected {' or '.join(named)}, got {value!r}")
    concrete = [argument for argument in arguments if argument is not type(None)]
    if len(concrete) == 1:
        raise InputError(messages[arguments.index(concrete[0])])
    reasons = "; nor: ".join(message.removeprefix(f"{where}: ") for message in messages)
    raise InputError(f"{where}: {reasons}")
