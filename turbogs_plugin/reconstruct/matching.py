"""Which pairs of photos are matched: all, or by place, by order and by likeness where they are many."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import PurePosixPath

import numpy as np

FEW = 150
"""So many photos are matched each with each other: 11,175 pairs."""
OVERLAP = 10
FURTHER = (16, 32, 64, 128, 256, 512)
"""Ordered photos are matched with so many that follow, and with those so much further on."""
LOOPS, ALIKE = 20, 50
"""So many of the most similar photos are matched with each: beside another choice, and alone."""
NEIGHBORS = 40
"""Photos with a GPS position are matched with so many of the nearest."""
GPS_SHARE = 0.9
"""GPS is used where so many photos have it ..."""
GPS_SPREAD = 50.0
"""... and the standard deviation of their positions is so many metres, beside which the error of a phone is small."""
ORDERED_SHARE = 0.9
LARGEST_STEP = 10
"""Photos are ordered where so many follow each other by a number that grows by at most this."""
EARTH_RADIUS = 6_371_000.0
NUMBER = re.compile(r"^(.*?)(\d+)(\D*)$", re.DOTALL)


@dataclass(frozen=True)
class Matching:
    """Pairs to match.

    Args:
        pairs: [P, 2] int64, indices of photos, the lower first, each pair once.
        similar: match each photo also with so many that look most alike; 0: none.
        reason: which pairs these are, and why, for the user.
    """

    pairs: np.ndarray
    similar: int
    reason: str


def choose_matching(names: Sequence[str], positions: np.ndarray) -> Matching:
    """The pairs for these photos.

    Args:
        names: of V photos.
        positions: [V, 2] float64, degrees of latitude and longitude; NaN where a photo has none.
    """
    count = len(names)
    if count <= FEW:
        return Matching(np.stack(np.triu_indices(count, 1), axis=1), 0, f"each with each, as they are at most {FEW}")
    order = natural_order(names)
    ordered = are_ordered([names[view] for view in order])
    following = order[sequential_pairs(count)] if ordered else np.zeros((0, 2), dtype=np.int64)
    metres = metres_of(positions)
    placed = np.isfinite(metres).all(axis=1)
    if placed.mean() >= GPS_SHARE and np.sqrt(metres[placed].var(axis=0).sum()) >= GPS_SPREAD:
        pairs = _distinct(np.concatenate([nearest_pairs(metres), following]))
        also = f", {OVERLAP} that follow" if ordered else ""
        return Matching(pairs, LOOPS, f"with {NEIGHBORS} nearest by GPS{also} and {LOOPS} most similar")
    if ordered:
        return Matching(_distinct(following), LOOPS, f"in the order of their names, and with {LOOPS} most similar")
    return Matching(following, ALIKE, f"with {ALIKE} most similar, as neither names nor GPS say which are close")


def sequential_pairs(count: int) -> np.ndarray:
    """[P, 2] int64: each with the `OVERLAP` that follow, and with those at distances of `FURTHER`."""
    starts = {step: np.arange(max(0, count - step)) for step in (*range(1, OVERLAP + 1), *FURTHER)}
    return np.concatenate([np.stack([start, start + step], axis=1) for step, start in starts.items()])


def nearest_pairs(positions: np.ndarray) -> np.ndarray:
    """[P, 2] int64: each of the [V, 2] positions with the `NEIGHBORS` nearest; those with NaN with none."""
    placed = np.flatnonzero(np.isfinite(positions).all(axis=1))
    pairs = []
    for view in placed:
        distances = np.linalg.norm(positions[placed] - positions[view], axis=1)
        nearest = placed[np.argsort(distances, kind="stable")[: NEIGHBORS + 1]]
        pairs += [(view, other) for other in nearest if other != view]
    return _distinct(np.array(pairs, dtype=np.int64).reshape(-1, 2))


def metres_of(positions: np.ndarray) -> np.ndarray:
    """[V, 2] metres north and east of the median, of [V, 2] degrees of latitude and longitude. NaN stays NaN."""
    placed = np.isfinite(positions).all(axis=1)
    if not placed.any():
        return positions
    middle = np.median(positions[placed], axis=0)
    scale = EARTH_RADIUS * np.array([1.0, np.cos(np.radians(middle[0]))])
    return np.radians(positions - middle) * scale


def natural_order(names: Sequence[str]) -> np.ndarray:
    """[V] int64: the order of names in which numbers count by their value: a2 before a10."""
    keys = [[int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)] for name in names]
    return np.array(sorted(range(len(names)), key=lambda view: keys[view]), dtype=np.int64)


def are_ordered(names: Sequence[str]) -> bool:
    """Whether names in natural order are those of a walk or a film: numbers that grow by small steps."""
    parts = [NUMBER.match(PurePosixPath(name).with_suffix("").as_posix()) for name in names]
    follows = [
        first is not None
        and second is not None
        and (first[1], first[3]) == (second[1], second[3])
        and 0 < int(second[2]) - int(first[2]) <= LARGEST_STEP
        for first, second in pairwise(parts)
    ]
    return bool(follows) and sum(follows) >= ORDERED_SHARE * len(follows)


def _distinct(pairs: np.ndarray) -> np.ndarray:
    """Each pair once, the lower index first."""
    return np.unique(np.sort(pairs.reshape(-1, 2), axis=1), axis=0)
