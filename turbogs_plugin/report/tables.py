"""Tables of results, in Markdown."""

from __future__ import annotations

import math
from collections.abc import Iterable

from turbogs_plugin.train.evaluate import Metrics, ViewMetrics
from turbogs_plugin.train.history import Evaluation

ERRORS = ("PSNR in dB", "SSIM", "mean absolute error")
"""Heads of the columns that every table of errors has. Masked pixels do not count in them."""

WHOLE_ERRORS = tuple(f"{name} with masked pixels" for name in ERRORS)
"""Heads of the further columns where test views have masks."""

ALIGNED_ERRORS = tuple(f"{name} after colour alignment" for name in ERRORS)
"""Heads of the further columns where renders were also aligned in colour to the test photos."""


def table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A Markdown table."""
    header = list(header)
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(str(cell) for cell in line)} |" for line in lines)


def number(value: float, digits: int, absent: str = "not computed") -> str:
    """A number for a table, with so many digits behind the point; `absent` for NaN."""
    return absent if math.isnan(value) else f"{value:.{digits}f}"


def errors(measured: ViewMetrics | Evaluation, psnr_digits: int = 2) -> list[str]:
    """The numbers for the columns `ERRORS`, and for "LPIPS (VGG)" where the measurement has one."""
    names = ("psnr", "ssim", "l1") if isinstance(measured, Evaluation) else ("psnr", "ssim", "l1", "lpips")
    return [number(getattr(measured, name), psnr_digits if name == "psnr" else 4) for name in names]


def whole_errors(measured: ViewMetrics | Evaluation, psnr_digits: int = 2) -> list[str]:
    """The numbers for the columns `WHOLE_ERRORS`; none where no test view has a mask."""
    if math.isnan(measured.whole_l1):
        return []
    return [number(measured.whole_psnr, psnr_digits), number(measured.whole_ssim, 4), number(measured.whole_l1, 4)]


def aligned_errors(measured: ViewMetrics | Evaluation, psnr_digits: int = 2) -> list[str]:
    """The numbers for the columns `ALIGNED_ERRORS`; none where no colours were aligned."""
    if math.isnan(measured.aligned_l1):
        return []
    psnr = number(measured.aligned_psnr, psnr_digits)
    return [psnr, number(measured.aligned_ssim, 4), number(measured.aligned_l1, 4)]


def views_table(metrics: Metrics, with_means: bool = False) -> str:
    """A table with the errors of each test view, and with their means as its last line if asked for. FLIP has a column
    where it was computed, and so have errors with masked pixels and those after colour alignment."""
    measured = [(view, 2) for view in metrics.views] + ([(metrics.mean, 4)] if with_means else [])
    rows = [[view.name, *errors(view, digits)] for view, digits in measured]
    header = ["view", *ERRORS, "LPIPS (VGG)"]
    if not all(math.isnan(view.flip) for view in metrics.views):
        header.append("FLIP")
        for row, (view, _) in zip(rows, measured, strict=True):
            row.append(number(view.flip, 4))
    if whole_errors(metrics.mean):
        header += WHOLE_ERRORS
        for row, (view, digits) in zip(rows, measured, strict=True):
            row += whole_errors(view, digits)
    if aligned_errors(metrics.mean):
        header += ALIGNED_ERRORS
        for row, (view, digits) in zip(rows, measured, strict=True):
            row += aligned_errors(view, digits)
    return table(header, rows)


def history_table(history: list[Evaluation]) -> str:
    """Error against seconds, for a terminal."""
    lines = [f"{'iteration':>9}  {'seconds':>8}  {'PSNR':>6}  {'SSIM':>6}  {'L1':>6}  {'Gaussians':>9}"]
    for evaluation in history:
        lines.append(
            f"{evaluation.iteration:>9}  {evaluation.train_seconds:>8.1f}  {evaluation.psnr:>6.2f}  "
            f"{evaluation.ssim:>6.4f}  {evaluation.l1:>6.4f}  {evaluation.num_gaussians:>9}"
        )
    return "\n".join(lines)
