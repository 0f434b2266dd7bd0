"""The report of a study: ``report.md``, ``report.html``, ``table.csv``, and the plots as PNGs."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from turbogs_plugin.config.configuration import config_names, resolve
from turbogs_plugin.config.sections import parse_seconds
from turbogs_plugin.errors import InputError
from turbogs_plugin.files import write_text_atomically
from turbogs_plugin.report.provenance import Provenance
from turbogs_plugin.report.tables import number
from turbogs_plugin.study.compare import UNSHARED
from turbogs_plugin.study.difference import ABSENT, compared, difference, flattened
from turbogs_plugin.study.document import Block, Heading, Paragraph, Picture, Table, to_html, to_markdown
from turbogs_plugin.study.folder import StudyFolder
from turbogs_plugin.study.grid import Ablation, variant_config
from turbogs_plugin.study.plots import PLOTS, write_plots
from turbogs_plugin.study.results import Study
from turbogs_plugin.study.statistics import Difference, Spread, crossing_gap
from turbogs_plugin.study.summary import CELL_VALUES, SceneSummary, VariantRow, summarise

CLOCKS = {"wall_seconds": "wall in s", "cell_seconds": "load, train, evaluate in s"}
"""Measures of the wall's clock, each with its column, where a cell has it."""

OF_THE_CALL = (*UNSHARED, "budget.", "train.device", "train.batch_for")
"""Settings that belong to a call, or change no result, as a batch for several processes in a cell, which has one. No
page goes stale by them."""

TIMING_RULES = (
    "Seconds are those of training alone: the initial error maps and the iterations, by one clock for all cells, with "
    "the GPU waited for wherever it is read. Loading, evaluation, and reports are not in them."
)

CELL_RULES = (
    "Seconds to load, train and evaluate are a cell's own on the wall: its capture, which all its cells share, the "
    "plan, training, and every evaluation. Imports and warm-up are not in them."
)

REFINED_RULES = (
    "The table above compares renders with test photos by the cameras that the capture gives these. Here each test "
    "photo has the camera that agrees best with where it shows the points that training began with."
)

NO_FLIP = (
    "FLIP was not computed: cells of `turbogs ablate` have it where the package flip-evaluator (the extra flip) is "
    "installed; `turbogs eval RUN` prints that of a run."
)

HOW_TO_READ = (
    "A number is the mean over seeds, the smallest and the largest in brackets where they matter. A difference is the "
    "mean over the seeds that both have, with its standard error; it is clear where noise alone would make so much in "
    "fewer than one case of twenty. A star marks the Pareto front: no other variant is at least as fast and as good."
)


def write_report(folder: StudyFolder, targets: Sequence[float] | None = None) -> Path:
    """Write ``results.json`` of all that is there, and from it the report; the HTML page.

    Args:
        targets: PSNRs in dB whose time is asked for; empty: they follow from the baseline's result; None: those of the
            last report.
    """
    study = folder.read_study()
    folder.write_study(study if targets is None else replace(study, targets=list(targets)))
    study = folder.read_study()  # with the digits that the file keeps
    summaries = summarise(study)
    for summary in summaries:
        write_plots(folder.path, summary)
    blocks = report_blocks(study, summaries)
    title = study.ablation.title
    write_text_atomically(folder.path / "table.csv", table_csv(summaries))
    write_text_atomically(folder.path / "report.md", to_markdown(title, blocks))
    page = folder.path / "report.html"
    write_text_atomically(page, to_html(title, blocks, folder.path))
    return page


def report_blocks(study: Study, summaries: Sequence[SceneSummary]) -> list[Block]:
    """The page."""
    blocks = _header(study)
    for summary in summaries:
        blocks += _scene(summary)
    if study.failures:
        failures = [(str(failure.key), failure.reason) for failure in study.failures]
        blocks += [Heading("Cells without a result"), Table(("cell", "reason"), failures, numeric=False)]
    return blocks + _settings(study)


