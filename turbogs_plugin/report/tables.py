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
    """A text, the name of a photo or a capture, that Markdown shows as it is: no tag, link, code or end of a cell."""
    return re.sub(r"[\\`<\[\]|]", r"\\\g<0>", str(text))


def table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A Markdown table, whose cells are `escaped`."""
    header = [escaped(cell) for cell in header]
    lines = [header, ["---"] * len(header), *([escaped(cell) for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def number(value: float, digits: int, absent: str = "not computed") -> str:
    """A number for a table, with `digits` behind the point; `absent` for NaN."""
    return absent if math.isnan(value) else f"{value:.{digits}f}"


def errors(measured: ViewMetrics | Evaluation, columns: Iterable[str] = ERRORS, psnr_digits: int = 2) -> list[str]:
    """The values of some measures as cells of a table."""
    return [number(getattr(measured, name), psnr_digits if "psnr" in name else 4) for name in columns]


def error_columns(metrics: Metrics) -> dict[str, str]:
    """Measure -> head of its column, for all measures of a model's test views: `ERRORS`, LPIPS, and the kinds
    of `FurtherErrors` that were computed."""
    mean = metrics.mean.further()
    computed = {kind: said for kind, said in FURTHER.items() if not math.isnan(mean[f"{kind}_l1"])}
    further = {f"{kind}_{name}": f"{ERRORS[name]} {said}" for kind, said in computed.items() for name in ERRORS}
    return ERRORS | {"lpips": "LPIPS (VGG)"} | further


def views_table(metrics: Metrics, with_means: bool = False) -> str:
    """A table with the errors of each test view, and with their means as its last line if asked for."""
    columns = error_columns(metrics)
    rows = [[view.name, *errors(view, columns)] for view in metrics.views]
    if with_means:
        rows.append([metrics.mean.name, *errors(metrics.mean, columns, psnr_digits=4)])
    return table(["view", *columns.values()], rows)


def history_table(history: list[Evaluation]) -> str:
    """Error against seconds, for a terminal; and the end's errors by refined test cameras, where there are any."""
    lines = [f"{'iteration':>9}  {'seconds':>8}  {'PSNR':>6}  {'SSIM':>6}  {'L1':>6}  {'Gaussians':>9}"]
    for evaluation in history:
        lines.append(
            f"{evaluation.iteration:>9}  {evaluation.train_seconds:>8.1f}  {evaluation.psnr:>6.2f}  "
            f"{evaluation.ssim:>6.4f}  {evaluation.l1:>6.4f}  {evaluation.num_gaussians:>9}"
        )
    if history and not math.isnan(history[-1].refined_l1):
        last = history[-1]
        refined = f"{last.refined_psnr:>6.2f}  {last.refined_ssim:>6.4f}  {last.refined_l1:>6.4f}"
        lines.append(f"{'refined cameras':>19}  {refined}")
    return "\n".join(lines)
