"""Tables of README.md and of pages in docs/ that are made of the studies in docs/results."""

from __future__ import annotations

import json
import math
from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

import machine_tables

from turbogs_plugin.report.tables import table
from turbogs_plugin.study.document import Heading, Paragraph, to_markdown
from turbogs_plugin.study.folder import StudyFolder
from turbogs_plugin.study.grid import load_ablation
from turbogs_plugin.study.pages import changed_settings, changed_since, difference_text, report_blocks, spread_text
from turbogs_plugin.study.results import CellResult, Study
from turbogs_plugin.study.statistics import Spread
from turbogs_plugin.study.summary import VariantRow, summarise

ROOT = Path(__file__).resolve().parent.parent
CAPTURES = ("fox", "caliterra", "snowmiku")

OURS = (
    ("baselines", "3dgs", "3DGS by gsplat's strategy in our renderer, 30,000 iterations"),
    ("baselines", "3dgs-as-shipped", "the same with gsplat 1.5.3's reset of opacities, which never happens"),
    ("baselines", "mcmc", "MCMC by gsplat's strategy in our renderer, 30,000 iterations"),
    ("baselines", "fastgs", "density by votes of many views, after FastGS, in our renderer, 30,000 iterations"),
    ("paper", "turbogs-paper", "turbogs-paper"),
    ("sizes", "ssim", "turbogs-ssim"),
    ("sizes", "cap-67k", "turbogs-small with a cap, FastGS's numbers"),
    ("sizes", "cap-157k", "turbogs-small with a cap, FastGS's numbers"),
    ("sizes", "cap-57k", "turbogs-small with a cap, FastGS's numbers"),
    ("sizes", "cap-94k", "turbogs-small with a cap, LiteGS's number on fox"),
    ("sizes", "turbogs", "**turbogs**"),
)
"""Rows of the headline table that are ours, where they are measured: study, variant, what to call it."""

CAPS = {"cap-67k": "fox", "cap-157k": "caliterra", "cap-57k": "snowmiku", "cap-94k": "fox"}
"""Whose capture's row a cap is in: FastGS has so many Gaussians there, and LiteGS 94k on fox."""


@cache
def read_study(folder: Path) -> Study:
    return StudyFolder(folder).read_study()


def read_peers() -> dict[str, Any]:
    """What the others' own programs reach."""
    return json.loads((ROOT / "docs/results/peers.json").read_text())


def rows_of(study: str) -> dict[str, dict[str, VariantRow]]:
    """Capture -> variant -> its row; none of a study that is not measured yet."""
    if not (ROOT / "docs/results" / study / "results.json").is_file():
        return {}
    summaries = summarise(read_study(ROOT / "docs/results" / study))
    return {summary.scene: {row.name: row for row in summary.rows} for summary in summaries}


def shown(study: str, variant: str) -> dict[str, VariantRow]:
    """Capture -> a variant's row, for the cells that the headline table has of it."""
    found = {capture: rows[variant] for capture, rows in rows_of(study).items() if variant in rows}
    return {capture: found[capture] for capture in captures_of(variant) if capture in found}


def captures_of(variant: str) -> list[str]:
    """The captures that the headline table has a variant of."""
    return [capture for capture in CAPTURES if CAPS.get(variant, capture) == capture]


def result(
    seconds: float, psnr: float | Spread, ssim: float | None, gaussians: float | None, wall: str | None = None
) -> str:
    """``4.1 s, 32.20 dB, .893, 209k``; what was not recorded is left out. With `wall`, ``4.1 / 9.5 s``; with the PSNR's
    spread over several seeds, ``32.20 [32.05, 32.31] dB``."""
    size = None if gaussians is None else size_text(gaussians)
    clocks = duration(seconds) if wall is None else f"{duration(seconds)} / {wall}"
    error = spread_text(psnr, 2) if isinstance(psnr, Spread) else f"{psnr:.2f}"
    parts = [f"{clocks} s", f"{error} dB"]
    parts += [] if ssim is None else [f"{ssim:.3f}".lstrip("0")]
    return ", ".join(parts if size is None else [*parts, size])


