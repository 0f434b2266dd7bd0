"""Photos in the order in which they were taken, as far as their names say it."""

from __future__ import annotations

import re
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Neighbours:
    """Of each of W photos, the known ones that were taken before and after it.

    Args:
        rows: [W, 2] int64, which of the known photos.
        weights: [W, 2] float32: of two neighbours, the nearer one weighs more, and both sum to 1; an only one has 1;
            where there is none, both are 0.
        distances: [W] int64, to the nearer one, in photos; 0 where there is none.
    """

    rows: Tensor
    weights: Tensor
    distances: Tensor

    def mean(self, values: Tensor) -> Tensor:
        """[W, ...]: the weighted mean of the neighbours' values [known, ...]; 0 where there is none."""
        rows, weights = (each.to(values.device) for each in (self.rows, self.weights))
        return (values[rows] * weights.view(*weights.shape, *[1] * (values.dim() - 1))).sum(dim=1)


class PhotoOrder:
    """The photos of each folder in the order of their names, in which numbers count as numbers.

    Those of one folder are taken for one sequence: cameras, and programs that cut videos, number what they write.

    Args:
        names: of all photos, with their folders.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self._places = {name: place for place, name in enumerate(sorted(set(names), key=_key))}

    def neighbours(self, known: Sequence[str], photos: Sequence[str], apart: int = 1) -> Neighbours:
        """The nearest known photos at least so many photos before and after each photo, which is none of its own.

        Args:
            known: names of the photos of which something is known.
            photos: names of those whose neighbours are wanted.
            apart: 1 or more.
        """
        sequences: dict[str, list[int]] = {}  # folder -> rows of known photos, in their order
        for row in sorted(range(len(known)), key=lambda row: self._places[known[row]]):
            sequences.setdefault(_folder(known[row]), []).append(row)
        places = {folder: [self._places[known[row]] for row in rows] for folder, rows in sequences.items()}
        rows, weights = torch.zeros(len(photos), 2, dtype=torch.int64), torch.zeros(len(photos), 2)
        distances = torch.zeros(len(photos), dtype=torch.int64)
        for photo, name in enumerate(photos):
            there, place = places.get(_folder(name), []), self._places[name]
            before, after = bisect_right(there, place - apart) - 1, bisect_left(there, place + apart)
            found = [at for at in (before, after) if 0 <= at < len(there)]
            if not found:
                continue
            lengths = [abs(there[at] - place) for at in found]
            first = lengths[-1] / sum(lengths) if len(found) == 2 else 1.0
            rows[photo] = torch.tensor([sequences[_folder(name)][at] for at in (found[0], found[-1])])
            weights[photo], distances[photo] = torch.tensor([first, 1.0 - first]), min(lengths)
        return Neighbours(rows, weights, distances)


def _folder(name: str) -> str:
    return name.rpartition("/")[0]


def _key(name: str) -> tuple[str, list[str | int], str]:
    """Folders by their names; in them, texts and numbers in turn, so that ``9`` comes before ``10``."""
    parts = re.split(r"(\d+)", name)
    return _folder(name), [int(part) if place % 2 else part for place, part in enumerate(parts)], name
