"""`turbogs view`, `eval`, `render` and `export`: what is done with a model, of a run or trained anywhere."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from turbogs_plugin.commands.options import LOCAL, NO_SCENE, PORT, Count, Device, Given, Overrides, RunOrModel
from turbogs_plugin.errors import InputError


def view(
    run: RunOrModel,
    overrides: Overrides = (),
    /,
    *,
    port: int = PORT,
    host: str = LOCAL,
    device: Device = "auto",
    given: Given = NO_SCENE,
) -> int:
    """Look at the newest model of a run, or a model trained anywhere, in a browser, until Ctrl-C.

    Args:
        run: folder of the run; or the file of a model, with --scene to see its photos, too.
        overrides: with --scene, as in eval.
        port: of the page.
        host: where it listens; 0.0.0.0 lets others on the network look.
        device: where to render.
    """
    from turbogs_plugin.viewer import commands

    return commands.view(run, port, host, device, given.settings(overrides))


def evaluate(run: RunOrModel, overrides: Overrides = (), /, *, device: Device = "auto", given: Given = NO_SCENE) -> int:
    """Measure the newest model of a run, or a model trained anywhere, on the test views.

    Args:
        run: folder of the run; or with --scene the file of a model.
        overrides: with --scene, e.g. scene.test_every=10.
        device: where to render.
    """
    from turbogs_plugin.report.outputs import evaluate_run

    print(evaluate_run(run, device, given.settings(overrides)))
    return 0


def render(
    run: RunOrModel,
    overrides: Overrides = (),
    /,
    *,
    split: Literal["test", "train"] = "test",
    depth: bool = False,
    out: Annotated[Path | None, arg(metavar="FOLDER")] = None,
    path: Annotated[str | None, arg(metavar="orbit|views|FILE")] = None,
    video: Annotated[Path | None, arg(metavar="FILE")] = None,
    seconds: Annotated[float | None, arg(metavar="SECONDS")] = None,
    device: Device = "auto",
    given: Given = NO_SCENE,
) -> int:
    """Render the newest model of a run, or a model trained anywhere, from the capture's cameras, as PNGs; or a film.

    Args:
        run: folder of the run; or with --scene the file of a model.
        overrides: with --scene, as in eval.
        split: which cameras.
        depth: also write depth images: .npy (float32, along the camera's axis, in the capture's own units; 0 where
            nothing was hit) and .png (near is bright).
        out: folder for the pictures; renders in the run's folder where absent.
        path: of a film: orbit, about what the capture shows, also where absent; views, through its training cameras;
            or a file of cameras in the layout of transforms.json.
        video: write a film of 60 frames a second to this new file (.mp4) in the place of pictures.
        seconds: of the film; 10 where absent.
        device: where to render.
    """
    if video is not None:
        from turbogs_plugin.export.commands import film_run

        if depth or out is not None or split != "test":
            raise InputError("--video writes a film: it takes --path and --seconds, not --split, --depth or --out")
        length = 10.0 if seconds is None else seconds
        print(f"film   {film_run(run, path or 'orbit', video, length, device, given.settings(overrides))}")
        return 0
    if path is not None or seconds is not None:
        raise InputError("--path and --seconds are those of a film: give --video FILE, too")

    from turbogs_plugin.report.outputs import render_run

    folders = render_run(run, split, device, depth, given.settings(overrides), out)
    for name, folder in zip(("renders", "depths"), folders, strict=False):
        print(f"{name:<8} {folder}")
    return 0


def export(
    run: RunOrModel,
    overrides: Overrides = (),
    /,
    *,
    format: Annotated[str, arg(metavar="ply|pt|compressed-ply|splat|spz|html")] = "ply",
    out: Path | None = None,
    drop_bands: Annotated[float | None, arg(metavar="SHARE")] = None,
    max_gaussians: Count = None,
    given: Given = NO_SCENE,
) -> int:
    """Write the newest model of a run, or a model trained anywhere, for other programs, in the capture's own
    coordinates; read it again, and say what was lost. Or write all of a run on one page.

    Args:
        run: folder of the run; or with --scene the file of a model.
        overrides: with --scene, as in eval.
        format: ply: as the original 3DGS writes it, which viewers read. pt: a checkpoint of gsplat's simple_trainer,
            which needs --no-normalize-world-space to take it. compressed-ply, splat, spz: smaller, with some loss.
            html: curves, tables, test views and the model in a viewer, in one file below 32 MB.
        out: new file; model.ply, model.pt, ..., or report.html in the run's folder where absent.
        drop_bands: leave out the highest bands of spherical harmonics, as many as together have at most this share of
            the colours' energy, e.g. 1e-4.
        max_gaussians: at most so many, those that add most to the training views.
    """
    from turbogs_plugin.export.commands import export_run

    print(f"model  {export_run(run, format, out, drop_bands, max_gaussians, given.settings(overrides)).text()}")
    return 0
