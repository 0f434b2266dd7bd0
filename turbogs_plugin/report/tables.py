"""Tables of results, in Markdown."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable

from turbogs_plugin.train.history import Evaluation
from turbogs_plugin.train.metrics import Metrics, ViewMetrics

ERRORS = {"psnr": "PSNR in dB", "ssim": "SSIM", "l1": "mean absolute error"}
"""Measure -> head of its column, in every table of errors. Masked pixels do not count in them."""

FURTHER = {"own": "of the model's own colours", "refined": "by refined test cameras"}
"""Kind of `FurtherErrors` -> what the head of its column adds."""


def escaped(text: object) -> str:
    """A name of a photo or a capture that Markdown shows as it is: no tag, link, code, line or end of a cell."""
    return re.sub(r"[\\`<\[\]|]", r"\\\g<0>", " ".join(str(text).split()))


def table(header: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """A Markdown table, whose cells are `escaped`."""
    header = [escaped(cell) for cell in header]
    lines = [header, ["---"] * len(header), *([escaped(cell) for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def number(value: float, digits: int, absent: str = "not computed") -> str:
    """A number for a table, with `digits` behind the point; `absent` for NaN."""
    return absent if math.isnan(value) else f"{value:.{digits}f}"


def errors(measured: ViewMetrics | Evaluation, columns: Iterable[str] = ERRORS) -> list[str]:
    """The values of some measures as cells of a table."""
    return [number(getattr(measured, name), 2 if "psnr" in name else 4) for name in columns]


def error_columns(metrics: Metrics) -> dict[str, str]:
    """Measure -> head of its column, for all measures of a model's test views: `ERRORS`, LPIPS, and the kinds
    of `FurtherErrors` that were computed."""
    mean = metrics.mean.further()
    computed = {kind: said for kind, said in FURTHER.items() if not math.isnan(mean[f"{kind}_l1"])}
    further = {f"{kind}_{name}": f"{ERRORS[name]} {said}" for kind, said in computed.items() for name in ERRORS}
    return ERRORS | {"lpips": "LPIPS (VGG)"} | further


def views_table(metrics: Metrics) -> str:
    """A table with the errors of each test view."""
    columns = error_columns(metrics)
    return table(["view", *columns.values()], [[view.name, *errors(view, columns)] for view in metrics.views])


def short_table(metrics: Metrics) -> str:
    """PSNR in dB, SSIM and, where it was computed, LPIPS, for a terminal: of each test view, then the means."""
    mean, views = metrics.mean, [(view.name, view.psnr, view.ssim, view.lpips) for view in metrics.views]
    for kind, said in FURTHER.items():
        if not math.isnan(getattr(mean, f"{kind}_psnr")):
            views.append((f"mean {said}", getattr(mean, f"{kind}_psnr"), getattr(mean, f"{kind}_ssim"), math.nan))
    rows = [["view", "PSNR", "SSIM", *([] if math.isnan(mean.lpips) else ["LPIPS"])]]
    for name, *values in (*views, (mean.name, mean.psnr, mean.ssim, mean.lpips)):
        rows.append([name, *(number(value, digits, "") for value, digits in zip(values, (2, 4, 4), strict=True))])
    width = max(len(row[0]) for row in rows)
    return "\n".join(f"{row[0]:<{width}}" + "".join(f"  {cell:>6}" for cell in row[1 : len(rows[0])]) for row in rows)
