"""Tables of results, in Markdown."""

from __future__ import annotations

import math
from collections.abc import Iterable

ERRORS = ("PSNR in dB", "SSIM", "mean absolute error")
"""Heads of the columns that every table of errors has."""


def table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A Markdown table."""
    header = list(header)
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(str(cell) for cell in line)} |" for line in lines)


def number(value: float, digits: int, absent: str = "not computed") -> str:
    """A number for a table, with so many digits behind the point; `absent` for NaN."""
    return absent if math.isnan(value) else f"{value:.{digits}f}"
