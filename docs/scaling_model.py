"""Prints the predictions of docs/scaling.md: what an iteration takes on N GPUs, and what a GPU holds.

python docs/scaling_model.py
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

BANDWIDTH = 300e9
"""Bytes a second that a GPU sends, and receives at the same time, through NCCL over NVLink 4 (450e9 by the sheet)."""

COPY = 4.3e12
"""Bytes a second that a copy on an H200 reads and writes."""

LATENCY = 0.03
"""Milliseconds of a small exchange."""

RECORD, COLOR, PARAMETERS, MOMENTS, PASS = 72, 12, 236, 504, 213
"""Bytes: record with radii; colour of a sample; parameters of a Gaussian; its moments and statistics; and what a pass
holds of a Gaussian in a view, records and intersections among it (measured, turbogs_plugin/plan/memory.py)."""


DRAW = 0.35
"""Share of the draw in what every process does: parameters travel meanwhile."""

PROJECTION = 0.15
"""Share of the projection in forward and backward pass: it takes as long for a part of a view as for all of it."""


@dataclass(frozen=True)
class Case:
    """An iteration on one GPU, its parts in milliseconds: measured up to 600k, scaled by the Gaussians beyond.

    Args:
        gaussians, views: M, K.
        whole: draw of the pixels, loss and maps, density control, gaps; every process does all of it.
        shared: forward and backward pass; each process does that of its share.
        solve: projection backward and step of the optimizer; each process does that of its rows.
        samples: of all views.
    """

    gaussians: float
    views: int
    whole: float
    shared: float
    solve: float
    samples: float = 1.26e6

    def on(self, count: int, owners: bool = True) -> float:
        """Milliseconds on so many GPUs."""
        if count == 1:
            return self.whole + self.shared + self.solve
        others, views = (count - 1) / count, self.views_of(count)
        colors = COLOR * self.samples * others
        records = RECORD * self.gaussians * views * (others if owners else count - 1)
        parameters = PARAMETERS * self.gaussians * others if owners else 0.0
        packed = 2 * (RECORD * self.gaussians * views + 2 * parameters)  # own records are copied, others' are packed
        exchange = 1e3 * ((colors + records) / BANDWIDTH + packed / COPY) + LATENCY * (4 if owners else 3)
        exchange += max(0.0, 1e3 * parameters / BANDWIDTH - DRAW * self.whole)
        passes = self.shared * ((1 - PROJECTION) / count + PROJECTION * views / self.views)
        return self.whole + passes + self.solve / (count if owners else 1) + exchange

    def views_of(self, count: int) -> int:
        """The most views that a process has a part of."""
        ends = [self.views * place / count for place in range(count + 1)]
        return max(math.ceil(end) - math.floor(start) for start, end in itertools.pairwise(ends))

    def larger(self, gaussians: float) -> Case:
        """With more Gaussians: projection and step grow with them, half of the passes is of the pixels."""
        factor = gaussians / self.gaussians
        return replace(self, gaussians=gaussians, shared=self.shared * (0.5 + 0.5 * factor), solve=self.solve * factor)

    def gigabytes(self, count: int) -> float:
        """Of a GPU: model, moments and statistics, twice as at an event of density control; passes and exchange."""
        views = self.views_of(count)
        exchanged = 0.0 if count == 1 else RECORD * (views * (count - 1) + self.views) / count + PARAMETERS
        return self.gaussians * (2 * (PARAMETERS + MOMENTS) + PASS * views + exchanged) / 1e9


MEASURED = {
    "150k, K = 3": Case(150e3, 3, 0.18, 0.95, 0.09),
    "150k, K = 10": Case(150e3, 10, 0.36, 1.41, 0.16),
    "600k, K = 3": Case(600e3, 3, 0.27, 1.42, 0.29),
    "600k, K = 10": Case(600e3, 10, 0.37, 2.57, 0.50),
}
COUNTS = (1, 2, 4, 8)


def table(head: str, rows: dict[str, list[str]]) -> str:
    """A Markdown table with a column for each number of GPUs."""
    lines = [f"| {head} | " + " | ".join(map(str, COUNTS)) + " |", "| --- |" + " --- |" * len(COUNTS)]
    return "\n".join([*lines, *(f"| {name} | " + " | ".join(cells) + " |" for name, cells in rows.items())])


def main() -> None:
    largest = MEASURED["600k, K = 10"]
    cases = MEASURED | {"10M, K = 10": largest.larger(10e6), "100M, K = 10": largest.larger(100e6)}
    for owners, title in ((True, "owners of rows"), (False, "records to all")):
        rows = {}
        for name, case in cases.items():
            times = [case.on(count, owners) for count in COUNTS]
            rows[name] = [f"{time:.2f} ms, {times[0] / time:.2f}x" for time in times]
        print(table(title, rows), end="\n\n")
    rows = {
        name: [f"{case.gigabytes(count):.0f} GB" for count in COUNTS]
        for name, case in cases.items()
        if case.gaussians >= 10e6
    }
    print(table("memory of a GPU", rows))


if __name__ == "__main__":
    main()