def _header(study: Study) -> list[Block]:
    results = study.results
    # The plan may have made them other than configured.
    lengths = sorted({result.final.iteration for result in results if not result.time_budget})
    budgets = sorted({result.time_budget for result in results} - {""}, key=parse_seconds)
    warmups = sorted({result.warmup_iterations for result in results})
    length = [f"{_listing(lengths)} iterations"] if lengths else []
    if budgets:
        length.append(f"as many iterations as fit into {', '.join(budgets)} of training, calibration included")
    said = ", or ".join(length)
    warmup = "Without warm-up."
    if any(warmups):
        warmup = (
            f"Before the clock starts, {_listing(warmups)} iterations of the same configuration, scaled to that "
            "length, train a model that is thrown away."
        )
    blocks: list[Block] = [Paragraph(f"{said[:1].upper()}{said[1:]}. {TIMING_RULES} {warmup}"), Paragraph(HOW_TO_READ)]
    missing = sorted({result.lpips_reason for result in results if result.lpips_reason})
    blocks += [Paragraph(f"LPIPS was not computed: {reason}.") for reason in missing]
    blocks += [Paragraph(NO_FLIP)] if all(math.isnan(result.flip) for result in results) else []
    if not all(math.isnan(result.cell_seconds) for result in results):
        blocks.insert(1, Paragraph(CELL_RULES))
    return [*blocks, *_machines(study.provenances), *changed_since(study)]


def changed_since(study: Study) -> list[Paragraph]:
    """A line that marks a page whose baseline a packaged configuration no longer gives."""
    ablation = study.ablation
    # Cells of `turbogs compare`, which records no machine, are of a run's folder: it may be called as a configuration.
    if ablation.base not in config_names() or study.provenances == [None]:
        return []
    try:
        changed = changed_settings(study, ablation.baseline, ablation)
    except InputError as error:  # a setting of then, in the ablation's own words
        return [Paragraph(f"Stale: {error}.")]
    return [Paragraph(f"Stale: '{ablation.base}' is no longer what was measured here. {changed}")] if changed else []


def changed_settings(study: Study, variant: str, ablation: Ablation) -> str:
    """``Then: KEY VALUE (now VALUE).``: what a study's cells of a variant have other than an ablation gives it today.

    What the study's call asked for itself is no change. Empty where nothing has changed, or the study has no such
    cells.

    Raises:
        InputError: the ablation has a setting that there is no more.
    """
    measured = next((result for result in study.results if result.variant == variant), None)
    if measured is None:
        return ""
    present = flattened(variant_config(ablation, variant, 0, measured.overrides, measured.steps).to_mapping())
    defaults = resolve({}).to_mapping()  # which settings have that are newer than the cells
    asked = compared(defaults, OF_THE_CALL) | compared(measured.asked, OF_THE_CALL)
    changed = sorted(path for path in difference(present, asked) if path != ABSENT and path in present)
    return f"Then: {', '.join(f'{path} {asked[path]} (now {present[path]})' for path in changed)}." if changed else ""


def _machines(provenances: Sequence[Provenance | None]) -> list[Block]:
    recorded = [entry for entry in provenances if entry is not None]
    rows = [
        (
            entry.machine,
            entry.kernels,
            entry.commit or "unknown",
            entry.day or "not recorded",
            ", ".join(map(" ".join, entry.software.items())),
        )
        for entry in recorded
    ]
    header = ("machine", "kernels", "commit", "day", "software")
    blocks: list[Block] = [Table(header, rows, numeric=False)] if rows else []
    if None in provenances:
        blocks.append(Paragraph("The machine is not recorded for every run; seconds compare only within one machine."))
    if len({entry.machine for entry in recorded}) > 1:
        blocks.append(Paragraph("Cells are from different machines: their seconds do not compare."))
    return blocks


