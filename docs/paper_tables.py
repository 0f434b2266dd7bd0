"""Tables of docs/paper.md: what each part of the paper is worth, and the whole of it beside 3DGS."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from study_tables import CAPTURES, change, result, rows_of, stale
from verdict import verdict

from turbogs_plugin.report.tables import table
from turbogs_plugin.study.summary import VariantRow

OURS = ("cameras", "parts", "departures", "density_departures", "bounds")
"""Studies that change one thing of `turbogs` a variant."""

BOUND = 0.3
"""dB by which `turbogs-paper` may be worse than 3DGS at its full length."""


class Part(NamedTuple):
    """A part of the paper.

    Args:
        name: what it is; in brackets what the full method loses without it in the paper's table of components.
        ours: the variants with it and without it, of one of `OURS`, or None where it has none. Where neither is
            `turbogs`, the row does not decide the default.
        papers: the same of `paper_parts`, or None where it has none.
    """

    name: str
    ours: tuple[str, str] | None
    papers: tuple[str, str] | None = None

    @property
    def default(self) -> str:
        """Whose way today's `turbogs` has, where it is one of the two."""
        if self.ours is None or "turbogs" not in self.ours:
            return ""
        return "the paper's" if self.ours[0] == "turbogs" else "ours"


PARTS = (
    Part(
        "geometry-aware views, not random ones (+0.31 dB)",
        ("geometry-views", "turbogs"),
        ("turbogs-paper", "random-views"),
    ),
    Part(
        "error-guided pixels, not random ones (+0.47 dB)",
        ("turbogs", "random-pixels"),
        ("turbogs-paper", "random-pixels"),
    ),
    Part("as many pixels of a tile as the paper's, not whole warps", ("rounded-down", "turbogs")),
    Part("Moment-LM, not sparse Adam", ("turbogs", "sparse-adam"), ("turbogs-paper", "sparse-adam")),
    Part("the error-driven score and its gates, not a draw by squares", ("by-difficulty", "turbogs")),
    Part("the score, not the gradient alone", ("by-difficulty", "by-gradient"), ("turbogs-paper", "no-score")),
    Part("no pruning by squares at every event", ("no-turnover", "turbogs")),
    Part("final pruning", ("turbogs", "no-final-pruning"), ("turbogs-paper", "no-final-pruning")),
    Part("NCC (+0.48 dB)", ("turbogs", "no-ncc"), ("turbogs-paper", "no-ncc")),
    Part("the printed NCC: a flat tile scores 0", ("printed-ncc", "turbogs")),
    Part("3DGS's splits", ("sampled-splits", "turbogs")),
    Part("no opacity decay", ("no-decay", "turbogs")),
    Part("a gradient's threshold within the paper's range, 4e-4", ("absgrad-4e-4", "turbogs")),
    Part("training cameras as they are given", ("given-cameras", "turbogs")),
    Part("3DGS's learning rates", ("rates-3dgs", "turbogs"), ("turbogs-paper", "rates-turbogs")),
    Part("5,000 iterations, not 60 epochs", ("iterations-5000", "turbogs")),
    Part("no backdrop", ("no-backdrop", "turbogs")),
    Part("no space kept free before cameras", ("no-clearance", "turbogs")),
    Part("no bound on far sizes", ("distant-unbounded", "turbogs")),
    Part("pruning by the scene's extent, as 3DGS", ("prune-by-extent", "turbogs")),
    Part("the last iteration's model, not the mean of the last tenth", ("no-average", "turbogs")),
    Part("a band of harmonics every 1000 iterations, as 3DGS", ("sh-interval-1000", "turbogs")),
)


