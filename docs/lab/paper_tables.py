"""Tables of docs/paper.md: the worth of the paper's parts and of others' ideas, and whole runs beside 3DGS."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence

import numpy as np
from studies import CAPTURES, ROWS, Cells, Difference, change, duration, mean, ratio, result, study_cells, table, values

DEFAULTS = ("parts", "optimizer", "tables")
"""Studies in which each variant changes one thing of `turbogs`, on validation photos of five captures."""

NOTICED = {"psnr": 0.05, "ssim": 0.001}
"""A mean difference below this counts as none, however clear it is."""

DEARER = 1.1
"""A part that takes more than this many times the Gaussians has a price."""

Pairs = dict[str, tuple[Cells, Cells]]
"""Capture -> trainings with a part and without it."""


def compared(studies: Sequence[str], variants: Sequence[str] | None) -> Pairs:
    """Each capture on which a study has both variants, in the first such study."""
    found: Pairs = {}
    for study in studies if variants else ():
        pairs = {of: tuple(cells.get(name, []) for name in variants or ()) for of, cells in study_cells(study).items()}
        found = {of: pair for of, pair in pairs.items() if Difference.between(*pair, "psnr").count} | found
    return {of: found[of] for of in sorted(found, key=[*CAPTURES, *found].index)}


def each_capture(pairs: Pairs, timed: bool) -> str:
    """A line for each capture."""
    return "<br>".join(f"{capture}: {change(*pair, timed=timed)}" for capture, pair in pairs.items()) or "-"


def over_captures(pairs: Pairs, measure: str) -> Difference:
    """The mean of the captures' differences, with the standard error that their spread gives it."""
    found = [Difference.between(*pair, measure).mean for pair in pairs.values()]
    error = statistics.stdev(found) / math.sqrt(len(found)) if len(found) > 1 else math.nan
    return Difference(statistics.fmean(found), error, len(found))


def means(pairs: Pairs) -> str:
    """Means over the captures, what they say, and what the change costs."""
    if not pairs:
        return "not measured"
    psnr, ssim = (over_captures(pairs, measure) for measure in NOTICED)
    times = statistics.geometric_mean(ratio(*pair, "gaussians") for pair in pairs.values())
    said: dict[str, list[str]] = {"better": [], "worse": []}
    for measure, found in (("psnr", psnr), ("ssim", ssim)):
        if abs(found.mean) >= max(NOTICED[measure], 2 * found.error):
            said["better" if found.mean > 0 else "worse"].append(measure.upper())
    verdict = ", ".join(f"{word} in {' and '.join(of)}" for word, of in said.items() if of)
    figures = f"{psnr.mean:+.2f} ± {psnr.error:.2f} dB, {ssim.mean:+.4f} ± {ssim.error:.4f}, x {times:.2f} N"
    dearer = "; dearer" if times > DEARER else ""
    return f"**{verdict or 'no clear difference'}**{dearer}<br>{figures} ({len(pairs)})"


def paper_parts() -> str:
    """Each part: what it adds to `turbogs` on five captures and to `turbogs-paper` on three, and the default's way."""
    lines = []
    for row in ROWS["paper parts"]:
        ours, papers = compared(DEFAULTS, row.get("ours")), compared(["paper_parts"], row.get("papers"))
        default = ("the paper's" if row["ours"][0] == "turbogs" else "ours") if ours else "-"
        lines.append((row["name"], means(ours), each_capture(ours, False), each_capture(papers, True), default))
    head = ("the paper's part", "in our default, mean", "in our default, each capture", "in the paper's configuration")
    return table((*head, "default"), lines)


def changes(section: str) -> str:
    """Rows of a section of rows.yaml: what a variant adds to another one, and what was said of it before."""
    rows = [(row["name"], row["said"], compared([section, "later_ideas"], row["of"])) for row in ROWS[section]["rows"]]
    lines = [(name, said, means(pairs), each_capture(pairs, False)) for name, said, pairs in rows]
    return table((*ROWS[section]["head"], "mean", "each capture"), lines)


def best_psnr(cells: Cells) -> float:
    """dB: the highest test PSNR on the way, mean over seeds."""
    return statistics.fmean(max(cell["curve"]["psnr"]) for cell in cells)


def first_at(cells: Cells, psnr: float) -> str:
    """Seconds until a test PSNR is first passed, on the line between evaluations: mean over seeds, if all pass it."""
    curves = ((np.maximum.accumulate(cell["curve"]["psnr"]), cell["curve"]["seconds"]) for cell in cells)
    return duration(statistics.fmean(float(np.interp(psnr - 1e-9, *curve, right=math.nan)) for curve in curves))


def whole_run(cells: Cells) -> str:
    text = result(cells, f"{mean(cells, 'psnr'):.2f}")
    return f"{text}; best on the way {best_psnr(cells):.2f} dB ({len(cells)})"


def within_bound(paper: Cells, psnr: float, bound: float = 0.3) -> str:
    """`turbogs-paper` minus 3DGS, with the standard error of its seeds, and whether it is within `bound` dB below:
    undecided where two standard errors change that. 3DGS is one run, whose error is not known."""
    difference, error = mean(paper, "psnr") - psnr, statistics.stdev(values(paper, "psnr")) / math.sqrt(len(paper))
    kept = f"{'within' if difference >= -bound else 'beyond'} the bound"
    return f"{difference:+.2f} ± {error:.2f} dB, {'undecided' if abs(difference + bound) < 2 * error else kept}"


def paper_whole() -> str:
    """The paper's configuration with and without its repair, beside full-length 3DGS and `turbogs`."""
    entries = {
        "3DGS, 30,000 iterations": ("baselines", "3dgs"),
        "`turbogs-paper`": ("paper", "turbogs-paper"),
        "`paper-literal`, without the repair": ("paper", "paper-literal"),
        "`turbogs`": ("cameras", "turbogs"),
    }
    found = {name: [study_cells(study)[of][variant] for of in CAPTURES] for name, (study, variant) in entries.items()}
    lines = [(name, *map(whole_run, cells)) for name, cells in found.items()]
    theirs, paper, *_ = found.values()
    for name, of in (("end", lambda cells: mean(cells, "psnr")), ("best on the way", best_psnr)):
        psnr = [of(cells) for cells in theirs]
        lines.append((f"`turbogs-paper`, its end, minus 3DGS, its {name}", *map(within_bound, paper, psnr)))
        lines += [(f"seconds to 3DGS's {name}: {row}", *map(first_at, cells, psnr)) for row, cells in found.items()]
    return table(("", *CAPTURES), lines)
