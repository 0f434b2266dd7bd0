"""Amounts of memory and time, and colours, as people write them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

from PIL import ImageColor

from turbogs_plugin.errors import InputError
from turbogs_plugin.types import Color

BYTE_UNITS = {"": 1, "b": 1, "kib": 2**10, "mib": 2**20, "gib": 2**30, "kb": 10**3, "mb": 10**6, "gb": 10**9}
SECOND_UNITS = {"": 1.0, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}


def parse_bytes(text: str) -> int:
    """``2GiB``, ``1500 MB``, ``300000000``. Raises `InputError`."""
    return int(_parse(text, BYTE_UNITS, 1.0, "memory: write 2GiB, 1500MB or a number of bytes"))


def parse_seconds(text: str) -> float:
    """``20s``, ``2m``, ``1.5h``, ``20``. Raises `InputError`."""
    return _parse(text, SECOND_UNITS, 1e-9, "time: write 20s, 2m or 1.5h")


def parse_color(text: str) -> Color:
    """``white``, ``rgb(51, 102, 153)``, ``#336699``, as Pillow's `ImageColor` takes them. Raises `InputError`."""
    try:
        red, green, blue = ImageColor.getrgb(text)[:3]
    except ValueError:
        raise InputError(f"'{text[:40]}' is no colour: write black, white, grey or rgb(51, 102, 153)") from None
    return red / 255.0, green / 255.0, blue / 255.0


def _parse(text: str, units: Mapping[str, float], least: float, expected: str) -> float:
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([a-z]*)\s*", text.lower())
    amount = float(match[1]) * units.get(match[2], math.nan) if match else math.nan
    if not least <= amount < math.inf:
        raise InputError(f"'{text[:40]}' is no amount of {expected}")
    return amount
