"""What a launch is, and the four lists that it is sent as."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from operator import attrgetter
from typing import Any, ClassVar

LAUNCHES: list[type[Launch]] = []
"""All launches."""

KINDS = {"Tensor": 0, "Tensor | None": 0, "int": 1, "bool": 1, "float": 2, "list[int]": 3}
"""Type of a field -> the list it travels in: tensors, integers, reals, rows of views."""


class Launch:
    """A call of an operator.

    Attributes:
        operator: name of the operator: the class's name in snake case.
        paths: dotted paths of the fields in each of the four lists, in order. The tensors of a field ``list[Tensor]``,
            of which a launch has one at most, follow all other tensors.
    """

    operator: ClassVar[str]
    paths: ClassVar[tuple[list[str], list[str], list[str], list[str]]]
    _readers: ClassVar[tuple[Callable[[Any], tuple], ...]]

    def __init_subclass__(cls) -> None:
        cls.operator = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", cls.__name__).lower()
        cls.paths = _paths(cls)
        tensors, integers, reals = map(_reader, cls.paths[:3])
        for name in (name for name, kind in cls.__annotations__.items() if kind == "list[Tensor]"):
            tensors = _joined(tensors, attrgetter(name))
        rows = cls.paths[3]
        cls._readers = tensors, integers, reals, attrgetter(*rows) if rows else _reader(rows)
        LAUNCHES.append(cls)

    def lists(self) -> tuple[tuple, tuple, tuple, tuple]:
        """The four lists. They are read for every launch: `attrgetter` is as fast as code written for each class."""
        tensors, integers, reals, rows = self._readers
        return tensors(self), integers(self), reals(self), rows(self)


def fields_of(**kinds: str) -> type:
    """A type for an object of another module, of which a launch reads these fields: names by type."""
    return type(
        "Fields", (), {"__annotations__": {name: kind for kind, names in kinds.items() for name in names.split()}}
    )


def nested_type(cls: type, annotation: str) -> type:
    """The class that an annotation of this class's file names."""
    return getattr(sys.modules[cls.__module__], annotation)


def _paths(cls: type, prefix: str = "") -> tuple[list[str], list[str], list[str], list[str]]:
    """Dotted paths of the tensors, integers, reals and rows of a class, in the order of its fields."""
    paths: tuple[list[str], list[str], list[str], list[str]] = ([], [], [], [])
    for name, annotation in cls.__annotations__.items():
        if annotation in KINDS:
            paths[KINDS[annotation]].append(prefix + name)
        elif annotation != "list[Tensor]":
            for mine, nested in zip(paths, _paths(nested_type(cls, annotation), f"{prefix}{name}."), strict=True):
                mine.extend(nested)
    return paths


def _reader(paths: list[str]) -> Callable[[Any], tuple]:
    """A function that reads the values at these paths of a launch."""
    if len(paths) > 1:
        return attrgetter(*paths)
    read = attrgetter(paths[0]) if paths else None
    return lambda launch: () if read is None else (read(launch),)


def _joined(first: Callable[[Any], tuple], second: Callable[[Any], list]) -> Callable[[Any], tuple]:
    return lambda launch: (*first(launch), *second(launch))
