"""`turbogs view`, `eval`, `render` and `export`: commands on a model, of a run or trained anywhere."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import FlagCreatePairsOff, arg

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
    """Look at a model in a browser, until Ctrl-C: the newest one of a run, or one trained anywhere.

    Args:
        run: folder of the run; or the file of a model, with --scene to see its photos, too.
        overrides: with --scene, as in eval.
        port: of the page.
        host: where it listens; 0.0.0.0 lets others on the network look.
        device: where to render.
    """
    from turbogs_plugin.viewer import show

    show.view(run, port, host, device, given.settings(overrides))
    return 0


def evaluate(run: RunOrModel, overrides: Overrides = (), /, *, device: Device = "auto", given: Given = NO_SCENE) -> int:
    """Measure a model on the test views: the newest one of a run, whose metrics.json is written, or one trained
    anywhere.

    Args:
        run: folder of the run; or with --scene the file of a model.
        overrides: with --scene, e.g. scene.test_every=10.
        device: where to render.
    """
    from turbogs_plugin.report.evaluation import evaluate_run

    print(evaluate_run(run, device, given.settings(overrides)))
    return 0


def render(
    run: RunOrModel,
    overrides: Overrides = (),
    /,
    *,
    split: Literal["test", "train"] = "test",
    depth: bool = False,
    out: Annotated[Path | None, arg(metavar="FOLDER|FILE")] = None,
    path: Annotated[str | None, arg(metavar="orbit|views|FILE")] = None,
    seconds: Annotated[float | None, arg(metavar="SECONDS")] = None,
    fps: Annotated[float | None, arg(metavar="N")] = None,
    size: Annotated[str | None, arg(metavar="WIDTHxHEIGHT")] = None,
    device: Device = "auto",
    given: Given = NO_SCENE,
) -> int:
    """Render a model from the capture's cameras, or a film: the newest one of a run, or one trained anywhere.

    Args:
        run: folder of the run; or with --scene the file of a model.
        overrides: with --scene, as in eval.
        split: which cameras.
        depth: also write depth images: .npy (float32, along the camera's axis, in the capture's own units; 0 where
            nothing was hit) and .png (near is bright).
        out: folder for the pictures; renders in the run's folder where absent. With --path the film's new file (.mp4).
        path: write a film along a path: orbit, about what the capture shows; views, through its
            training cameras; or a file of cameras: transforms.json's layout, nerfstudio's path, Inria's cameras.json.
        seconds: of the film; 10 where absent.
        fps: frames a second of the film; 60 where absent.
        size: of the film, e.g. 1920x1080; a photo's, or the file's, where absent.
        device: where to render.
    """
    from turbogs_plugin.export.renders import film_run, render_run

    settings = given.settings(overrides)
    if path is None:
        if (seconds, fps, size) != (None, None, None):
            raise InputError("--seconds, --fps and --size are of a film: give --path and --out FILE.mp4, too")
        folders = render_run(run, split, device, depth, settings, out)
        print("\n".join(f"{name:<8} {folder}" for name, folder in zip(("renders", "depths"), folders, strict=False)))
    else:
        if depth or split != "test":
            raise InputError(f"--path writes a film of colours: leave {'--depth' if depth else '--split'} out")
        if out is None:
            raise InputError("--path writes a film: name its new file by --out FILE.mp4")
        print(f"film   {film_run(run, path, out, device, settings, seconds, fps, size)}")
    return 0


def export(
    run: RunOrModel,
    overrides: Overrides = (),
    /,
    *,
    format: Annotated[str, arg(metavar="ply|pt|spz|spz2|splat|glb|usda|html")] = "ply",
    out: Path | None = None,
    max_gaussians: Count = None,
    cameras: FlagCreatePairsOff[bool] = False,
    given: Given = NO_SCENE,
) -> int:
    """Write a model for other programs: the newest one of a run, or one trained anywhere, in the capture's own
    coordinates; read it again, and say what was lost. Or write a capture with refined cameras for other trainers.

    Args:
        run: folder of the run; or with --scene the file of a model; or with --cameras the folder of a COLMAP capture.
        overrides: with --scene, as in eval.
        format: ply: as the original 3DGS writes it, which viewers read. pt: a checkpoint of gsplat's simple_trainer,
            which needs --no-normalize-world-space to take it. spz: smaller, with some loss; spz2: its older version;
            splat: one colour each. glb: glTF with KHR_gaussian_splatting. usda: OpenUSD's
            ParticleField3DGaussianSplat. html: a page with the model to turn in a browser, without a network.
        out: new file; export.ply, model.pt, ..., or model.html in the run's folder where absent.
        max_gaussians: largest number of Gaussians; those are kept that add most to the training views.
        cameras: give each photo of a capture a refined camera of its own, and write a capture to train on, with
            sparse/0 and links to the photos, into the new folder --out. Trainers must read the principal point of each
            camera: gsplat's does, LiteGS and 3DGS's own do not.
    """
    if cameras:
        from turbogs_plugin.export.refined_capture import write_refined

        if out is None or overrides or max_gaussians is not None or format != "ply" or given != NO_SCENE:
            raise InputError("--cameras writes a capture: it takes SCENE and --out FOLDER, and nothing else")
        print(write_refined(run, out))
        return 0
    from turbogs_plugin.export.model_export import export_run

    print(f"model  {export_run(run, format, out, max_gaussians, given.settings(overrides))}")
    return 0
