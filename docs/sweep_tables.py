"""Tables of a round of sweeps: ``docs/results/sweeps/ROUND.json`` has its cells, ``ROUND.yaml`` says what stands where.

    python docs/sweep_tables.py ROUND
    python docs/sweep_tables.py ROUND --gather STUDY=results.json [STUDY=results.json ...]

The first prints the tables, which `make pages` writes into ``ROUND.md`` between ``<!-- made: ROUND TABLE -->`` and
``<!-- end -->``. The second writes ``ROUND.json`` from results of `turbogs ablate`. Every cell stands in some table.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import yaml
from turbogs_plugin.config.schema import build_dataclass, nearest

from turbogs_plugin.errors import InputError
from turbogs_plugin.report.tables import table
from turbogs_plugin.study.pages import difference_text
from turbogs_plugin.study.results_file import study_from_json
from turbogs_plugin.study.statistics import Difference, Spread

RESULTS = Path(__file__).resolve().parent / "results"
FOLDER = RESULTS / "sweeps"
EXTRA = ("own_psnr", "aligned_psnr", "refined_psnr", "refined_ssim")
"""Further measures of the end that are gathered where a run has them."""


@dataclass(frozen=True)
class Cell:
    """One training.

    Args:
        study, variant: the name that a row has for it is ``study variant``.
        overrides: of the configuration of the round.
        psnr, ssim, num_gaussians, train_seconds: at each evaluation, the end last; seconds may be left out, as where
            several runs shared a GPU.
        extra: further measures of the end.
    """

    study: str
    variant: str
    scene: str
    seed: int
    overrides: list[str]
    psnr: list[float]
    ssim: list[float]
    num_gaussians: list[int]
    train_seconds: list[float] = field(default_factory=list)
    extra: dict[str, float] = field(default_factory=dict)

    @property
    def name(self) -> str:
        return f"{self.study} {self.variant}"


@dataclass(frozen=True)
class Layout:
    """One table.

    Args:
        captures: in the order of their columns -> the head of the column.
        rows: label -> the names of its cells; seeds of several names are put together.
        against: label of the row that all others are compared with; "": of none.
        quoted: label -> capture -> a method of peers.json, whose numbers stand first.
        extra: further measures that are shown -> how they are called.
    """

    captures: dict[str, str]
    rows: dict[str, list[str]]
    against: str = ""
    quoted: dict[str, dict[str, str]] = field(default_factory=dict)
    extra: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Round:
    """Args:
    tables: name -> what stands in it.
    """

    tables: dict[str, Layout]


def rounds(folder: Path = FOLDER) -> list[str]:
    """Names of the rounds whose cells are kept."""
    return sorted(path.stem for path in folder.glob("*.yaml"))


def names(folder: Path = FOLDER) -> list[str]:
    """``ROUND TABLE`` of every table."""
    return [f"{name} {key}" for name in rounds(folder) for key in layouts_of(name, folder)]


def layouts_of(name: str, folder: Path = FOLDER) -> dict[str, Layout]:
    """Name of each table of a round -> what stands in it."""
    return build_dataclass(Round, yaml.safe_load((folder / f"{name}.yaml").read_text()), f"{name}.yaml").tables


def tables_of(name: str, folder: Path = FOLDER) -> dict[str, str]:
    """Name of each table of a round -> its Markdown.

    Raises:
        InputError: a row names cells that are not there, or has a seed twice; a cell stands in no table.
    """
    layouts = layouts_of(name, folder)
    cells = read_cells(folder / f"{name}.json")
    shown = {cell for layout in layouts.values() for names in layout.rows.values() for cell in names}
    if left := sorted({cell.name for cell in cells} - shown):
        raise InputError(f"{name}.yaml: cells in no table: {', '.join(left)}; give them a row")
    return {key: table_of(layout, cells, f"{name}.yaml: {key}") for key, layout in layouts.items()}


def read_cells(path: Path) -> list[Cell]:
    """The cells of a round's file."""
    read = enumerate(json.loads(path.read_text()))
    return [build_dataclass(Cell, cell, f"{path.name}[{number}]") for number, cell in read]


def table_of(layout: Layout, cells: Sequence[Cell], where: str) -> str:
    """PSNR with its range over seeds, SSIM and Gaussians; then the differences from the row that it is compared with,
    over the seeds that both have, and how many seeds the row has."""
    if layout.against and layout.against not in layout.rows:
        raise InputError(f"{where}: no row is called '{layout.against}', {nearest(layout.against, layout.rows)}")
    lines = [(label, *quoted(methods, layout.captures)) for label, methods in layout.quoted.items()]
    chosen = {label: chosen_cells(names, cells, f"{where}: '{label}'") for label, names in layout.rows.items()}
    base = chosen.get(layout.against, {})
    for label, found in chosen.items():
        compared = {} if label == layout.against else base
        pairs = [(found.get(scene, {}), compared.get(scene, {})) for scene in layout.captures]
        lines.append((label, *(cell_text(own, other, layout.extra) for own, other in pairs)))
    return table(("", *layout.captures.values()), lines)


def difference_of(name: str, key: str, label: str, scene: str, measure: str) -> Difference:
    """What a row of a table has more than the row that it is compared with, at the end, on one capture.

    Raises:
        KeyError: the round has no such table, or the table no such row.
    """
    layout, cells = layouts_of(name)[key], read_cells(FOLDER / f"{name}.json")
    own, base = (chosen_cells(layout.rows[row], cells, key).get(scene, {}) for row in (label, layout.against))
    return ends_apart(own, base, measure)


