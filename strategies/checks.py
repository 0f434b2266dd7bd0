"""Checks of the settings of strategies."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields
from typing import Any, Literal, get_args, get_origin, get_type_hints

from turbogs_plugin.errors import require, require_not_negative


def require_settings(instance: Any) -> None:
    """Raise `InputError` where a setting of a strategy breaks the rules that hold for all of them.

    A field of a `Literal` type has one of its values; a number is finite and >= 0. Call it after stricter checks.
    """
    hints = get_type_hints(type(instance))
    for name in [field.name for field in fields(instance) if field.init]:
        value = vars(instance)[name]
        if get_origin(hints[name]) is Literal:
            allowed = get_args(hints[name])
            require(value in allowed, name, value, f"one of {', '.join(allowed)}")
        elif isinstance(value, int | float):
            require_not_negative(instance, name)


def require_each(instance: Any, valid: Callable[[Any], bool], allowed: str, *names: str) -> None:
    """Raise `InputError` unless each of these attributes is `valid`; `allowed` describes the valid values."""
    for name in names:
        value = vars(instance)[name]
        require(valid(value), name, value, allowed)


def require_at_least_one(instance: Any, *names: str) -> None:
    """Raise `InputError` unless each of these attributes is 1 or more."""
    require_each(instance, lambda value: value >= 1, "at least 1", *names)


def require_positive(instance: Any, *names: str) -> None:
    """Raise `InputError` unless each of these attributes is a finite number above 0."""
    require_each(instance, lambda value: 0 < value < math.inf, "a finite number above 0", *names)
