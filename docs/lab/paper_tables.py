"""Tables of docs/paper.md: what each part of the paper is worth, and the paper's configuration beside 3DGS."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from studies import CAPTURES, ROWS, Cells, Difference, change, duration, mean, ratio, result, study_cells, table, values

DEFAULTS = ("optimizer", "cameras", "parts", "departures", "density_departures", "bounds")
"""Studies in which each variant changes one thing of `turbogs`."""

NOTICED = {"psnr": 0.03, "ssim": 0.0005}
"""A difference below this counts as none, however clear it is."""

DEARER = 1.1
"""A part that takes more than this many times the seconds or the Gaussians has a price."""

BOUND = 0.3
"""dB by which `turbogs-paper` may end below 3DGS at its full length."""


class Part(NamedTuple):
    """A part of the paper.

    Args:
        name: what it is; in brackets what the full method loses without it, by the paper's table of components.
        ours: the variants with it and without it in one of `DEFAULTS`, or None.
        papers: the variants with it and without it in `paper_parts`, or None.
    """

    name: str
    ours: tuple[str, str] | None = None
    papers: tuple[str, str] | None = None

    @property
    def default(self) -> str:
        """Whose way `turbogs` takes, where it is one of the two."""
        if self.ours is None or "turbogs" not in self.ours:
            return "-"
        return "the paper's" if self.ours[0] == "turbogs" else "ours"


PARTS = [Part(**row) for row in ROWS["paper parts"]]


def compared(studies: Sequence[str], variants: tuple[str, str] | None) -> dict[str, tuple[Cells, Cells]]:
    """Capture -> trainings with a part and without it, where one of the studies has both."""
    found = {}
    for capture in (*CAPTURES, "bonsai", "train") if variants else ():
        for study in studies:
            cells = [study_cells(study).get(capture, {}).get(name) for name in variants or ()]
            if all(cells) and Difference.between(*cells, "psnr").count:
                found[capture] = (cells[0], cells[1])
    return found


def verdict(pairs: Mapping[str, tuple[Cells, Cells]]) -> str:
    """Better or worse where a difference in PSNR or SSIM is clear and at least `NOTICED`; and what the part costs."""
    if not pairs:
        return "not measured"
    said: dict[bool, list[str]] = {True: [], False: []}
    for capture, pair in pairs.items():
        for measure, least in NOTICED.items():
            difference = Difference.between(*pair, measure)
            if difference.clear and abs(difference.mean) >= least:
                said[difference.mean > 0].append(f"{measure.upper()} on {capture}")
    gains, losses = (", ".join(said[better]) for better in (True, False))
    text = f"better: {gains}" if gains else f"worse: {losses}" if losses else "as good"
    text = f"mixed: {gains}, but worse {losses}" if gains and losses else text
    dear = []
    for measure, unit in (("seconds", "s"), ("gaussians", "Gaussians")):
        times = statistics.geometric_mean(ratio(*pair, measure) for pair in pairs.values())
        dear += [f"x {times:.2f} {unit}"] if times > DEARER else []
    text += f"; dearer: {', '.join(dear)}" if dear else ""
    return text if len(pairs) >= len(CAPTURES) else f"{text} ({', '.join(pairs)} alone)"


def paper_parts() -> str:
    """Each part: what it adds to `turbogs` and to `turbogs-paper`, the verdict, and whose way the default takes."""
    lines = []
    for part in PARTS:
        ours, papers = compared(DEFAULTS, part.ours), compared(["paper_parts"], part.papers)
        texts = ("<br>".join(f"{of}: {change(*pair)}" for of, pair in found.items()) or "-" for found in (ours, papers))
        said = [verdict(ours)] + ([f"in the paper's: {verdict(papers)}"] if part.papers else [])
        lines.append((part.name, *texts, "<br>".join(said), part.default))
    return table(("the paper's part", "in our default", "in the paper's configuration", "verdict", "default"), lines)


def best_psnr(cells: Cells) -> float:
    """dB: the highest test PSNR on the way, mean over seeds."""
    return statistics.fmean(max(cell["curve"]["psnr"]) for cell in cells)


def whole_run(cells: Cells) -> str:
    seconds, psnr = duration(mean(cells, "seconds")), f"{mean(cells, 'psnr'):.2f}"
    text = result(seconds, psnr, mean(cells, "ssim"), mean(cells, "gaussians"))
    return f"{text}; best on the way {best_psnr(cells):.2f} dB ({len(cells)})"


def within_bound(paper: Cells, psnr: float) -> str:
    """`turbogs-paper` minus 3DGS with the standard error of `turbogs-paper`, and whether the bound is kept; undecided
    where two standard errors change that. 3DGS is one run, whose error is not known."""
    found = values(paper, "psnr")
    difference, error = mean(paper, "psnr") - psnr, statistics.stdev(found) / math.sqrt(len(found))
    kept = f"{'within' if difference >= -BOUND else 'beyond'} the bound"
    return f"{difference:+.2f} ± {error:.2f} dB, {'undecided' if abs(difference + BOUND) < 2 * error else kept}"


def paper_whole() -> str:
    """The paper's configuration with and without its repair, beside full-length 3DGS and `turbogs`."""
    entries = {
        "3DGS, 30,000 iterations": ("baselines", "3dgs"),
        "`turbogs-paper`": ("paper", "turbogs-paper"),
        "`paper-literal`, without the repair": ("paper", "paper-literal"),
        "`turbogs`": ("departures", "turbogs"),
    }
    found = {name: [study_cells(study)[of][variant] for of in CAPTURES] for name, (study, variant) in entries.items()}
    lines = [(name, *map(whole_run, cells)) for name, cells in found.items()]
    pairs = list(zip(*list(found.values())[:2], strict=True))  # 3DGS and `turbogs-paper`
    for name, psnr in (("end", lambda cells: mean(cells, "psnr")), ("best on the way", best_psnr)):
        kept = (within_bound(ours, psnr(theirs)) for theirs, ours in pairs)
        lines.append((f"`turbogs-paper`, its end, minus 3DGS, its {name}", *kept))
    return table(("", *CAPTURES), lines)
