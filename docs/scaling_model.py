"""Prints the predictions of docs/scaling.md: what an iteration takes on N GPUs, and what GPUs and machines hold.

python docs/scaling_model.py
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

BANDWIDTH = 300e9
"""Bytes a second that a GPU sends, and receives at the same time, through NCCL over NVLink 4 (450e9 by the sheet)."""

COPY = 4.3e12
"""Bytes a second that a copy on an H200 reads and writes."""

NETWORK = 50e9
"""The same between machines: one network card of 400 Gbit/s a GPU."""

HOST_LINK = 56e9
"""Bytes a second between a GPU and its host, in and out together: .29 + .17 GB in an iteration of 8.19 ms
(docs/results/h200, photos and maps in host memory)."""

LATENCY = 0.03
"""Milliseconds of a small exchange."""

RADII, RECORD, COLOR, PARAMETERS, MOMENTS, PASS = 8, 72, 12, 236, 504, 213
"""Bytes: radii; record with radii; colour of a sample; parameters of a Gaussian; its moments and statistics; and what a
pass holds of a Gaussian in a view, records and intersections among it (measured, turbogs_plugin/plan/memory.py)."""


DRAW = 0.35
"""Share of the draw in what every process does: parameters that are sent as messages travel meanwhile."""

IN_VIEW = 0.4
"""Share of the Gaussians that a view has on screen (docs/performance.md: 31 to 44 %)."""

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

    def on(self, count: int, owners: bool = True, in_place: bool = True, bandwidth: float = BANDWIDTH) -> float:
        """Milliseconds on so many GPUs. Without owners, every process is sent all records, and makes all steps."""
        if count == 1:
            return self.whole + self.shared + self.solve
        others, views = (count - 1) / count, self.views_of(count)
        colors = COLOR * self.samples * others
        record = RADII + IN_VIEW * (RECORD - RADII) if in_place else RECORD
        records = record * self.gaussians * views * (others if owners else count - 1)
        parameters = PARAMETERS * self.gaussians * others if owners else 0.0
        packed = 2 * record * self.gaussians * views  # own records are copied; in messages, others' are packed
        packed += 0.0 if in_place else 4 * parameters
        exchange = 1e3 * ((colors + records) / bandwidth + packed / COPY)
        exchange += LATENCY * (3 if in_place or not owners else 4)
        solve, travel = self.solve / (count if owners else 1), 1e3 * parameters / bandwidth
        if in_place:
            solve = max(solve, travel)  # the step itself writes to all
        else:
            exchange += max(0.0, travel - DRAW * self.whole)
        passes = self.shared * ((1 - PROJECTION) / count + PROJECTION * views / self.views)
        return self.whole + passes + solve + exchange

    def views_of(self, count: int) -> int:
        """The most views that a process has a part of."""
        ends = [self.views * place / count for place in range(count + 1)]
        return max(math.ceil(end) - math.floor(start) for start, end in itertools.pairwise(ends))

    def larger(self, gaussians: float) -> Case:
        """With more Gaussians: projection and step grow with them, half of the passes is of the pixels."""
        factor = gaussians / self.gaussians
        return replace(self, gaussians=gaussians, shared=self.shared * (0.5 + 0.5 * factor), solve=self.solve * factor)

    def grown(self, factor: int) -> Case:
        """With so many times the views and pixels (`train.batch_for`). Of the solve, .4 is a Gaussian's whatever K."""
        return replace(
            self,
            views=self.views * factor,
            whole=self.whole * factor,
            shared=self.shared * factor,
            solve=self.solve * (0.4 + 0.6 * factor),
            samples=self.samples * factor,
        )

    def of_pixels(self, samples: float) -> Case:
        """With so many samples an iteration."""
        factor = samples / self.samples
        return replace(self, whole=self.whole * factor, shared=self.shared * (0.5 + 0.5 * factor), samples=samples)

    def gigabytes(self, count: int, sharded: int = 0) -> float:
        """Of a GPU: model, moments and statistics, twice as at an event of density control; passes and exchange.

        Args:
            sharded: how many of `NEXT` are done, of which each takes something away.
        """
        views, events = self.views_of(count), 1 if sharded >= 2 else 2
        moments = MOMENTS / count if sharded >= 1 else MOMENTS
        passes = PASS * (1 if sharded >= 3 else views)
        exchanged = 0.0 if count == 1 else RECORD * (views * (count - 1) + self.views) / count + PARAMETERS
        exchanged *= 1 / views if sharded >= 3 else 1
        parameters = PARAMETERS
        if sharded >= 4:
            parameters, passes = PARAMETERS / count, passes * IN_VIEW
        return self.gaussians * (events * (parameters + moments) + passes + exchanged) / 1e9


NEXT = (
    "today",
    "moments and statistics with owners alone",
    "an event that works in place",
    "passes and records view after view",
    "parameters by place in space",
)
"""What one would shard next, each with those before it."""

