"""``report.md``: what a run did and reached, readable on its own."""

from __future__ import annotations

import platform
from dataclasses import dataclass
from pathlib import Path

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.files import write_text_atomically
from turbogs_plugin.plan import Plan
from turbogs_plugin.report.machine import hardware, software
from turbogs_plugin.report.plots import ERROR_FULL_SCALE, plot_against_seconds, save_strip
from turbogs_plugin.report.tables import ERRORS, number, table
from turbogs_plugin.scene import PosedImages
from turbogs_plugin.train.evaluate import Metrics, render_view
from turbogs_plugin.train.history import Evaluation
from turbogs_plugin.types import Gaussians


@dataclass
class RunRecord:
    """What a report tells of a finished run.

    Args:
        folder: of the run; the report goes there.
        scene: name of the capture.
        config: resolved.
        plan: that the run followed; None where its folder holds none.
        history: every evaluation.
        metrics: of the final model.
        lpips_reason: why LPIPS was not computed; empty where it was.
        num_train_views: V.
    """

    folder: Path
    scene: str
    config: Config
    plan: Plan | None
    history: list[Evaluation]
    metrics: Metrics
    lpips_reason: str
    num_train_views: int


def write_report(record: RunRecord, gaussians: Gaussians, test: PosedImages, sh_degree: int) -> Path:
    """Write ``report.md`` and its pictures (in ``report/``) into the run's folder.

    Args:
        record: of the run.
        gaussians: the final model.
        test: the test views, on the model's device.
        sh_degree: bands in use.

    Returns:
        The page.
    """
    pictures = record.folder / "report"
    pictures.mkdir(exist_ok=True)
    for name, label in (("psnr", "test PSNR in dB"), ("l1", "mean absolute error on test views (0 .. 1)")):
        plot_against_seconds(pictures / f"{name}.png", record.history, name, label, record.scene)
    shown = min(len(test), record.config.report.strips)
    for view_id in range(shown):
        image = render_view(gaussians, test, view_id, sh_degree, record.config.raster)
        save_strip(pictures / f"test-{view_id:03d}.png", test.photos.image(view_id), image)
    page = record.folder / "report.md"
    write_text_atomically(page, _page(record, shown))
    return page


def _page(record: RunRecord, shown: int) -> str:
    last = record.history[-1]
    metrics, train = record.metrics, record.config.train
    views = [
        (view.name, number(view.psnr, 2), number(view.ssim, 4), number(view.l1, 4), number(view.lpips, 4))
        for view in metrics.views
    ]
    result = table(
        (*ERRORS, "LPIPS (VGG)", "training in s", "Gaussians", "FPS", "peak memory in MiB"),
        [
            (
                number(metrics.psnr, 2),
                number(metrics.ssim, 4),
                number(metrics.l1, 4),
                number(metrics.lpips, 4),
                f"{last.train_seconds:.1f}",
                last.num_gaussians,
                f"{metrics.fps:.1f}",
                f"{last.memory_bytes / 2**20:.0f}",
            )
        ],
    )
    lpips = f"\nLPIPS was not computed: {record.lpips_reason}.\n" if record.lpips_reason else ""
    history = table(
        ("iteration", "training in s", *ERRORS, "Gaussians", "peak memory in MiB"),
        (
            (
                evaluation.iteration,
                f"{evaluation.train_seconds:.1f}",
                number(evaluation.psnr, 2),
                number(evaluation.ssim, 4),
                number(evaluation.l1, 4),
                evaluation.num_gaussians,
                f"{evaluation.memory_bytes / 2**20:.0f}",
            )
            for evaluation in record.history
        ),
    )
    strips = "\n\n".join(
        f"{view.name}: {view.psnr:.2f} dB\n\n![{view.name}](report/test-{view_id:03d}.png)"
        for view_id, view in enumerate(metrics.views[:shown])
    )
    return f"""# {record.scene}

{train.iterations} iterations on {record.num_train_views} training views, seed {train.seed}; measured on
{len(metrics.views)} test views.

{result}
{lpips}
Means over the test views. Training time is that of iterations and of the initial error maps; loading, evaluation,
checkpoints and this report are not in it. FPS counts test views rendered one after the other.

## Error against run time

![PSNR against seconds](report/psnr.png)
![mean absolute error against seconds](report/l1.png)

{history}

## Test views

From left to right: photo, render, error (mean absolute difference over RGB: black is 0, bright yellow is
{ERROR_FULL_SCALE} or more). {shown} of {len(metrics.views)} are shown.

{strips}

{table(("view", *ERRORS, "LPIPS (VGG)"), views)}

## Plan

{_plan(record.plan)}

## Numerical events

Iterations with a non-finite loss: {last.nonfinite_losses}. Updates of a Gaussian left out because its gradient was not
finite: {last.skipped_updates}.

## Machine

{hardware(train.device)}, {platform.system()} {platform.machine()}.

{table(("software", "version"), software())}

## Configuration

```yaml
{record.config.to_yaml().rstrip()}
```
"""


def _plan(plan: Plan | None) -> str:
    if plan is None:
        return "The run's folder holds no plan."
    rows = ((decision.setting, decision.text, decision.made, decision.reason) for decision in plan.decisions)
    return f"{plan.facts_text()}.\n\n{table(('setting', 'value', 'made', 'reason'), rows)}"
