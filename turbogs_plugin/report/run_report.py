"""``report.md``, a page that tells what a run did and reached."""

from __future__ import annotations

import platform
import shlex
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from turbogs_plugin.files import read_text, write_text_atomically
from turbogs_plugin.report.evaluation import load_lpips
from turbogs_plugin.report.images import ERROR_FULL_SCALE, save_image, strip, titled
from turbogs_plugin.report.provenance import hardware, software
from turbogs_plugin.report.tables import ERRORS, error_rows, errors_table, escaped, explained, number, table
from turbogs_plugin.strategies.view_sampling import doubted
from turbogs_plugin.train.metrics import Metrics, evaluate, render_view
from turbogs_plugin.train.session import RunSession

STRIPS = 8
"""Most test views, and most doubted photos, that the page shows."""
DOUBTED = """
The model does not explain these training photos as it does the others: look for a wrong pose, a passer-by, blur or
another light. The view sampler `random` takes each in one of five rounds."""


def write_report(run: RunSession) -> Path:
    """Write ``report.md``, the page that is given back, and its pictures (in ``report/``) into the run's folder."""
    trainer = run.trainer
    lpips, lpips_reason = load_lpips(trainer.device)
    metrics = None if lpips else run.evaluations.metrics  # of the end
    if metrics is None:
        metrics = evaluate(trainer.gaussians, run.test, trainer.look(run.test.names), lpips, further=True)
    run.clock.mark("report")
    view_errors = trainer.maps.view_means()
    worst = [int(view) for view in np.argsort(-view_errors)[:STRIPS] if doubted(view_errors)[view]]
    strips = min(len(run.test), STRIPS)
    _write_pictures(run, strips, worst)
    run.clock.mark("pictures and plots")
    times = {view: view_errors[view] / np.median(view_errors) for view in worst}
    write_text_atomically(run.folder.report, _page(run, metrics, lpips_reason, strips, times))
    run.clock.mark("report")
    return run.folder.report


def _write_pictures(run: RunSession, strips: int, worst: list[int]) -> None:
    """Write the page's pictures: the first test views, the training photos that were doubted, and the plots."""
    pictures, trainer = run.folder.path / "report", run.trainer
    pictures.mkdir(exist_ok=True)
    shown = [("test", run.test, list(range(strips)))] + ([("doubted", trainer.views, worst)] if worst else [])
    with ThreadPoolExecutor() as pool:  # pictures are encoded while others are rendered and plots are drawn
        encoded = []
        for kind, views, view_ids in shown:
            look = trainer.look(views.names)
            for view_id in view_ids:
                image = render_view(trainer.gaussians, views, view_id, look)
                pixels = strip(views.photos.image(view_id, look.background), image, views.mask(view_id)).cpu().numpy()
                encoded.append(pool.submit(save_image, pictures / f"{kind}-{view_id:03d}.jpg", titled(pixels)))
        from turbogs_plugin.report.curves import plot_against_seconds  # loads matplotlib

        seconds = [evaluation.train_seconds for evaluation in run.history]
        for name, label in (("psnr", "test PSNR in dB"), ("l1", "mean absolute error on test views (0 .. 1)")):
            values = [getattr(evaluation, name) for evaluation in run.history]
            plot_against_seconds(pictures / f"{name}.png", seconds, values, label, run.scene.name)
        for picture in encoded:
            picture.result()


def _page(run: RunSession, metrics: Metrics, lpips_reason: str, shown: int, doubts: dict[int, float]) -> str:
    """The text of the page: errors of the final model, why LPIPS is not among them, the number of test views with a
    picture, and photos that training doubted with times the median that their error is."""
    last, plan = run.history[-1], read_text(run.folder.plan) or "The run's folder holds no plan."
    config = run.trainer.config
    masked = run.test.masks is not None
    unmasked = ", without their masked pixels" if masked else ""
    on, (views, means) = explained(metrics), error_rows(metrics)
    if run.test.photos.transparent:
        red, green, blue = (round(255 * value) for value in run.trainer.background.evaluated)
        on.insert(0, f"Photos are transparent; they and the model are compared on rgb({red}, {green}, {blue}).")
    on += [f"LPIPS was not computed: {lpips_reason}."] if lpips_reason else []
    grey = "; masked pixels of photo and error are grey" if masked else ""
    heads = ("training in s", "wall in s", "Gaussians", "FPS", "peak memory in MiB")
    rows = []
    for of in run.history:
        errors = (number(value, digits) for value, digits in ((of.psnr, 2), (of.ssim, 4), (of.l1, 4)))
        rows.append([of.iteration, f"{of.train_seconds:.1f}", *errors, of.num_gaussians, of.memory_bytes // 2**20])
    seconds, *_, count, memory = rows[-1][1:]
    whole = number(run.wall.wall_seconds or float("nan"), 1, "not recorded")
    cost = table(heads, [[seconds, whole, count, f"{metrics.fps:.1f}", memory]])
    history = table(("iteration", "training in s", *ERRORS.values(), "Gaussians", "peak memory in MiB"), rows)
    strips = "\n\n".join(
        f"{escaped(view.name)}: {view.psnr:.2f} dB\n\n![{escaped(view.name)}](report/test-{view_id:03d}.jpg)"
        for view_id, view in enumerate(metrics.views[:shown])
    )
    doubted_photos = "".join(
        f"\n{escaped(run.trainer.views.names[view])}: {ratio:.1f} times the median error\n\n"
        f"![doubted](report/doubted-{view:03d}.jpg)\n"
        for view, ratio in doubts.items()
    )
    doubted_photos = doubted_photos and f"\n## Doubted photos\n{DOUBTED}\n{doubted_photos}"
    folder = shlex.quote(str(run.folder.path))
    return f"""# {escaped(run.scene.name)}

{last.iteration} iterations on {len(run.scene.train)} training views, seed {config.train.seed}.

{errors_table(means)}

{cost}

Errors are means over the test views{unmasked}. {" ".join(on)}

Training time is that of iterations and of the initial error maps; loading, evaluation, checkpoints and this report are
not in it. Wall time is from the start of the command until the model was written. FPS counts test views rendered one
after the other.

`turbogs export {folder} --format html` writes a page with the model to turn in a browser, `model.html`. The run's
configuration is in [config.yaml](config.yaml).

## Error against run time

![PSNR against seconds](report/psnr.png)
![mean absolute error against seconds](report/l1.png)

{history}

## Test views

From left to right: photo, render, error (mean absolute difference over RGB: black is 0, bright yellow is
{ERROR_FULL_SCALE} or more{grey}). {shown} of {len(metrics.views)} are shown.

{strips}

{errors_table(views)}
{doubted_photos}
## Plan

```text
{plan.rstrip().replace("`", "'")}
```

## Numerical events

Iterations with a non-finite loss: {last.nonfinite_losses}. Updates of a Gaussian left out because its gradient was not
finite: {last.skipped_updates}.

## Machine

{hardware(config.train.device)}, {platform.system()} {platform.machine()}.

{table(("software", "version"), software())}
"""