def size_text(gaussians: float) -> str:
    return f"{gaussians / 1e6:.2f}M" if gaussians >= 1e6 else f"{gaussians / 1e3:.0f}k"


def duration(seconds: float) -> str:
    return "-" if math.isnan(seconds) else f"{seconds:.1f}" if seconds < 10 else f"{seconds:.0f}"


def headline() -> str:
    """Ours beside the others, on each capture: seconds of training, and on the wall where they were recorded."""
    peers = read_peers()
    lines: dict[str, dict[str, str]] = {}
    for entry in peers["rows"]:
        beyond = peers["beyond_training"].get(entry["method"].split()[0], ())
        wall = " to ".join(duration(entry["seconds"] + more) for more in sorted(set(beyond))) or "-"
        cell = result(entry["seconds"], entry["psnr"], entry["ssim"], entry["gaussians"], wall)
        lines.setdefault(entry["method"], {})[entry["capture"]] = cell
    for study, variant, name in OURS:
        for capture, row in shown(study, variant).items():
            seconds, ssim, gaussians = (row.spread(measure).mean for measure in ("seconds", "ssim", "gaussians"))
            wall = whole_command(variant, capture)
            seeds = f" ({len(row.cells)})" if len(row.cells) > 1 else ""
            lines.setdefault(name, {})[capture] = f"{result(seconds, row.psnr, ssim, gaussians, wall)}{seeds}"
    return by_capture("", lines)


def refined() -> str:
    """PSNR and SSIM of ours in README by refined cameras of the test photos, where they were measured."""
    lines: dict[str, dict[str, str]] = {}
    for study, variant, name in OURS:
        for capture, row in shown(study, variant).items():
            psnr, ssim = (row.spread(measure) for measure in ("refined_psnr", "refined_ssim"))
            if not math.isnan(psnr.mean):
                error = f"{spread_text(psnr, 2)} dB, {ssim.mean:.3f}".replace(" 0.", " .")
                lines.setdefault(name, {})[capture] = f"{error} ({psnr.count})"
    return by_capture("by refined test cameras", lines)


def by_capture(head: str, lines: dict[str, dict[str, str]]) -> str:
    """A table of rows that have a cell for some captures."""
    rows = [[name, *(cells.get(capture, "") for capture in CAPTURES)] for name, cells in lines.items()]
    return table((head, *CAPTURES), rows)


def whole_command(variant: str, capture: str) -> str:
    """Seconds of a whole `turbogs train`, the run in the middle of `turbogs bench wall`, with a sign where they are not
    of README's commit."""
    report = json.loads(machine_tables.WALL.read_text()).get(variant, {}).get(capture)
    if not report:
        return duration(math.nan)
    return duration(report["median"]["seconds"]) + ("°" if mark(report["provenance"]["commit"]) else "")


def ahead() -> str:
    """When `turbogs` had the PSNR that the others end with, how much sooner, and how many times their Gaussians."""
    ours = {capture: rows["turbogs"] for capture, rows in rows_of("sizes").items()}
    lines: dict[str, dict[str, str]] = {}
    for entry in read_peers()["rows"]:
        row = ours[entry["capture"]]
        times = [time for time in row.seconds_to(entry["psnr"]) if math.isfinite(time)]
        if len(times) == len(row.cells):
            mean = math.fsum(times) / len(times)
            parts = [f"{mean:.1f} s, {entry['seconds'] / mean:.0f} times sooner"]
        else:  # a mean over those that came so far would leave out the slow ones
            parts = [f"reached by {len(times)} of {len(row.cells)} seeds"]
        if entry["gaussians"]:
            parts.append(f"x {row.spread('gaussians').mean / entry['gaussians']:.1f} N")
        lines.setdefault(entry["method"], {})[entry["capture"]] = ", ".join(parts)
    return by_capture("against", lines)


