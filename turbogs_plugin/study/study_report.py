"""Report of a study: ``report.md`` with tables for each capture, and a plot."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path

from turbogs_plugin.files import write_text_atomically
from turbogs_plugin.report.tables import escaped, table
from turbogs_plugin.study.results import Study, StudyFolder
from turbogs_plugin.study.statistics import Difference, SceneSummary, Spread, summarise
from turbogs_plugin.study.study_plots import PLOT, write_plot

MEASURES = {
    "seconds": ("training in s", 2),
    "cell_seconds": ("load, train, evaluate in s", 1),
    "wall_seconds": ("whole command in s", 1),
    "psnr": ("PSNR in dB", 2),
    "worst_psnr": ("worst view in dB", 2),
    "refined_psnr": ("PSNR by refined test cameras", 2),
    "ssim": ("SSIM", 4),
    "refined_ssim": ("SSIM by refined test cameras", 4),
    "lpips": ("LPIPS (VGG)", 4),
    "gaussians": ("Gaussians", 0),
    "fps": ("FPS", 0),
    "peak_mib": ("peak MiB", 0),
}
"""Measure of `CellResult.final` -> head of its column, and digits behind the point."""
COMPARED = ("psnr", "refined_psnr", "ssim", "refined_ssim")
"""Measures beside which a column has the difference from the baseline."""

HOW_TO_READ = (
    "Seconds of training are the initial error maps and the iterations, without loading, evaluation and reports. A "
    "number is the mean over seeds with its standard error. A difference is of two such means; it is clear where noise "
    "alone would make as large a one in fewer than one case of twenty (Welch's t-test, at least three seeds of each). "
    "Seconds to a PSNR are linear between evaluations."
)


def write_report(folder: StudyFolder) -> Path:
    """Write ``results.json`` of everything in the folder, and from it the plot and the page; the page."""
    folder.write_study(folder.read_study())
    study = folder.read_study()  # with the digits that the file keeps
    summaries = summarise(study)
    write_plot(folder.path, summaries)
    page = folder.path / "report.md"
    write_text_atomically(page, report_text(study, summaries))
    return page


def report_text(study: Study, summaries: Sequence[SceneSummary]) -> str:
    """The page, in Markdown."""
    reasons = dict.fromkeys(result.lpips_reason for result in study.results if result.lpips_reason)
    said = [HOW_TO_READ, *(f"LPIPS was not computed: {escaped(reason)}." for reason in reasons)]
    parts = [f"# {escaped(study.ablation.title)}", *(textwrap.fill(text, 120, break_on_hyphens=False) for text in said)]
    parts += [_machines(study), f"![PSNR and SSIM against seconds of training]({PLOT})"]
    for summary in summaries:
        parts += [f"## {escaped(summary.scene)}", _results(summary)]
        parts += [_times(summary)] if summary.targets else []
    ablation, tried = study.ablation, {result.variant for result in study.results}
    variants = [
        (name, ", ".join(overrides) or f"as {ablation.base}", ablation.notes.get(name, ""))
        for name, overrides in ablation.variants.items()
        if name in tried
    ]
    parts += ["## Variants", table(("variant", "overrides", "note"), variants)]
    return "\n\n".join(parts) + "\n"


def _machines(study: Study) -> str:
    rows = []
    for made in study.provenances:
        software = made and ", ".join(map(" ".join, made.software.items()))
        known = made and (made.machine, made.kernels, made.commit or "unknown", made.day, software or "")
        rows.append(known or ("not recorded: seconds compare only within one machine", "", "", "", ""))
    return table(("machine", "kernels", "commit", "day", "software"), rows)


def _results(summary: SceneSummary) -> str:
    """Table of results: a row for each variant, a column for each measure that a cell has."""
    against = f" against {summary.baseline}"
    compared = summary.baseline and len(summary.rows) > 1
    columns = {"variant": [row.name for row in summary.rows], "seeds": [str(len(row.cells)) for row in summary.rows]}
    for measure, (head, digits) in MEASURES.items():
        if not any(measure in cell.final for row in summary.rows for cell in row.cells):
            continue
        columns[head] = [spread_text(row.spread(measure), digits) for row in summary.rows]
        if compared and measure == "seconds":
            columns[f"time{against}"] = [_ratio_text(row.ratio(measure)) for row in summary.rows]
        if compared and measure in COMPARED:
            others = {row.name: difference_text(row.difference(measure), digits) for row in summary.rows}
            columns[head + against] = [*(others | {summary.baseline: ""}).values()]
    return table(columns, zip(*columns.values(), strict=True))


def _times(summary: SceneSummary) -> str:
    """Table of the time to reach a PSNR."""
    header, lines = ["variant"], [[row.name] for row in summary.rows]
    for target in summary.targets:
        header += [f"s to {target:.1f} dB", f"ratio against {summary.baseline}"]
        for row, line in zip(summary.rows, lines, strict=True):
            seconds = row.seconds_to(target)
            reached = sum(map(math.isfinite, seconds))
            some = f"{reached} of {len(seconds)} seeds" if reached else "not reached"
            text = spread_text(Spread.of(seconds), 2) if reached == len(seconds) else some
            line += [text, _ratio_text(row.ratio_to(target))]
    return table(header, lines)


def spread_text(spread: Spread, digits: int) -> str:
    """``mean ± standard error``; the mean alone for one seed; ``-`` where there is none."""
    if math.isnan(spread.mean):
        return "-"
    mean = f"{spread.mean:.{digits}f}"
    return mean if math.isnan(spread.standard_error) else f"{mean} ± {spread.standard_error:.{digits}f}"


def difference_text(difference: Difference, digits: int) -> str:
    """``+0.14 ± 0.05 (clear)``; without an error for one seed; empty where there is none."""
    if math.isnan(difference.mean):
        return ""
    error = difference.standard_error
    text = f"{difference.mean:+.{digits}f}" + ("" if math.isnan(error) else f" ± {error:.{digits}f}")
    return f"{text} (clear)" if difference.clear else text


def _ratio_text(ratio: float) -> str:
    """``x 0.83``; empty where there is none."""
    return "" if math.isnan(ratio) else f"x {ratio:.2f}"
