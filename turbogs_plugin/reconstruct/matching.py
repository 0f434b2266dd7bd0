"""Pairs of photos to match: all pairs of few photos; of many, pairs that are close by GPS or by order."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import PurePosixPath

import numpy as np
from scipy.spatial import cKDTree

FEW = 150
"""Up to this many photos, every pair is matched (11,175)."""
FURTHER = (*range(1, 11), 16, 32, 64, 128, 256, 512)
"""Distances, in the order of names, at which ordered photos are matched."""
ANCHORS = 10
"""One of this many ordered photos is matched with each other such one: so a walk that comes back is closed."""
NEIGHBORS = 40
"""Nearest photos by GPS that each photo is matched with."""
GPS_SHARE, GPS_SPREAD = 0.9, 50.0
"""GPS is used where at least this share of the photos has it, and the standard deviation of their positions is at
least this many metres: well above a phone's error."""
ORDERED_SHARE, LARGEST_STEP = 0.9, 10
"""Photos are ordered where at least this share of them follows another one by a number that grows by at most this."""
EARTH_RADIUS = 6_371_000.0
NUMBER = re.compile(r"^(.*?)(\d+)(\D*)$", re.DOTALL)


def choose_pairs(names: Sequence[str], positions: np.ndarray) -> tuple[np.ndarray, str]:
    """Pairs to match, [P, 2] int64, indices of V photos, the lower first, each pair once; and why these, for the user.
    `positions`: [V, 2] float64, degrees of latitude and longitude; NaN where a photo has none."""
    count = len(names)
    every = np.stack(np.triu_indices(count, 1), axis=1)
    if count <= FEW:
        return every, f"each with each, as they are at most {FEW}"
    order = natural_order(names)
    pairs, reasons = [], []
    metres = metres_of(positions)
    placed = np.isfinite(metres).all(axis=1)
    if placed.mean() >= GPS_SHARE and np.sqrt(metres[placed].var(axis=0).sum()) >= GPS_SPREAD:
        pairs.append(nearest_pairs(metres))
        reasons.append(f"with the {NEIGHBORS} nearest by GPS")
    if are_ordered([names[view] for view in order]):
        starts = {step: np.arange(max(0, count - step)) for step in FURTHER}
        pairs += [order[np.stack([start, start + step], axis=1)] for step, start in starts.items()]
        anchors = order[::ANCHORS]
        pairs.append(anchors[np.stack(np.triu_indices(len(anchors), 1), axis=1)])
        reasons.append("in the order of their names")
    if not pairs:
        return every, "each with each, as neither names nor GPS say which are close"
    return np.unique(np.sort(np.concatenate(pairs), axis=1), axis=0), " and ".join(reasons)


def nearest_pairs(positions: np.ndarray) -> np.ndarray:
    """[P, 2] int64: each of the [V, 2] positions with the `NEIGHBORS` nearest; positions with NaN with none."""
    placed = np.flatnonzero(np.isfinite(positions).all(axis=1))
    count = min(NEIGHBORS + 1, len(placed))
    _, nearest = cKDTree(positions[placed]).query(positions[placed], k=count)  # [., count]
    pairs = np.stack([np.repeat(placed, count), placed[nearest].ravel()], axis=1)
    return pairs[pairs[:, 0] != pairs[:, 1]]


def metres_of(positions: np.ndarray) -> np.ndarray:
    """[V, 2] metres north and east of the median, of [V, 2] degrees of latitude and longitude. NaN stays NaN."""
    if not np.isfinite(positions).any():
        return positions
    middle = np.nanmedian(positions, axis=0)
    return np.radians(positions - middle) * EARTH_RADIUS * np.array([1.0, np.cos(np.radians(middle[0]))])


def natural_order(names: Sequence[str]) -> np.ndarray:
    """[V] int64: the order of names in which numbers count by their value: a2 before a10."""
    keys = [[int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)] for name in names]
    return np.array(sorted(range(len(names)), key=lambda view: keys[view]), dtype=np.int64)


def are_ordered(names: Sequence[str]) -> bool:
    """Whether names in natural order are a walk's or a film's: numbers that grow by small steps."""
    parts = [NUMBER.match(PurePosixPath(name).with_suffix("").as_posix()) for name in names]
    pairs = [first and second and (first.groups(), second.groups()) for first, second in pairwise(parts)]
    numbered = [(int(one[1]), int(two[1])) for one, two in filter(None, pairs) if one[::2] == two[::2]]
    follows = sum(0 < second - first <= LARGEST_STEP for first, second in numbered)
    return bool(pairs) and follows >= ORDERED_SHARE * len(pairs)