def _scene(summary: SceneSummary) -> list[Block]:
    against = f" against {summary.baseline}" if summary.baseline else ""
    columns = _columns(summary, against)
    reach_header, reach_lines = ["variant"], [[row.name] for row in summary.rows]
    for target in summary.targets:
        reach_header += [f"s to {target:.1f} dB", f"ratio{against}"]
        for row, line in zip(summary.rows, reach_lines, strict=True):
            line += [_reach_text(row.seconds_to(target)), _ratio_text(row.ratio_to(target))]
    blocks: list[Block] = [
        Heading(summary.scene),
        Table([head for head, _ in columns], [[cell(row) for _, cell in columns] for row in summary.rows]),
        *(Picture(f"{summary.scene}-{plot.name}.png", f"{summary.scene}: {plot.text}") for plot in PLOTS),
        *(_by_refined_cameras(summary, against) if _has(summary, "refined_psnr") else []),
        Heading(f"Time to reach a PSNR on {summary.scene}", 3),
        Table(reach_header, reach_lines),
    ]
    cells = [cell for row in summary.rows for cell in row.cells]
    gaps = [crossing_gap(cell.history, target) for cell in cells for target in summary.targets]
    if crossed := [gap for gap in gaps if not math.isnan(gap)]:
        apart = spread_text(Spread.of(crossed), 2)
        text = "These seconds are linear between evaluations. The two on either side of a crossing are "
        text += f"{apart} s of training apart: differences smaller than that are not measured."
        blocks.append(Paragraph(text))
    budgeted = {
        row.name: sorted(cell.final.iteration for cell in row.cells if cell.time_budget) for row in summary.rows
    }
    fitted = [f"{name} ({_listing(iterations)})" for name, iterations in budgeted.items() if iterations]
    if fitted:
        blocks.append(Paragraph(f"Iterations that fit into the time budget, of each seed: {', '.join(fitted)}."))
    return blocks


def _by_refined_cameras(summary: SceneSummary, against: str) -> list[Block]:
    """The same models' errors by other cameras of the test photos."""
    errors = {"refined_psnr": ("PSNR in dB", f"PSNR{against}", 2), "refined_ssim": ("SSIM", f"SSIM{against}", 4)}
    lines = []
    for row in summary.rows:
        line = [row.name]
        for measure, (*_, digits) in errors.items():
            compared = "" if summary.baseline in ("", row.name) else difference_text(row.difference(measure), digits)
            line += [spread_text(row.spread(measure), digits), compared]
        lines.append(line)
    header = ("variant", *(head for heads in errors.values() for head in heads[:2]))
    return [Heading(f"By refined test cameras on {summary.scene}", 3), Paragraph(REFINED_RULES), Table(header, lines)]


def _has(summary: SceneSummary, measure: str) -> bool:
    """Whether any cell has it: wall seconds are those of runs, and older cells lack what was recorded later."""
    return not all(math.isnan(CELL_VALUES[measure](cell)) for row in summary.rows for cell in row.cells)


def _columns(summary: SceneSummary, against: str) -> list[tuple[str, Callable[[VariantRow], str]]]:
    """Heads of the columns of results, each with what gives a row's cell."""

    def spread(measure: str, digits: int, absent: str = "not computed") -> Callable[[VariantRow], str]:
        return lambda row: spread_text(row.spread(measure), digits, absent)

    def mean(measure: str, absent: str = "not computed", unit: int = 1) -> Callable[[VariantRow], str]:
        return lambda row: number(row.spread(measure).mean / unit, 0, absent)

    def unless_baseline(text: Callable[[VariantRow], str]) -> Callable[[VariantRow], str]:
        return lambda row: "" if summary.baseline in ("", row.name) else text(row)

    return [
        ("variant", lambda row: row.name),
        ("front", lambda row: "★" if row.on_front else ""),
        ("seeds", lambda row: str(len(row.cells))),
        ("time in s", spread("seconds", 1)),
        *((head, spread(clock, 1, "-")) for clock, head in CLOCKS.items() if _has(summary, clock)),
        (f"time{against}", unless_baseline(lambda row: _ratio_text(row.ratio("seconds")))),
        ("PSNR in dB", spread("psnr", 2)),
        (f"PSNR{against}", unless_baseline(lambda row: difference_text(row.difference("psnr"), 2))),
        ("worst view in dB", spread("worst_psnr", 2, "not recorded")),
        ("SSIM", spread("ssim", 4)),
        (f"SSIM{against}", unless_baseline(lambda row: difference_text(row.difference("ssim"), 4))),
        ("LPIPS (VGG)", spread("lpips", 4)),
        *([("FLIP", spread("flip", 4))] if _has(summary, "flip") else []),
        ("Gaussians", mean("gaussians")),
        ("FPS", mean("fps", "not recorded")),
        ("peak MiB", mean("peak_bytes", "not measured", 2**20)),
    ]


