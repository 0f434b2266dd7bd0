"""Photos in the order in which they were taken, as far as their names say it."""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class Neighbours:
    """The known photos that were taken before and after each of W photos: [W, 2] int64 `rows` of the known photos, and
    [W, 2] float32 `weights`. Of two neighbours, the nearer one weighs more, and both sum to 1; an only one has 1; where
    there is none, both are 0."""

    rows: Tensor
    weights: Tensor

    def mean(self, values: Tensor) -> Tensor:
        """[W, ...]: the weighted mean of the neighbours' values [known, ...]; 0 where there is none."""
        rows, weights = (each.to(values.device) for each in (self.rows, self.weights))
        return (values[rows] * weights.view(*weights.shape, *[1] * (values.dim() - 1))).sum(dim=1)


def neighbours(names: Iterable[str], known: Sequence[str], photos: Sequence[str]) -> Neighbours:
    """The nearest known photos before and after each of `photos`; none is its own neighbour. `names` are of all photos,
    with their folders, in which numbers count as numbers.

    The photos of one folder are taken for one sequence: cameras, and programs that cut videos, number theirs."""
    places = {name: place for place, name in enumerate(sorted(set(names), key=_key))}
    there = sorted((places[name], row, _folder(name)) for row, name in enumerate(known))
    rows, weights = np.zeros((len(photos), 2), dtype=np.int64), np.zeros((len(photos), 2))
    for number, photo in enumerate(photos):
        here = places[photo]
        beside = bisect_left(there, (here,)) - 1, bisect_left(there, (here + 1,))
        near = [there[at] if 0 <= at < len(there) and there[at][2] == _folder(photo) else None for at in beside]
        lengths = [abs(each[0] - here) if each else 0 for each in near]
        rows[number] = [each[1] if each else 0 for each in near]
        weights[number] = [length / sum(lengths) for length in lengths[::-1]] if all(lengths) else np.sign(lengths)
    return Neighbours(torch.from_numpy(rows), torch.from_numpy(weights).float())


def _folder(name: str) -> str:
    return name.rpartition("/")[0]


def _key(name: str) -> tuple[str, list[str | int], str]:
    """Folders by their names; in them, texts and numbers in turn, so that ``9`` comes before ``10``."""
    parts = re.split(r"(\d+)", name)
    return _folder(name), [int(part) if place % 2 else part for place, part in enumerate(parts)], name
