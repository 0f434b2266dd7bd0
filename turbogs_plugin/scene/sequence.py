"""Photos in the order in which they were taken, as far as their names say it."""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Sequence
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
    """

    rows: Tensor
    weights: Tensor

    def mean(self, values: Tensor) -> Tensor:
        """[W, ...]: the weighted mean of the neighbours' values [known, ...]; 0 where there is none."""
        rows, weights = (each.to(values.device) for each in (self.rows, self.weights))
        return (values[rows] * weights.view(*weights.shape, *[1] * (values.dim() - 1))).sum(dim=1)


def neighbours(known: Sequence[str], photos: Sequence[str]) -> Neighbours:
    """The neighbours of photos in their folder's order of names, in which numbers count as numbers.

    A photo is no neighbour of itself. Distances count all photos named here. Photos of one folder are taken for one
    sequence: cameras and programs that cut videos number what they write.

    Args:
        known: names of the photos of which something is known, with their folders.
        photos: names of those whose neighbours are wanted.
    """
    ordered = sorted({*known, *photos}, key=_key)
    places = {name: place for place, name in enumerate(ordered)}
    sequences: dict[str, list[int]] = {}  # folder -> rows of known photos, in their order
    for row in sorted(range(len(known)), key=lambda row: places[known[row]]):
        sequences.setdefault(_folder(known[row]), []).append(row)
    rows, weights = torch.zeros(len(photos), 2, dtype=torch.int64), torch.zeros(len(photos), 2)
    for photo, name in enumerate(photos):
        sequence = sequences.get(_folder(name), [])
        after = bisect_left(sequence, places[name], key=lambda row: places[known[row]])
        behind = after + (after < len(sequence) and known[sequence[after]] == name)
        found = [sequence[at] for at in (after - 1, behind) if 0 <= at < len(sequence)]
        if not found:
            continue
        distances = [abs(places[known[row]] - places[name]) for row in found]
        rows[photo] = torch.tensor([found[0], found[-1]])
        weights[photo, 0] = distances[-1] / sum(distances) if len(found) == 2 else 1.0
        weights[photo, 1] = 1.0 - weights[photo, 0]
    return Neighbours(rows, weights)


def _folder(name: str) -> str:
    return name.rpartition("/")[0]


def _key(name: str) -> tuple[str, list[str | int], str]:
    """Folders by their names; in them, texts and numbers in turn, so that ``9`` comes before ``10``."""
    parts = re.split(r"(\d+)", name)
    return _folder(name), [int(part) if place % 2 else part for place, part in enumerate(parts)], name
