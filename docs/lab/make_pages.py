"""Fills the tables of README.md and docs/ from the files in docs/lab/, and draws README's plot: `make pages`.

A table stands between ``<!-- made: NAME -->`` and ``<!-- end -->``, where NAME is a key of `TABLES`. A second run
changes nothing. The blocks `BY_OTHERS` are written by docs/lab/numerics.py.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial

import paper_tables
import record
import studies
import timings
from studies import LAB

ROOT = LAB.parents[1]
BLOCK = re.compile(r"(<!-- made: ([\w -]+) -->\n).*?(<!-- end -->)", re.DOTALL)

TABLES: dict[str, Callable[[], str]] = {
    "claim": record.claim,
    "headline": record.headline,
    "record by capture": record.by_capture,
    "held": record.held,
    "sources": record.sources,
    **{f"study {name}": partial(studies.study_table, name) for name in studies.STUDIES},
    "refined cameras": partial(studies.study_table, "cameras", "refined_"),
    "paper parts": paper_tables.paper_parts,
    **{name: partial(paper_tables.changes, name) for name in ("ideas", "components", "tables")},
    "paper whole": paper_tables.paper_whole,
    "wall": timings.wall,
    "steps": timings.steps,
    "raster": timings.raster,
    "gsplat main": timings.gsplat_main,
    "ranks": timings.ranks,
    "rank runs": timings.rank_runs,
    "dropin": timings.dropin,
    "whole step": timings.whole_step,
    "pixels on an mlp": timings.pixels_on_an_mlp,
}

BY_OTHERS = ("solvers", "density_sums")


def filled(page: str) -> str:
    """A page with its tables made anew."""

    def made(block: re.Match[str]) -> str:
        return block[0] if block[2] in BY_OTHERS else f"{block[1]}\n{TABLES[block[2]]()}\n\n{block[3]}"

    return BLOCK.sub(made, page)


if __name__ == "__main__":
    for path in (ROOT / "README.md", *sorted(LAB.parent.rglob("*.md"))):
        path.write_text(filled(path.read_text(encoding="utf-8")), encoding="utf-8")
    record.draw_picture()
