"""Fills the tables of README.md and of pages in docs/ from results, and marks the pages of studies that are of another
commit than README's numbers; `make pages` runs it.

A table stands between ``<!-- made: NAME -->`` and ``<!-- end -->``, where NAME is a key of `TABLES`; what is between
them is replaced, unless there is nothing yet to make it of. A second run changes nothing.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache

import capture_tables
import goal_tables
import machine_tables
import paper_tables
import scaling_model
import study_tables
import sweep_tables
import viewer_tables
from headline_picture import PICTURE, draw, picture_data, picture_digest
from study_tables import ROOT

from turbogs_plugin.study.plots import save_plot

PAGES = tuple(
    ROOT / name
    for name in (
        "README.md",
        "docs/captures.md",
        "docs/comparison.md",
        "docs/drop-in.md",
        "docs/formats.md",
        "docs/numerics.md",
        "docs/paper.md",
        "docs/plan.md",
        "docs/results/README.md",
        "docs/results/sweeps.md",
        "docs/scaling.md",
        "docs/results/h200/README.md",
        "docs/results/h200/house.md",
        "docs/results/h200/masks.md",
        "docs/viewer.md",
        *(f"docs/results/sweeps/{name}.md" for name in sweep_tables.rounds()),
    )
)
BLOCK = re.compile(r"(<!-- made: ([\w -]+) -->\n).*?(<!-- end -->)", re.DOTALL)


@cache
def round_tables(name: str) -> dict[str, str]:
    return sweep_tables.tables_of(name)


def round_table(name: str, table_name: str) -> str:
    return round_tables(name)[table_name]


TABLES: dict[str, Callable[[], str | None]] = {
    "ahead": study_tables.ahead,
    "at_their_size": study_tables.at_their_size,
    "behind": study_tables.behind,
    "bounds": lambda: study_tables.changes("bounds"),
    "cameras": lambda: study_tables.changes("cameras"),
    "cameras refined": lambda: study_tables.changes("cameras", "refined_"),
    "density_departures": lambda: study_tables.changes("density_departures"),
    "density_sums": machine_tables.density_sums,
    "departures": lambda: study_tables.changes("departures"),
    "dropin": machine_tables.dropin,
    "exposure_runs": capture_tables.exposure_runs,
    "exports": viewer_tables.exports,
    "exposures": machine_tables.exposures,
    "goals": goal_tables.goals,
    "headline": study_tables.headline,
    "headline_sources": study_tables.headline_sources,
    "house_iterations": lambda: machine_tables.iterations(machine_tables.measured("house.json")),
    "house_runs": machine_tables.house_runs,
    "lenses": capture_tables.lenses,
    "many_photos": capture_tables.many_photos,
    "masked_iterations": capture_tables.masked_iterations,
    "masked_runs": capture_tables.masked_runs,
    "photos_alone": capture_tables.photos_alone,
    "leave_out": lambda: study_tables.changes("leave_out"),
    "masks_iterations": lambda: machine_tables.iterations(machine_tables.measured("masks.json")),
    "overlays caption": viewer_tables.overlays_caption,
    "paper_parts": paper_tables.paper_parts,
    "paper_whole": paper_tables.paper_whole,
    "parts": lambda: study_tables.changes("parts"),
    "tried": goal_tables.tried,
    "viewer": viewer_tables.viewer,
    "memory": lambda: machine_tables.on("bench-step.json", machine_tables.memory),
    "offload": lambda: machine_tables.on("bench-4k.json", machine_tables.offload),
    "precision": lambda: machine_tables.on("bench-raster.json", machine_tables.precision),
    "render caption": viewer_tables.render_caption,
    "ranks": machine_tables.ranks,
    "rank_runs": machine_tables.rank_runs,
    "pixels_on_an_mlp": machine_tables.pixels_on_an_mlp,
    "refined": study_tables.refined,
    "raster": lambda: machine_tables.on("bench-raster.json", machine_tables.raster),
    "solvers": machine_tables.solvers,
    "steps": lambda: machine_tables.steps("bench-step.json"),
    "steps_h100": lambda: machine_tables.steps("bench-step-h100.json"),
    "steps_ssim": lambda: machine_tables.steps("bench-step-ssim.json"),
    "wall": machine_tables.wall,
}
TABLES |= {name: lambda name=name: round_table(*name.split()) for name in sweep_tables.names()}
TABLES |= {f"predicted {name}": lambda name=name: scaling_model.tables()[name] for name in scaling_model.tables()}


def filled(text: str) -> str:
    """A page with its tables made anew."""
    return BLOCK.sub(_made, text)


def _made(block: re.Match[str]) -> str:
    made = TABLES[block[2]]()
    return block[0] if made is None else f"{block[1]}\n{made}\n\n{block[3]}"


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(filled(page.read_text()))
    for results in ROOT.glob("docs/results/*/results.json"):
        results.with_name("report.md").write_text(study_tables.study_page(results.parent.name))
    save_plot(PICTURE, lambda: draw(picture_data()), picture_digest())
