"""Records of the screen, from one of several processes to the one that makes the step of some rows."""

from __future__ import annotations

from turbogs_plugin.engine.rendered import ScreenRecords


def collect_records(source: ScreenRecords, target: ScreenRecords, row: int, view: int, adds: bool) -> None:
    """`Engine.collect`. Where a Gaussian is off screen, this copies as well what the source's record holds."""
    rows = slice(row, row + target.records.shape[1])
    first = int(adds)
    if adds:
        target.records[view] += source.records[0, rows]
    views = slice(view + first, view + len(source.records))
    target.records[views] = source.records[first:, rows]
    target.radii[views] = source.radii[first:, rows]
