"""How much is done for the features of photos: little first, which mostly suffices, then more."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Effort:
    """One way to find features, and the camera model that goes with it.

    Args:
        name: of its database.
        long_side: larger photos are reduced to it; features stay in pixels of the whole photo.
        doubled: features are looked for at twice that size, too, as COLMAP does by default: two to three times as many
            in three times the time.
        default_cameras: all lenses get COLMAP's default model.
        again: for the line of progress, where another effort went before: what is different.
    """

    name: str
    long_side: int
    doubled: bool
    default_cameras: bool = False
    again: str = ""


QUICK = Effort("quick", 1600, doubled=False)
DOUBLED = Effort("doubled", 1600, doubled=True, again=" again, with more features")
DEFAULTS = Effort("defaults", 3200, doubled=True, default_cameras=True, again=" again, by COLMAP's own defaults")

SMALL = 1000
"""Photos whose longer side is less show too little without doubling."""


def efforts_for(longest: int) -> tuple[Effort, ...]:
    """In this order, until one registers enough photos. `longest`: side of all photos, in pixels."""
    return (QUICK, DOUBLED, DEFAULTS) if longest >= SMALL else (DOUBLED, DEFAULTS)
