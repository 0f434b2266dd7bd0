"""Checks of the settings of strategies, and of what losses are called with."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any, Literal, get_args, get_origin, get_type_hints

from torch import Tensor

from turbogs_plugin.errors import InputError, is_number, require
from turbogs_plugin.types import PixelSamples


def require_settings(instance: Any) -> None:
    """Raise `InputError` where a setting of a strategy is of another type, or breaks the rules that hold for all: a
    field of a `Literal` type has one of its values; a number is 0 .. 1e30: fit for float32. Call it after others."""
    hints = get_type_hints(type(instance))
    for name in [field.name for field in fields(instance) if field.init]:
        value, hint = vars(instance)[name], hints[name]
        classed = hint is bool or is_dataclass(hint)
        if get_origin(hint) is Literal:
            require(value in get_args(hint), name, value, f"one of {', '.join(get_args(hint))}")
        elif hint in (int, float):
            valid = is_number(value, whole=hint is int) and 0 <= value <= 1e30
            require(valid, name, value, f"a {'whole' if hint is int else 'finite'} number >= 0, at most 1e30")
        elif classed:
            require(isinstance(value, hint), name, value, f"a {hint.__name__}")


def require_each(instance: Any, valid: Callable[[Any], bool], allowed: str, *names: str) -> None:
    """Raise `InputError` unless each of these attributes is a `valid` number; `allowed` describes the valid ones."""
    for name in names:
        value = vars(instance)[name]
        require(is_number(value) and valid(value), name, value, allowed)


def require_at_least_one(instance: Any, *names: str) -> None:
    """Raise `InputError` unless each of these attributes is 1 or more."""
    require_each(instance, lambda value: value >= 1, "at least 1", *names)


def require_positive(instance: Any, *names: str) -> None:
    """Raise `InputError` unless each of these attributes is a finite number above 0."""
    require_each(instance, lambda value: 0 < value < math.inf, "a finite number above 0", *names)


def check_samples(samples: Any) -> None:
    """Raise `InputError` unless these are samples."""
    if not isinstance(samples, PixelSamples):
        raise InputError(f"samples is a {type(samples).__name__}: expected the PixelSamples that a sampler drew")


def check_colors(colors: Any, targets: Any, samples: Any) -> None:
    """Raise `InputError` unless these are samples and two colours of each. Values are not looked at: no GPU waits."""
    check_samples(samples)
    for name, value in (("colors", colors), ("targets", targets)):
        if not isinstance(value, Tensor) or not value.is_floating_point() or value.shape != (len(samples), 3):
            found = f"{value.dtype} {tuple(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
            raise InputError(f"{name} is {found}: expected a tensor, floating point {(len(samples), 3)} as samples are")