def ends_apart(own: Mapping[int, Cell], base: Mapping[int, Cell], measure: str) -> Difference:
    """Over the seeds that both have."""
    seeds = [seed for seed in own if seed in base]
    return Difference.of([getattr(own[seed], measure)[-1] - getattr(base[seed], measure)[-1] for seed in seeds])


def chosen_cells(names: Sequence[str], cells: Sequence[Cell], where: str) -> dict[str, dict[int, Cell]]:
    """Capture -> seed -> the cell of any of these names."""
    known = {cell.name for cell in cells}
    found: dict[str, dict[int, Cell]] = {}
    for name in names:
        if name not in known:
            raise InputError(f"{where}: no cell is called '{name}', {nearest(name, known)}")
        for cell in cells:
            if cell.name != name:
                continue
            if cell.seed in found.setdefault(cell.scene, {}):
                raise InputError(f"{where}: seed {cell.seed} of {cell.scene} is there twice; give each its own row")
            found[cell.scene][cell.seed] = cell
    return found


def cell_text(own: Mapping[int, Cell], base: Mapping[int, Cell], extra: Mapping[str, str]) -> str:
    """``5.6 s, 32.24 [32.15, 32.32] dB, .8938, 94k; +0.44 ± 0.12 dB, +0.0075 ± 0.0004 (2)``; empty without cells."""
    if not own:
        return ""
    psnr = Spread.of(cell.psnr[-1] for cell in own.values())
    ssim = Spread.of(cell.ssim[-1] for cell in own.values())
    size = Spread.of(cell.num_gaussians[-1] for cell in own.values())
    seconds = Spread.of(cell.train_seconds[-1] if cell.train_seconds else None for cell in own.values())
    spread = f" [{psnr.low:.2f}, {psnr.high:.2f}]" if psnr.count > 1 else ""
    parts = [] if math.isnan(seconds.mean) else [f"{seconds.mean:.1f} s"]
    parts += [f"{psnr.mean:.2f}{spread} dB", f"{ssim.mean:.4f}".lstrip("0"), f"{size.mean / 1e3:.0f}k"]
    for measure, called in extra.items():
        further = Spread.of(cell.extra.get(measure) for cell in own.values()).mean
        text = f"{further:.4f}".lstrip("0") if measure.endswith("ssim") else f"{further:.2f} dB"
        parts += [] if math.isnan(further) else [f"{called} {text}".lstrip()]
    changes = []
    for measure, unit, digits in (("psnr", " dB", 2), ("ssim", "", 4)):
        value, clear, _ = difference_text(ends_apart(own, base, measure), digits).partition(" (clear)")
        changes += [f"{value}{unit}{clear}"] if value else []
    text = "; ".join(filter(None, (", ".join(parts), ", ".join(changes))))
    return f"{text} ({psnr.count})"


def quoted(methods: Mapping[str, str], captures: Mapping[str, str]) -> list[str]:
    """The peers' own numbers, from peers.json."""
    rows = json.loads((RESULTS / "peers.json").read_text())["rows"]
    found = {(row["method"], row["capture"]): row for row in rows}
    texts = []
    for scene in captures:
        row = found[methods[scene], scene] if scene in methods else None
        texts.append("" if row is None else f"{row['psnr']:.2f} dB, {row['ssim']:.3f}, {row['gaussians'] / 1e3:.0f}k")
    return [text.replace(" 0.", " .") for text in texts]


def gather(name: str, studies: Mapping[str, Path], folder: Path = FOLDER) -> Path:
    """Write a round's cells from the results of its studies, with every evaluation; the file.

    Args:
        studies: name of a study -> its ``results.json``.
    """
    cells = []
    for study, path in studies.items():
        results = study_from_json(path)
        for result in results.results:
            cell = {"study": study, "scene": result.scene, "variant": result.variant, "seed": result.seed}
            cell["overrides"] = list(results.ablation.variants[result.variant])
            for measure, digits in (("psnr", 3), ("ssim", 5), ("num_gaussians", 0), ("train_seconds", 2)):
                values = [round(getattr(entry, measure), digits) for entry in result.history]
                cell[measure] = [int(value) for value in values] if measure == "num_gaussians" else values
            ends = {measure: round(getattr(result.history[-1], measure), 5) for measure in EXTRA}
            if known := {measure: value for measure, value in ends.items() if not math.isnan(value)}:
                cell["extra"] = known
            cells.append(cell)
    file = folder / f"{name}.json"
    file.write_text("[\n" + ",\n".join(map(json.dumps, cells)) + "\n]\n")
    return file


def main() -> None:
    parser = argparse.ArgumentParser(description="Tables of a round of sweeps.")
    parser.add_argument("round")
    parser.add_argument("--gather", nargs="+", metavar="STUDY=RESULTS", default=[])
    options = parser.parse_args()
    if options.gather:
        studies = dict(entry.split("=", 1) for entry in options.gather)
        print(gather(options.round, {study: Path(path) for study, path in studies.items()}))
        return
    for key, text in tables_of(options.round).items():
        print(f"{key}\n\n{text}\n")


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(f"sweep_tables: {error}")
