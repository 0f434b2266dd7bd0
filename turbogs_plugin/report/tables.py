"""Tables of results, in Markdown."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable

from turbogs_plugin.train.metrics import Metrics

ERRORS = {"psnr": "PSNR in dB", "ssim": "SSIM", "l1": "mean absolute error"}
"""Measure -> head of its column, in every table of errors. Masked pixels do not count in them."""

FURTHER = {
    "own": (
        "of the model's own colours",
        "A test photo is compared with the render in the exposure of the training photos before and after it; the"
        " model's own colours are without exposures.",
    ),
    "refined": (
        "by refined test cameras",
        "Renders are by the cameras that the capture gives to test photos; refined test cameras were found by where"
        " each test photo shows the points.",
    ),
}
"""Kind of `FurtherErrors` -> what the name of its row adds, and how they differ from the plain errors."""


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


def explained(metrics: Metrics) -> list[str]:
    """A sentence for each kind of `FurtherErrors` that was computed."""
    return [said for kind, (_, said) in FURTHER.items() if not math.isnan(getattr(metrics.mean, f"{kind}_l1"))]


Row = tuple[str, float, float, float, float]
"""Name, PSNR in dB, SSIM, mean absolute error and LPIPS; NaN where one was not computed."""


def error_rows(metrics: Metrics) -> tuple[list[Row], list[Row]]:
    """Rows of the test views, and of means over them, where the plain ones are last."""
    mean = metrics.mean
    views, means = ([(of.name, of.psnr, of.ssim, of.l1, of.lpips) for of in these] for these in (metrics.views, [mean]))
    for kind, (name, _) in FURTHER.items():
        psnr, ssim, l1 = (getattr(mean, f"{kind}_{measure}") for measure in ERRORS)
        if not math.isnan(l1):
            means.insert(-1, (f"mean {name}", psnr, ssim, l1, math.nan))
    return views, means


def errors_table(rows: Iterable[Row]) -> str:
    """A table of errors."""
    cells = [[name, *map(number, values, (2, 4, 4, 4))] for name, *values in rows]
    return table(["", *ERRORS.values(), "LPIPS (VGG)"], cells)


def short_table(metrics: Metrics) -> str:
    """PSNR in dB, SSIM and, where it was computed, LPIPS, for a terminal: of each test view, then the means."""
    rows, (views, means) = [["view", "PSNR", "SSIM", "LPIPS"]], error_rows(metrics)
    for name, psnr, ssim, _, lpips in (*views, *means):
        rows.append([name, number(psnr, 2), number(ssim, 4, ""), number(lpips, 4, "")])
    width, columns = max(len(row[0]) for row in rows), 3 if math.isnan(metrics.mean.lpips) else 4
    return "\n".join(f"{row[0]:<{width}}" + "".join(f"  {cell:>6}" for cell in row[1:columns]) for row in rows)