def comparisons(studies: Sequence[str], variants: tuple[str, str] | None) -> dict[str, VariantRow]:
    """Capture -> the first variant against the second, where both have a seed in common in one of the studies."""
    if variants is None:
        return {}
    found = {}
    for capture, rows in ((capture, rows) for study in studies for capture, rows in rows_of(study).items()):
        if all(name in rows for name in variants):
            with_it, without = (rows[name].cells for name in variants)
            row = VariantRow(variants[0], with_it, without)
            if row.difference("psnr").count:
                found[capture] = row
    return {capture: found[capture] for capture in CAPTURES if capture in found}


def effects(rows: Mapping[str, VariantRow]) -> str:
    return "<br>".join(f"{capture}: {change(row)}" for capture, row in rows.items()) or "-"


def paper_parts() -> str:
    """Each part of the paper: what it adds to ours and to the paper's configuration, the verdict, and the default."""
    lines = []
    for part in PARTS:
        ours, papers = comparisons(OURS, part.ours), comparisons(["paper_parts"], part.papers)
        said, said_there = verdict(ours, CAPTURES), verdict(papers, CAPTURES)
        told = "<br>".join(
            f"{place}{of.text}"
            for place, of, variants in (("", said, part.ours), ("in the paper's: ", said_there, part.papers))
            if variants
        )
        default = part.default or "-"
        if part.default and said.decides not in ("", part.default):
            default = f"{part.default}; **should be {said.decides}**"
        lines.append((part.name, effects(ours), effects(papers), told, default))
    header = ("the paper's part", "in our default", "in the paper's configuration", "verdict", "default")
    return "\n\n".join([table(header, lines), *(line for study in (*OURS, "paper_parts") for line in stale(study))])


def paper_whole() -> str:
    """The paper's configuration with and without its repair, beside full-length 3DGS and ours."""
    found = {study: rows_of(study) for study in ("baselines", "paper", "sizes")}
    entries = {
        "3DGS, 30,000 iterations": ("baselines", "3dgs"),
        "`turbogs-paper`": ("paper", "turbogs-paper"),
        "`paper-literal`, without the repair": ("paper", "paper-literal"),
        "`turbogs`": ("sizes", "turbogs"),
    }
    rows = {
        name: {capture: found[study].get(capture, {}).get(variant) for capture in CAPTURES}
        for name, (study, variant) in entries.items()
    }
    lines = [(name, *(whole_run(row) for row in by_capture.values())) for name, by_capture in rows.items()]
    full, paper, *_ = rows.values()
    for name, end in (("end", True), ("best on the way", False)):
        cells = [within_bound(full[capture], paper[capture], end) for capture in CAPTURES]
        lines.append((f"`turbogs-paper`, its end, minus 3DGS, its {name}", *cells))
    return table(("", *CAPTURES), lines)


def best_psnr(row: VariantRow) -> float:
    """dB: the highest that a run had on its way, mean over seeds."""
    return statistics.fmean(max(entry.psnr for entry in cell.history) for cell in row.cells)


def whole_run(row: VariantRow | None) -> str:
    if row is None:
        return "not measured yet"
    means = [row.spread(measure).mean for measure in ("seconds", "psnr", "ssim", "gaussians")]
    return f"{result(*means)}; best on the way {best_psnr(row):.2f} dB ({len(row.cells)})"


def within_bound(full: VariantRow | None, paper: VariantRow | None, end: bool) -> str:
    """The difference of means over all seeds of either, with the standard error of ours, and whether the bound is kept;
    undecided where two standard errors would change that. 3DGS is mostly one run, whose error is not known."""
    if full is None or paper is None:
        return "not measured yet"
    difference = paper.psnr.mean - (full.psnr.mean if end else best_psnr(full))
    values = [cell.final.psnr for cell in paper.cells]
    error = statistics.stdev(values) / math.sqrt(len(values)) if len(values) > 1 else math.nan
    kept = f"{'within' if difference >= -BOUND else 'beyond'} the bound"
    undecided = abs(difference + BOUND) < 2 * error
    return f"{difference:+.2f} ± {error:.2f} dB, {'undecided' if undecided else kept}"