# The steps of docs/results/h200/bench-step.json, rounded.
MEASURED = {
    "150k, K = 3": Case(150e3, 3, 0.13, 1.11, 0.09),
    "150k, K = 10": Case(150e3, 10, 0.30, 1.71, 0.16),
    "600k, K = 3": Case(600e3, 3, 0.13, 1.90, 0.33),
    "600k, K = 10": Case(600e3, 10, 0.30, 3.29, 0.56),
}
COUNTS = (1, 2, 4, 8)

PHOTOS, PIXELS, EPOCHS = 10_000, 2e6, 60
"""A large capture, and how often its pixels are looked at."""


def table(head: str, rows: dict[str, list[str]], columns: Sequence[object] = COUNTS) -> str:
    """A Markdown table, with a column for each number of GPUs unless others are named."""
    lines = [f"| {head} | " + " | ".join(map(str, columns)) + " |", "| --- |" + " --- |" * len(columns)]
    return "\n".join([*lines, *(f"| {name} | " + " | ".join(cells) + " |" for name, cells in rows.items())])


def way_of(exchange: str) -> tuple[bool, bool]:
    """(owners, in_place) of `Case.on`, by the name of an exchange as `turbogs bench ranks` has it."""
    return not exchange.startswith("records to all"), exchange.endswith("in place")


EXCHANGES = {
    "owners": "owners of rows, in place",
    "messages": "owners of rows, messages",
    "records": "records to all, messages",
}


def tables() -> dict[str, str]:
    """The tables of the page, by name."""
    largest = MEASURED["600k, K = 10"]
    cases = MEASURED | {"10M, K = 10": largest.larger(10e6), "100M, K = 10": largest.larger(100e6)}
    made = {}
    for which, title in EXCHANGES.items():
        rows = {}
        for name, case in cases.items():
            times = [case.on(count, *way_of(title)) for count in COUNTS]
            rows[name] = [f"{time:.2f} ms, {times[0] / time:.2f}x" for time in times]
        made[which] = table(title, rows)
    rows = {}
    for name, case in cases.items():
        times = [case.grown(count).on(count) for count in COUNTS]
        faster = zip(times, COUNTS, strict=True)
        rows[name] = [f"{time:.2f} ms, {count * times[0] / time:.2f}x" for time, count in faster]
    made["grown"] = table("N times the views and pixels", rows)
    rows = {
        name: [f"{case.on(count, in_place=False, bandwidth=NETWORK):.2f} ms" for count in COUNTS]
        for name, case in cases.items()
        if case.views == 10
    }
    made["network"] = table("a machine for each GPU", rows)
    large = {name: case for name, case in cases.items() if case.gaussians >= 10e6}
    rows = {name: [f"{case.gigabytes(count):.0f} GB" for count in COUNTS] for name, case in large.items()}
    made["memory"] = table("memory of a GPU", rows)
    rows = {
        what: [f"{large['100M, K = 10'].gigabytes(count, place):.0f} GB" for count in COUNTS]
        for place, what in enumerate(NEXT)
    }
    made["sharded"] = table("memory of a GPU, 100M", rows)
    made["photos"] = table(f"{PHOTOS:,} photos of {PIXELS / 1e6:.0f} megapixels", photos(cases))
    return made


def photos(cases: dict[str, Case]) -> dict[str, list[str]]:
    """Rows for a large capture: its memory, what of it travels, and how long the training takes."""
    stored, bytes_of_pixel = PHOTOS * PIXELS * (3 + 4) / 1e9, 3 + 4 + 4  # in: photo and map; out: map
    travel = {count: 1e3 * 10 * PIXELS * bytes_of_pixel / HOST_LINK / count for count in COUNTS}
    rows = {
        "host memory of the machine, as it is": [f"{stored * count:.0f} GB" for count in COUNTS],
        "the same, shared by its processes": [f"{stored:.0f} GB" for _ in COUNTS],
        "or on the GPUs, by view: of each": [f"{stored / count:.0f} GB" for count in COUNTS],
        "travel of 10 views, as it is": [f"{travel[1]:.1f} ms" for _ in COUNTS],
        "travel, each process the views it renders": [f"{travel[count]:.1f} ms" for count in COUNTS],
    }
    for name in ("600k, K = 10", "10M, K = 10"):
        case, size = cases[name].of_pixels(PIXELS), name.partition(",")[0]
        usual = [max(case.on(count), travel[1]) for count in COUNTS]
        grown = [max(case.grown(count).on(count), count * travel[1]) / count for count in COUNTS]
        sharded = [max(case.grown(count).on(count), travel[1]) / count for count in COUNTS]
        for what, times in (("", usual), (", N times the batch", grown), (" and own views alone", sharded)):
            what = f", N times the batch{what}" if times is sharded else what
            rows[f"{EPOCHS} epochs at {size}{what}"] = [f"{time * EPOCHS * PHOTOS / 3.6e6:.1f} h" for time in times]
    return rows


if __name__ == "__main__":
    print(*tables().values(), sep="\n\n")
