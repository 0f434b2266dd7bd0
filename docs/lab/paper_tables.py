"""Tables of docs/paper.md: the worth of the paper's parts and of others' ideas, and whole runs beside 3DGS."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence

import numpy as np
from studies import CAPTURES, ROWS, Cells, Difference, change, duration, mean, ratio, result, study_cells, table

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


def each_capture(pairs: Pairs) -> str:
    """A line for each capture."""
    return "<br>".join(f"{capture}: {change(*pair, timed=False)}" for capture, pair in pairs.items()) or "-"


def over_captures(pairs: Pairs, measure: str) -> Difference:
    """The mean of the captures' differences, with the standard error that their spread gives it."""
    found = [Difference.between(*pair, measure).mean for pair in pairs.values()]
    error = statistics.stdev(found) / math.sqrt(len(found)) if len(found) > 1 else math.nan
    return Difference(statistics.fmean(found), error, len(found))


def means(pairs: Pairs) -> str:
    """Means over the captures, what they say, and what the change costs."""
    if not pairs:
        return "-"
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
    """Each part: what it adds to `turbogs` and to `turbogs-paper` on five captures, and the default's way."""
    lines = []
    for row in ROWS["paper parts"]:
        ours, papers = compared(DEFAULTS, row.get("ours")), compared(["paper_parts"], row.get("papers"))
        default = ("the paper's" if row["ours"][0] == "turbogs" else "ours") if ours else "-"
        both = [text for pairs in (ours, papers) for text in (means(pairs), each_capture(pairs))]
        lines.append((row["name"], *both, default))
    ways = ("our default", "the paper's configuration")
    head = [f"in {way}, {what}" for way in ways for what in ("mean", "each capture")]
    return table(("the paper's part", *head, "default"), lines)


def changes(section: str) -> str:
    """Rows of a section of rows.yaml: what a variant adds to another one, and what was said of it before."""
    rows = [(row["name"], row["said"], compared([section, "later_ideas"], row["of"])) for row in ROWS[section]["rows"]]
    lines = [(name, said, means(pairs), each_capture(pairs)) for name, said, pairs in rows]
    return table((*ROWS[section]["head"], "mean", "each capture"), lines)


def best_psnr(cells: Cells) -> float:
    """dB: the highest test PSNR on the way, mean over seeds."""
    return statistics.fmean(max(cell["curve"]["psnr"]) for cell in cells)


def first_at(cells: Cells, psnr: float, theirs: Cells) -> str:
    """Seconds until a test PSNR is first passed, on the line between evaluations, and as 1/N of `theirs`: mean over
    seeds, if all pass it."""
    curves = ((np.maximum.accumulate(cell["curve"]["psnr"]), cell["curve"]["seconds"]) for cell in cells)
    seconds = statistics.fmean(float(np.interp(psnr - 1e-9, *curve, right=math.nan)) for curve in curves)
    return "-" if math.isnan(seconds) else f"{duration(seconds)} s, 1/{mean(theirs, 'seconds') / seconds:.0f}"


def whole_run(cells: Cells, theirs: Cells) -> str:
    text = f"x {ratio(cells, theirs, 'seconds'):.2f} s; best on the way {best_psnr(cells):.2f} dB ({len(cells)})"
    return f"{result(cells, format(mean(cells, 'psnr'), '.2f'))}; {text}"


def paper_whole() -> str:
    """The paper's configurations beside full-length 3DGS and `turbogs`: ends, and seconds to 3DGS's errors."""
    entries = {
        "3DGS, 30,000 iterations": ("baselines", "3dgs"),
        "`turbogs-paper`": ("paper", "turbogs-paper"),
        "TurboGS-Big, 8000 iterations": ("paper", "paper-big"),
        "`paper-literal`, without the repair": ("paper", "paper-literal"),
        "`turbogs`": ("record", "turbogs"),
    }
    captures = study_cells("paper")
    found = {name: [study_cells(study)[of][variant] for of in captures] for name, (study, variant) in entries.items()}
    theirs, paper, *_ = found.values()
    lines = [(name, *map(whole_run, cells, theirs)) for name, cells in found.items()]
    for name, of in (("end", lambda cells: mean(cells, "psnr")), ("best on the way", best_psnr)):
        psnr = [of(cells) for cells in theirs]
        ahead = [f"{mean(cells, 'psnr') - base:+.2f} dB" for cells, base in zip(paper, psnr, strict=True)]
        lines.append((f"`turbogs-paper`, its end, minus 3DGS, its {name}", *ahead))
        reached = [(f"to 3DGS's {name}: {row}", *map(first_at, cells, psnr, theirs)) for row, cells in found.items()]
        lines += [line for line in reached if set(line[1:]) != {"-"}]
    return table(("", *captures), lines)
