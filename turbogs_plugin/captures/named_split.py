"""A split by name: the lists ``train_filenames``, ``val_filenames`` and ``test_filenames`` of a transforms.json."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from turbogs_plugin.errors import InputError

TRAIN, VALIDATION, TEST = KEYS = ("train_filenames", "val_filenames", "test_filenames")


@dataclass(frozen=True)
class NamedSplit:
    """Which photos a file trains on, and which it tests.

    Args:
        test_key: the list that the test photos are of; empty where they are those in no list.
        test: their names.
        unused: names of photos that are in neither part.
    """

    test_key: str
    test: frozenset[str]
    unused: frozenset[str]

    def test_views(self, names: Sequence[str]) -> np.ndarray:
        """[V] bool, True for the test photos among `names`."""
        return np.array([name in self.test for name in names])

    def text(self, names: Sequence[str]) -> str:
        """For the line that says what the capture was taken for."""
        tested = int(self.test_views(names).sum())
        origin = self.test_key or f"in no {TRAIN}"
        left = f", {len(self.unused)} others not used" if self.unused else ""
        return f"its own split, {len(names) - tested} training and {tested} test photos ({origin}){left}"


def read_split(
    content: dict[str, Any], named: Collection[str], name_of: Callable[[Any], str], source: Path
) -> NamedSplit | None:
    """The split that a transforms.json states, or None where it has none of the lists.

    Test photos are those of ``test_filenames``; where that is absent or empty, of ``val_filenames``. Where both are,
    all photos that are not for training are tests. Without ``train_filenames``, what is in no other list trains.

    Args:
        content: of the file.
        named: the photos that its frames name.
        name_of: a photo's name as in `named`, of a name as in the file; raises `InputError`.
        source: the file.

    Raises:
        InputError: a list that is none or names a photo without a frame; a photo for training and testing; no photos to
            train or to test on.
    """
    lists = {key: _names(content[key], key, named, name_of, source) for key in KEYS if key in content}
    if not lists:
        return None
    train = lists.get(TRAIN)
    test_key = next((key for key in (TEST, VALIDATION) if lists.get(key)), "")
    if not test_key and not train:
        raise InputError(f"{source}: {' and '.join(lists)} are empty: name photos there, or take the lists out")
    test = lists[test_key] if test_key else frozenset(named) - train
    if train is None:
        train = frozenset(named) - lists.get(TEST, frozenset()) - lists.get(VALIDATION, frozenset())
    if both := sorted(train & test):
        raise InputError(
            f"{source}: {len(both)} photos are in {TRAIN} and in {test_key} ({both[0]}): take them out of one of them"
        )
    for part, what in ((train, "train"), (test, "test")):
        if not part:
            raise InputError(f"{source}: its lists ({', '.join(lists)}) leave no photo to {what} on: mend them")
    return NamedSplit(test_key, test, frozenset(named) - train - test)


def _names(
    listed: Any, key: str, named: Collection[str], name_of: Callable[[Any], str], source: Path
) -> frozenset[str]:
    if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
        raise InputError(f"{source}: {key} is no list of file names: write one, or take it out")
    names = {name_of(name): name for name in listed}
    if strange := [text for name, text in names.items() if name not in named]:
        more = f" and {len(strange) - 1} more" if len(strange) > 1 else ""
        raise InputError(
            f"{source}: {key} names '{strange[0]}'{more}, which no frame has: write it as in its frame's file_path, or "
            "take it out"
        )
    return frozenset(names)