def difference_text(difference: Difference, digits: int) -> str:
    """``+0.14 ± 0.05 (clear)``; without an error for one seed; empty where there is no common seed."""
    if not difference.count or math.isnan(difference.mean):
        return ""
    text = f"{difference.mean:+.{digits}f}"
    if difference.clear is not None:
        text += f" ± {difference.standard_error:.{digits}f}"
    return f"{text} (clear)" if difference.clear else text


def _ratio_text(ratio: float) -> str:
    """``x 0.83``; empty where there is none."""
    return "" if math.isnan(ratio) else f"x {ratio:.2f}"


def _reach_text(seconds: Sequence[float]) -> str:
    reached = sum(map(math.isfinite, seconds))
    if not reached:
        return "not reached"
    return f"{reached} of {len(seconds)} seeds" if reached < len(seconds) else spread_text(Spread.of(seconds), 2)


def spread_text(spread: Spread, digits: int, absent: str = "not computed") -> str:
    """``mean [low, high]``; the mean alone for one seed."""
    mean, low, high = (number(value, digits, absent) for value in (spread.mean, spread.low, spread.high))
    return mean if spread.count == 1 or math.isnan(spread.mean) else f"{mean} [{low}, {high}]"


def _settings(study: Study) -> list[Block]:
    ablation = study.ablation
    tried = {result.variant for result in study.results} | {failure.key.variant for failure in study.failures}
    rows = [
        (name, ", ".join(overrides) or "as the base", ablation.notes.get(name, ""))
        for name, overrides in ablation.variants.items()
        if name in tried
    ]
    kept = "as resolved" if all(result.resolved for result in study.results) else "as asked for"
    text = f"Overrides of the configuration '{ablation.base}'. results.json has every cell's configuration, {kept}."
    return [Heading("Variants"), Paragraph(text), Table(("variant", "overrides", "note"), rows, numeric=False)]


def table_csv(summaries: Sequence[SceneSummary]) -> str:
    """All numbers of the tables, unrounded; empty where not computed or not measured, ``inf`` where never reached."""
    lines: list[dict[str, Any]] = []
    later = {*CLOCKS, "flip", "refined_psnr", "refined_ssim"}
    measures = [name for name in CELL_VALUES if name not in later or any(_has(summary, name) for summary in summaries)]
    for summary in summaries:
        for row in summary.rows:
            line = {"scene": summary.scene, "variant": row.name, "seeds": len(row.cells), "pareto": row.on_front}
            for measure in measures:
                spread = row.spread(measure)
                line |= {f"{measure}_mean": spread.mean, f"{measure}_low": spread.low, f"{measure}_high": spread.high}
            for measure in ("psnr", "ssim", "seconds"):
                difference = row.difference(measure)
                line |= {f"{measure}_difference": difference.mean, f"{measure}_error": difference.standard_error}
            for place, target in enumerate(summary.targets):
                line[f"target_{place}_psnr"] = target
                line[f"target_{place}_seconds"] = Spread.of(row.seconds_to(target)).mean
                line[f"target_{place}_ratio"] = row.ratio_to(target)
            lines.append({name: "" if value is None or value != value else value for name, value in line.items()})
    text = io.StringIO()
    writer = csv.DictWriter(text, lines[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()


def _listing(values: Sequence[float]) -> str:
    return ", ".join(f"{value:g}" for value in values)
