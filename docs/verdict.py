"""The verdict on a part of the paper, from paired differences on several captures: docs/paper.md states the rule."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from turbogs_plugin.study.summary import VariantRow

NOTICED = {"psnr": 0.03, "ssim": 0.0005}
"""A difference below this counts as none, however clear it is."""

DEARER = 1.1
"""A part that takes more than so many times the seconds or the Gaussians has a price, which a person weighs."""


@dataclass(frozen=True)
class PartVerdict:
    """What the comparisons say of a model with a part against one without it.

    Args:
        word: better, worse, mixed (better in one thing and worse in another), as good; or why there is none.
        text: the same with where, and what it costs.
        decides: whose way should be the default: the paper's, ours; or "", where a person decides.
    """

    word: str
    text: str
    decides: str


def verdict(rows: Mapping[str, VariantRow], captures: Sequence[str]) -> PartVerdict:
    """Better or worse where a paired difference in PSNR or SSIM is clear (Student's t) and at least `NOTICED`.

    Args:
        rows: capture -> the model with the paper's part against the one without.
        captures: those of which the default is decided; with fewer there is a word, but no decision.
    """
    seeded = {capture: row for capture, row in rows.items() if row.difference("psnr").clear is not None}
    if not seeded:
        return PartVerdict("one seed", "one seed", "") if rows else PartVerdict("not measured", "not measured yet", "")
    gains: list[str] = []
    losses: list[str] = []
    for capture, row in seeded.items():
        for measure, least in NOTICED.items():
            difference = row.difference(measure)
            if difference.clear and abs(difference.mean) >= least:
                (gains if difference.mean > 0 else losses).append(f"{measure.upper()} on {capture}")
    word = "mixed" if gains and losses else "better" if gains else "worse" if losses else "as good"
    told = [", ".join(gains), ", but worse " if gains and losses else "", ", ".join(losses)]
    text = f"{word}: {''.join(told)}" if gains or losses else word
    costs = {}
    for measure, unit in (("seconds", "s"), ("gaussians", "Gaussians")):
        ratios = [row.ratio(measure) for row in seeded.values()]
        costs[unit] = math.prod(ratios) ** (1 / len(ratios))
    dear = [f"x {ratio:.2f} {unit}" for unit, ratio in costs.items() if ratio > DEARER]
    text += f"; dearer: {', '.join(dear)}" if dear else ""
    if len(seeded) < len(captures):
        return PartVerdict(word, f"{text} ({', '.join(seeded)} alone)", "")
    decides = {"worse": "ours", "mixed": ""}.get(word, "" if dear else "the paper's")
    return PartVerdict(word, text, decides)
