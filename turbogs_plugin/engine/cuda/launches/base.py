"""What a launch is, and the four lists that it is sent as."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from typing import ClassVar

LAUNCHES: list[type[Launch]] = []
"""All launches."""


class Launch:
    """A call of an operator.

    Attributes:
        operator: its name, that of the class in snake case.
        paths: dotted paths of the fields in each of the four lists, in order.
    """

    operator: ClassVar[str]
    paths: ClassVar[tuple[list[str], ...]]

    def __init_subclass__(cls) -> None:
        cls.operator = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", cls.__name__).lower()
        cls.paths = _paths(cls)
        cls.lists = _reader(*cls.paths)
        LAUNCHES.append(cls)

    def lists(self) -> tuple[tuple, ...]:
        """The four lists."""


def fields_of(kind: str, names: str) -> type:
    """A type for an object of another module, of which a launch reads these fields, all of one kind."""
    return type("Fields", (), {"__annotations__": dict.fromkeys(names.split(), kind)})


def annotations(cls: type) -> dict[str, str]:
    """Name -> type of the fields of a class, those of its bases first."""
    own = (vars(base).get("__annotations__", {}) for base in reversed(cls.__mro__) if base is not Launch)
    return dict(field for fields in own for field in fields.items())


def nested_type(cls: type, annotation: str) -> type:
    """What an annotation of this class's file names."""
    return getattr(sys.modules[cls.__module__], annotation)


def _paths(cls: type, prefix: str = "") -> tuple[list[str], list[str], list[str], list[str]]:
    """Dotted paths of the tensors, integers, reals and rows of a class, in the order of its fields."""
    paths = [], [], [], []
    kinds = {"Tensor": 0, "Tensor | None": 0, "int": 1, "bool": 1, "float": 2, "list[int]": 3}
    for name, annotation in annotations(cls).items():
        if annotation in kinds:
            paths[kinds[annotation]].append(prefix + name)
        else:
            for mine, nested in zip(paths, _paths(nested_type(cls, annotation), f"{prefix}{name}."), strict=True):
                mine.extend(nested)
    return paths


def _reader(tensors: list[str], integers: list[str], reals: list[str], rows: list[str]) -> Callable[[Launch], tuple]:
    """A function that reads the lists from a launch. It is generated as code, because it runs for every launch."""
    lists = ["(" + "".join(f"launch.{path}, " for path in paths) + ")" for paths in (tensors, integers, reals)]
    return eval(f"lambda launch: ({', '.join(lists)}, {f'launch.{rows[0]}' if rows else '()'})")