SAME_SIZE = 0.02
"""Numbers of Gaussians that differ by less are called the same."""


def at_their_size() -> str:
    """The others whose number of Gaussians one of our caps has: the errors there, less theirs, and how much sooner."""
    lines: dict[str, dict[str, str]] = {}
    for entry in read_peers()["rows"]:
        for variant, capture in CAPS.items():
            row = rows_of("sizes").get(capture, {}).get(variant)
            if row is None or capture != entry["capture"] or not entry["gaussians"]:
                continue
            seconds, ssim, gaussians = (row.spread(measure).mean for measure in ("seconds", "ssim", "gaussians"))
            if abs(gaussians / entry["gaussians"] - 1.0) > SAME_SIZE:
                continue
            sooner = f"{entry['seconds'] / seconds:.1f} times sooner"
            better = f"{row.psnr.mean - entry['psnr']:+.2f} dB, {ssim - entry['ssim']:+.4f}"
            cell = f"{entry['gaussians'] / 1e3:.0f}k: {better}, {sooner} ({len(row.cells)})"
            lines.setdefault(entry["method"], {})[capture] = cell
    return by_capture("at the number of", lines)


NEAR = {"psnr": 0.1, "ssim": 0.001}
"""Errors that differ by less are called as good: a run of the others is one seed."""


def behind() -> str:
    """Where the others have less error than `turbogs`, or as little with fewer Gaussians."""
    lines = []
    for entry in read_peers()["rows"]:
        row = rows_of("sizes")[entry["capture"]]["turbogs"]
        size = (entry["gaussians"] or math.inf) / row.spread("gaussians").mean
        for measure, digits in (("psnr", 2), ("ssim", 3)):
            theirs, ours = entry[measure], row.spread(measure).mean
            if theirs is None or theirs < ours - NEAR[measure]:
                continue
            more = theirs > ours + NEAR[measure]
            if more or size < 1:
                texts = (f"{value:.{digits}f}".removeprefix("0") for value in (theirs, ours))
                how = f"{', '.join(texts)}{' dB' if measure == 'psnr' else ' SSIM'}"
                which = f"{entry['method']}, {entry['capture']}"
                lines.append((which, how, "" if math.isinf(size) else f"{size:.2f}"))
    return table(("against", "their error, ours", "their Gaussians / ours"), lines)


def headline_sources() -> str:
    """Machine, commit and day of each row of ours, stale where that is not the commit of **turbogs**; a line for what a
    packaged configuration no longer gives."""
    said: dict[str, set[str]] = {}
    changed: list[str] = []
    for study, variant, name in OURS:
        rows = shown(study, variant).values()
        places = [place for row in rows for cell in row.cells if (place := cell.provenance)]
        if rows:
            where = {
                machine_tables.place(place.machine, place.commit, place.day) + mark(place.commit) for place in places
            }
            said.setdefault(name, set()).update(where)
            changed += [*other_settings(study), *other_variant(study, variant, name)]
    lines = [(name, "; ".join(sorted(where)) or "not recorded") for name, where in said.items()]
    walls: dict[str, dict[str, None]] = {}
    reports = json.loads(machine_tables.WALL.read_text())
    for variant, name in [(variant, name) for study, variant, name in OURS if study == "sizes" and variant in reports]:
        places = (machine_tables.where(of) + mark(of["provenance"]["commit"]) for of in reports[variant].values())
        walls.setdefault(f"whole command of {name}", {}).update(dict.fromkeys(places))
    lines += [(name, "; ".join(where)) for name, where in walls.items()]
    lines.append(("the others", read_peers()["measured"]))
    return "\n\n".join([table(("row", "measured on"), lines), *dict.fromkeys(changed)])


def commit_of(cell: CellResult) -> str:
    """As pages name it; "" where it was not recorded."""
    return machine_tables.short(cell.provenance.commit) if cell.provenance else ""


