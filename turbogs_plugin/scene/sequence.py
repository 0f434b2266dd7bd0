"""Photos in the order in which they were taken, as far as their names say it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
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

    The photos of one folder are taken for one sequence: cameras, and programs that cut videos, number what they
    write."""
    ordered = sorted(set(names), key=_key)
    places = {name: place for place, name in enumerate(ordered)}
    folders = np.unique([_folder(name) for name in ordered], return_inverse=True)[1]  # of each place
    there, here = (np.array([places[name] for name in group], dtype=np.int64) for group in (known, photos))
    order, here = there.argsort(), here[:, None]  # [known], [W, 1]
    there = there[order]
    before = np.searchsorted(there, here - 1, side="right") - 1
    found = np.concatenate([before, np.searchsorted(there, here + 1)], axis=1)  # [W, 2]
    inside: NDArray[np.bool_] = np.logical_and(found >= 0, found < len(there))
    there, order, found[~inside] = np.append(there, 0), np.append(order, 0), -1  # -1: the one appended
    inside &= folders[there[found]] == folders[here]
    lengths = np.where(inside, np.abs(there[found] - here), 0)
    both = np.asarray(inside.all(axis=1, keepdims=True))
    weights = np.where(both, lengths[:, ::-1] / np.maximum(1, lengths.sum(axis=1, keepdims=True)), inside)
    rows = np.where(inside, order[found], 0)
    return Neighbours(torch.from_numpy(rows), torch.from_numpy(weights).float())


def _folder(name: str) -> str:
    return name.rpartition("/")[0]


def _key(name: str) -> tuple[str, list[str | int], str]:
    """Folders by their names; in them, texts and numbers in turn, so that ``9`` comes before ``10``."""
    parts = re.split(r"(\d+)", name)
    return _folder(name), [int(part) if place % 2 else part for place, part in enumerate(parts)], name