def readme_commit() -> str:
    """That of most runs of README's **turbogs**; "" where none is recorded. What has another one is stale."""
    runs = (cell for row in shown("sizes", "turbogs").values() for cell in row.cells)
    commits = Counter(filter(None, map(commit_of, runs)))
    return max(commits, key=commits.__getitem__, default="")


def mark(commit: str) -> str:
    """What stands behind a commit that is not README's."""
    readme = readme_commit()
    return " (stale)" if readme and commit and machine_tables.short(commit) != readme else ""


def changes(study: str, errors: str = "") -> str:
    """Every variant of a study against its own baseline, over the same seeds.

    Args:
        errors: prefix of the measures of PSNR and SSIM, in `CELL_VALUES`.
    """
    found = rows_of(study)
    captures = [capture for capture in CAPTURES if capture in found]
    lines = []
    for variant in read_study(ROOT / "docs/results" / study).ablation.variants:
        cells = []
        for capture in captures:
            row = found[capture].get(variant)
            cells.append("" if row is None or row.cells == row.base else change(row, errors))
        if any(cells):
            lines.append((variant, *cells))
    return "\n\n".join([table(("", *captures), lines), *stale(study)])


def stale(study: str) -> list[str]:
    """Lines that say what was measured where a study's baseline is not today's or its commit not README's."""
    return [*other_settings(study), *(block.markdown() for block in other_commit(study))]


def other_settings(study: str) -> list[str]:
    """A line that says what was measured where a study's baseline is not today's; none where it is."""
    folder = ROOT / "docs/results" / study
    measured = (folder / "results.json").is_file()
    return [block.markdown() for block in changed_since(read_study(folder))] if measured else []


def other_variant(study: str, variant: str, name: str) -> list[str]:
    """A line that says with what settings a variant was measured where its packaged ablation has others today."""
    folder, packaged = ROOT / "docs/results" / study, load_ablation(study)
    if variant == packaged.baseline or variant not in packaged.variants:
        return []
    then = changed_settings(read_study(folder), variant, packaged)
    return [Paragraph(f"Stale: {name} has other settings now. {then}").markdown()] if then else []


def other_commit(study: str) -> list[Paragraph]:
    """A line that says how many cells of a study are of another commit than README's; none where all are of that."""
    folder, readme = ROOT / "docs/results" / study, readme_commit()
    cells = read_study(folder).results if (folder / "results.json").is_file() else []
    others = Counter(commit for cell in cells if (commit := commit_of(cell)) not in ("", readme))
    if not readme or not others:
        return []
    which = f"commit{'s' if len(others) > 1 else ''} {', '.join(others)}"
    count = f"{others.total()} of {len(cells)} cells of `{study}`"
    return [Paragraph(f"Stale: {count} were measured at {which}; README's `turbogs` at {readme}.")]


def study_page(study: str) -> str:
    """``report.md`` of a study: what `turbogs report` writes, and above its first capture the line of `other_commit`,
    of which only README's results know."""
    measured = read_study(ROOT / "docs/results" / study)
    blocks = report_blocks(measured, summarise(measured))
    first = next(place for place, block in enumerate(blocks) if isinstance(block, Heading))
    return to_markdown(measured.ablation.title, [*blocks[:first], *other_commit(study), *blocks[first:]])


def change(row: VariantRow, errors: str = "") -> str:
    """Differences in PSNR and SSIM, ratios of time and Gaussians, and how many seeds; `errors` as in `changes`."""
    sizes = row.ratio("gaussians")
    error, said, clear = difference_text(row.difference(f"{errors}psnr"), 2).partition(" (clear)")
    parts = [f"{error} dB{said}{clear}", difference_text(row.difference(f"{errors}ssim"), 4)]
    parts += [f"x {row.ratio('seconds'):.2f} s", "" if math.isnan(sizes) else f"x {sizes:.2f} N"]
    return f"{', '.join(filter(None, parts))} ({row.difference('psnr').count})"
