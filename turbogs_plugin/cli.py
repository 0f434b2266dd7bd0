"""The command line: verbs only. What a verb does is in the module that it calls, imported when it is called."""

from __future__ import annotations

import atexit
import gc
import itertools
import math
import re
import sys
import warnings
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from tyro.conf import Positional, UseAppendAction, arg

from turbogs_plugin.errors import InputError, exit_code
from turbogs_plugin.train.wall import WallClock, process_age

if TYPE_CHECKING:
    from turbogs_plugin.config.configuration import Config
    from turbogs_plugin.train.run import RunSession

app = tyro.extras.SubcommandApp()

OVERRIDE = re.compile(r"\w+(\.\w+)+=.*", re.DOTALL)

FLAGS = ("--report", "--no-report", "--offload", "--no-offload")
"""Options without a value, of verbs that have overrides."""

LOCAL, PORT = "127.0.0.1", 8080
"""Where a viewer listens unless told otherwise: for this machine alone."""

Device = Literal["auto", "cpu", "cuda"]

# Options that several verbs have.
Overrides = Annotated[Positional[tuple[str, ...]], arg(metavar="[section.key=value ...]")]
Count = Annotated[int | None, arg(metavar="N")]
Time = Annotated[str | None, arg(metavar="20s")]
Decibels = Annotated[tuple[float, ...], arg(metavar="DB ...")]


@dataclass(frozen=True)
class RunOptions:
    """What train and plan change in a configuration.

    Args:
        config: name of a packaged configuration or a .yaml file; turbogs where absent.
        factor: scale photos down by this.
        device: where to train; auto takes a GPU where there is one.
        max_gaussians: never more than this (density.max_gaussians).
        max_memory: of the GPU, never more than this for tensors: 2GiB, 1500MB (budget.max_memory). Photos and error
            maps move to the host if need be, then the number of Gaussians is limited.
        time_budget: seconds of training to end after: 20s, 2m (budget.time). The schedule is fitted to it, and
            the pixels of an iteration or the number of Gaussians.
        init: what to start from (train.init): points of the capture, random points, or a model trained anywhere: a
            .ply, gsplat's .pt, a checkpoint, or a run's folder.
    """

    config: Annotated[str | None, arg(metavar="NAME_OR_FILE")] = None
    factor: Count = None
    device: Annotated[Device | None, arg(metavar="auto|cpu|cuda")] = None
    max_gaussians: Count = None
    max_memory: Annotated[str | None, arg(metavar="2GiB")] = None
    time_budget: Time = None
    init: Annotated[str | None, arg(metavar="points|random|MODEL")] = None

    def settings(self, scene: Path, overrides: tuple[str, ...]) -> Config:
        """The configuration that a command line asks for."""
        from turbogs_plugin.config.configuration import DEFAULT_CONFIG, load_config
        from turbogs_plugin.plan.caps import with_cap

        budget = _budget(self.max_memory, self.time_budget)
        if self.max_gaussians is not None and self.max_gaussians < 1:
            raise InputError(f"--max-gaussians {self.max_gaussians}: it must be at least 1; leave it out for no limit")
        if any(override.partition("=")[0].strip() == "scene.path" for override in overrides):
            raise InputError(f"scene.path is '{scene}', as SCENE says: leave the override out")
        settings = load_config(DEFAULT_CONFIG if self.config is None else self.config, (*overrides, *budget))
        if self.max_gaussians is not None:
            settings = with_cap(settings, self.max_gaussians)
        settings.scene.path = str(scene)
        if self.factor is not None:
            settings.scene.factor = self.factor
        if self.device is not None:
            settings.train.device = self.device
        if self.init is not None:
            if not self.init.strip():
                raise InputError("--init '': write points, random, or a model's file; leave it out for points")
            settings.train.init = self.init
        return settings


NO_OPTIONS = RunOptions()
Flat = Annotated[RunOptions, arg(name="")]


@dataclass(frozen=True)
class GivenOptions:
    """What eval, render and export need where they are given a model in the place of a run.

    Args:
        scene: the capture of a model from a file: a 3DGS .ply, gsplat's .pt, or a checkpoint. Not with a run.
        factor: scale its photos down by this.
    """

    scene: Annotated[Path | None, arg(metavar="SCENE")] = None
    factor: Count = None

    def settings(self, overrides: tuple[str, ...]) -> Config | None:
        """The capture and how to render it; None for a run, which says that itself."""
        if self.scene is None:
            if overrides or self.factor is not None:
                raise InputError("a run goes by its own configuration: --factor and overrides need --scene SCENE")
            return None
        return RunOptions(factor=self.factor).settings(self.scene, overrides).without_plan()


NO_SCENE = GivenOptions()
Given = Annotated[GivenOptions, arg(name="")]
RunOrModel = Annotated[Positional[Path], arg(metavar="RUN|MODEL")]


@app.command
def train(
    scene: Annotated[Positional[Path | None], arg(metavar="SCENE")] = None,
    overrides: Overrides = (),
    /,
    *,
    out: Annotated[Path | None, arg(metavar="RUN")] = None,
    resume: Annotated[Path | None, arg(metavar="RUN")] = None,
    report: bool = True,
    viewer: Annotated[int | None, arg(metavar="[PORT]")] = None,
    viewer_host: str = LOCAL,
    gpus: Count = None,
    options: Flat = NO_OPTIONS,
) -> int:
    """Train on a capture, or go on with a stopped run.

    Args:
        scene: folder of a capture: a COLMAP reconstruction, a transforms.json, NeRF-synthetic or LLFF, with its photos;
            or of photos alone, whose cameras are found first (see reconstruct).
        overrides: changes of the configuration, e.g. train.iterations=8000 density.type=none.
        out: new folder for the run.
        resume: folder of a stopped run to go on with, by its own configuration.
        report: at the end, write the report and its pictures; --no-report leaves model, history and checkpoints.
        viewer: show the training in a browser, at this port (8080 where none is named); afterwards its model, until
            Ctrl-C.
        viewer_host: where the viewer listens; 0.0.0.0 lets others on the network look, and pause the training.
        gpus: of this machine, to train one model on all of them, a process each; torchrun does the same on several
            machines. docs/scaling.md says what they gain.
    """
    clock = WallClock(process_age())
    if viewer is None and viewer_host != LOCAL:
        raise InputError("--viewer-host says where a viewer listens: give --viewer, too")
    if resume is not None:
        if scene or overrides or out or options != NO_OPTIONS:
            raise InputError(
                "--resume goes on by the run's own configuration: give it nothing else but --no-report, --viewer and "
                "--gpus"
            )
    elif scene is None or out is None:
        raise InputError("train needs a SCENE and --out RUN, or --resume RUN")
    if gpus is not None:
        _require_positive("--gpus", (gpus,))
    from turbogs_plugin.distributed.processes import joined, launched, restarted, start
    from turbogs_plugin.report.pages import write_report
    from turbogs_plugin.train import run

    settings = run.RunFolder(resume).read_config() if resume else options.settings(scene, overrides)
    device = settings.train.device
    if gpus is not None and gpus > 1 and not launched():
        return start(gpus, sys.argv[1:], device)
    page = write_report if report else None
    with joined(device) as ranks, ExitStack() as pages:
        if resume is None and restarted() and run.RunFolder(out).config.is_file():
            resume = out
        live = None
        if viewer is not None:
            if ranks.count > 1:
                raise InputError("--viewer shows a training on one GPU: leave it out, or --gpus")
            from turbogs_plugin.viewer.commands import attached

            live = pages.enter_context(attached(viewer, viewer_host))
        begin = partial(run.resume, resume) if resume else partial(run.train, settings, out)
        session = begin(page, clock, ranks, live and live.watch)
        code = _tell(session, report) if ranks.first else 128 + session.signal if session.signal else 0
        if live is not None and session.signal is None:
            live.stay()
    return code


@app.command
def reconstruct(photos: Annotated[Positional[Path], arg(metavar="PHOTOS")], /, *, out: Path) -> int:
    """Find the cameras of photos alone, and write a capture to train on. The same call goes on where it stopped.

    Args:
        photos: folder of at least three photos of one scene.
        out: new folder for the capture, with images and sparse/0 (COLMAP).
    """
    from turbogs_plugin.reconstruct import reconstruct

    print(reconstruct(photos, out).text())
    return 0


@app.command
def plan(
    scene: Annotated[Positional[Path], arg(metavar="SCENE")],
    overrides: Overrides = (),
    /,
    *,
    options: Flat = NO_OPTIONS,
) -> int:
    """Print what a run on a capture would decide of the settings that are `auto`, and why, without training.

    Args:
        scene: as in train.
        overrides: as in train; train.sh_degree=auto leaves a setting to the plan, any other value forces it.
    """
    from turbogs_plugin.train.run import plan_run

    print(plan_run(options.settings(scene, overrides)).text())
    return 0


@app.command
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


@app.command(name="eval")
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


@app.command
def render(
    run: RunOrModel,
    overrides: Overrides = (),
    /,
    *,
    split: Literal["test", "train"] = "test",
    depth: bool = False,
    out: Annotated[Path | None, arg(metavar="FOLDER")] = None,
    path: Annotated[str, arg(metavar="orbit|views|FILE")] = "orbit",
    video: Annotated[Path | None, arg(metavar="FILE")] = None,
    seconds: Annotated[float, arg(metavar="SECONDS")] = 10.0,
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
        path: of a film: orbit, about what the capture shows; views, through its training cameras; or a file of cameras
            in the layout of transforms.json.
        video: write a film of 60 frames a second to this new file (.mp4) in the place of pictures.
        seconds: of the film.
        device: where to render.
    """
    if video is not None:
        from turbogs_plugin.export.commands import film_run

        if depth or out is not None or split != "test":
            raise InputError("--video writes a film: it takes --path and --seconds, not --split, --depth or --out")
        print(f"film   {film_run(run, path, video, seconds, device, given.settings(overrides))}")
        return 0
    if (path, seconds) != ("orbit", 10.0):
        raise InputError("--path and --seconds are those of a film: give --video FILE, too")

    from turbogs_plugin.report.outputs import render_run

    folders = render_run(run, split, device, depth, given.settings(overrides), out)
    for name, folder in zip(("renders", "depths"), folders, strict=False):
        print(f"{name:<8} {folder}")
    return 0


@app.command
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

    print(f"model  {export_run(run, format, out, drop_bands, max_gaussians, given.settings(overrides))}")
    return 0


@app.command
def ablate(
    names: Annotated[Positional[tuple[str, ...]], arg(metavar="NAME_OR_FILE ... [section.key=value ...]")] = (),
    /,
    *,
    out: Path,
    scene: Annotated[UseAppendAction[tuple[Path, ...]], arg(metavar="SCENE")] = (),
    seeds: Annotated[tuple[int, ...], arg(metavar="N ...")] = (0,),
    steps: Count = None,
    time_budget: Time = None,
    only: Annotated[tuple[str, ...], arg(metavar="VARIANT ...")] = (),
    psnr: Decibels = (),
    reuse: Annotated[tuple[Path, ...], arg(metavar="STUDY ...")] = (),
    merge: Annotated[tuple[Path, ...], arg(metavar="STUDY ...")] = (),
    within: Time = None,
    gpus: Annotated[str | None, arg(metavar="0,1,...")] = None,
    device: Device = "auto",
) -> int:
    """Train named variants over scenes and seeds: error against run time. The same call goes on where it stopped, and
    may be made on several machines that share the folder --out: no cell is trained twice.

    Args:
        names: packaged ablations (parts, components, views, ...) or .yaml files; then changes of every
            variant's configuration.
        out: folder of the study, or of one for each of several ablations; finished cells in it are kept.
        scene: folder of a capture; may be given several times.
        seeds: of each variant; two at least, or nothing can be called different.
        steps: iterations of every cell; what counts iterations is scaled with them.
        time_budget: of every cell, as in train.
        only: these variants and the baseline.
        psnr: test PSNRs whose time is asked for; from the baseline's result where absent.
        reuse: take cells of the same settings from these studies where machine and sources are the same.
        merge: put these studies together in --out and write the report, without training.
        within: begin no further cell after so much time: 9m. The same call then goes on; the exit code is 3.
        gpus: numbers of GPUs, a process each, which share the cells.
        device: where to train.
    """
    from turbogs_plugin.config.units import parse_seconds
    from turbogs_plugin.study import commands
    from turbogs_plugin.study.sweep import SweepOptions

    _require_positive("--psnr", psnr)
    ablations = [text for text in names if "=" not in text]
    budget = _budget(None, time_budget)
    overrides = (*(text for text in names if "=" in text), *budget)
    if merge:
        if names or scene or only or budget:
            raise InputError("--merge trains nothing: give it --out and --psnr alone")
        return commands.merge(merge, out, psnr)
    if not ablations or not scene:
        raise InputError("ablate needs NAME_OR_FILE and --scene SCENE, or --merge STUDY ...")
    if only and len(ablations) > 1:
        raise InputError("--only names variants of one ablation: give it one NAME_OR_FILE")
    limit = None if within is None else parse_seconds(within)
    options = SweepOptions(scene, seeds, overrides, steps, device, reuse, limit, _numbers("--gpus", gpus))
    return commands.ablate(ablations, options, out, only, psnr)


@app.command
def compare(
    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN RUN ...")],
    /,
    *,
    out: Path,
    psnr: Decibels = (),
) -> int:
    """Report any runs side by side; runs that were asked the same, but for the seed, count as one variant.

    Args:
        runs: folders of runs; the first one is what the others are compared with.
        out: new folder for the report.
        psnr: test PSNRs whose time is asked for; from the first run's result where absent.
    """
    from turbogs_plugin.study import commands

    if not runs:
        raise InputError("compare needs RUN RUN ...: folders of runs")
    _require_positive("--psnr", psnr)
    return commands.compare(runs, out, psnr)


@app.command
def report(
    studies: Annotated[Positional[tuple[Path, ...]], arg(metavar="STUDY ...")],
    /,
    *,
    psnr: Decibels = (),
) -> int:
    """Write the report of studies again, from their results.json. A plot whose data did not change is left as it is.

    Args:
        studies: folders of studies.
        psnr: test PSNRs whose time is asked for; those of the last report where absent.
    """
    from turbogs_plugin.study import commands

    if not studies:
        raise InputError("report needs STUDY ...: folders of studies")
    _require_positive("--psnr", psnr)
    return commands.report(studies, psnr)


@app.command
def bench(
    what: Annotated[
        Positional[Literal["step", "ranks", "raster", "numerics", "wall", "viewer"]],
        arg(metavar="step|ranks|raster|numerics|wall|viewer"),
    ],
    overrides: Overrides = (),
    /,
    *,
    scene: Annotated[Path | None, arg(metavar="SCENE")] = None,
    ply: Annotated[tuple[Path, ...], arg(metavar="FILE ...")] = (),
    gaussians: Annotated[tuple[int, ...], arg(metavar="M ...")] = (150_000, 600_000),
    views: Annotated[tuple[int, ...], arg(metavar="K ...")] = (10, 5, 3),
    pixel_budget: Annotated[float, arg(metavar="LAMBDA")] = 1.0,
    training: Count = None,
    repeats: Count = None,
    rates: Annotated[tuple[float, ...], arg(metavar="R ...")] = (1.0, 0.1),
    size: Annotated[tuple[int, int], arg(metavar="WIDTH HEIGHT")] = (841, 1500),
    photos: Annotated[int, arg(metavar="N")] = 0,
    offload: bool = False,
    library: Annotated[tuple[Path, ...], arg(metavar="FILE ...")] = (),
    gpus: Annotated[tuple[int, ...], arg(metavar="N ...")] = (1, 2),
    grown: bool = False,
    factor: Annotated[int, arg(metavar="N")] = 1,
    device: Device = "auto",
    out: Annotated[Path | None, arg(metavar="FILE_OR_FOLDER")] = None,
) -> int:
    """Time an iteration of training step by step or on several GPUs, the rasterizer stage by stage, beside what the
    machine allows, or the command `turbogs train` by the clock on the wall, or a training with and without a viewer; or
    measure how exact and how fast the optimizer's solvers are on stiff systems.

    Args:
        what: step: from sampling to update; ranks: an iteration on several GPUs, of a --scene; raster: forward and
            backward, beside gsplat's dense ones; numerics: the solvers of moment-damped LM, which takes --out and
            --device alone; wall: whole runs, which takes --scene, --repeats, --factor, --device, --out and changes of
            the configuration; viewer: as wall, iterations a second without a viewer, with one that nobody looks at, and
            with a client that moves.
        overrides: step, ranks, wall, viewer: changes of the configuration that is timed.
        scene: a capture, for its cameras and photos; where absent, all is synthetic, the models of raster as well.
        ply: a trained model in place of those trained here; raster: one or more, timed at their own sizes.
        gaussians: sizes of the model.
        views: views of an iteration.
        pixel_budget: pixels of an iteration in images (lambda).
        training: iterations of the model's training before; 1500 where absent, 0 for the initial model.
        repeats: iterations or passes timed; 100 where absent. wall, viewer: runs; 3 where absent.
        rates: raster: further sampling rates, with the fewest views.
        size: of synthetic images, where there is no scene.
        photos: step: number of synthetic photos, in place of a scene.
        offload: step: with photos and error maps in host memory, too.
        library: raster: other builds of the kernels, measured the same way.
        gpus: ranks: numbers of GPUs.
        grown: ranks: also with views and pixels times the number of GPUs.
        factor: scale photos down by this.
        device: what to time.
        out: JSON file; standard output where absent, but for wall and viewer. numerics: folder for its table, plot and
            JSON.
    """
    from turbogs_plugin.bench import commands
    from turbogs_plugin.bench.models import TRAINING_ITERATIONS
    from turbogs_plugin.bench.ranks import RanksBench
    from turbogs_plugin.bench.raster import RasterBench
    from turbogs_plugin.bench.step import StepBench
    from turbogs_plugin.train.run import resolve_device

    times = repeats if repeats is not None else 3 if what in ("wall", "viewer") else 100
    counts = {"gaussians": gaussians, "views": views, "repeats": (times,), "size": size, "gpus": gpus}
    for name, values in counts.items():
        if not values or min(values) < 1:
            raise InputError(f"--{name} {' '.join(map(str, values))}: each must be at least 1")
    _require_positive("--rates", rates, most=1.0)
    _require_positive("--pixel-budget", (pixel_budget,))
    if training is not None and training < 0:
        raise InputError(f"--training {training}: it must be at least 0")
    if training is not None and ply:
        raise InputError("--ply names a trained model: leave --training out")
    iterations = TRAINING_ITERATIONS if training is None else training
    where = resolve_device(device)
    if what == "numerics":
        if out is None or overrides or scene is not None or ply or library:
            raise InputError("bench numerics needs --out FOLDER, and takes --device besides")
        return commands.run_numerics(where, out)
    if what in ("wall", "viewer"):
        if scene is None or ply or library or photos or offload or training is not None:
            raise InputError(
                f"bench {what} needs --scene SCENE, and takes --repeats, --factor, --device and --out besides"
            )
        if what == "viewer":
            options = RunOptions(factor=factor, device=where.type)
            return commands.run_viewer(options.settings(scene, overrides), times, where, out)
        arguments = [str(scene), *overrides, "--device", where.type, "--factor", str(factor)]
        return commands.run_wall(arguments, times, where, out)
    if what == "ranks":
        if scene is None or ply or library or photos or offload:
            raise InputError("bench ranks needs --scene SCENE; a model, synthetic photos and offload are not for it")
        ranks = RanksBench(gpus, gaussians, views, pixel_budget, grown, iterations, times, overrides)
        return commands.run_ranks(ranks, scene, factor, where, out)
    if what == "step":
        if len(ply) > 1:
            raise InputError("bench step takes one --ply, at the sizes of --gaussians")
        model = ply[0] if ply else None
        step = StepBench(gaussians, views, pixel_budget, iterations, times, overrides, model, offload, photos, size)
        return commands.run_step(step, scene, factor, where, out)
    if overrides:
        raise InputError("bench raster times the rasterizer alone: it has no section.key=value")
    if training is not None and scene is None:
        raise InputError("--training needs --scene: without a capture, bench raster times synthetic models")
    raster = RasterBench(gaussians, views, rates, pixel_budget, size, times, iterations, ply, library)
    return commands.run_raster(raster, scene, factor, where, out)


@app.command
def demo(path: Positional[Path], /, horizon: bool = False) -> int:
    """Write a small synthetic capture to try things on: a textured scene as a COLMAP dataset.

    Args:
        path: new folder.
        horizon: a scene outdoors, seen as far as the sky.
    """
    from turbogs_plugin.scene import write_demo_capture

    print(f"capture  {write_demo_capture(path, horizon=horizon)}")
    return 0


@app.command
def doctor() -> int:
    """Print versions, devices and the state of the kernels, and what is missing."""
    from turbogs_plugin.doctor import diagnosis

    print(diagnosis())
    return 0


def _budget(max_memory: str | None, time_budget: str | None) -> tuple[str, ...]:
    """The options of a budget as overrides."""
    for option, amount in (("--max-memory", max_memory), ("--time-budget", time_budget)):
        if amount == "":
            raise InputError(f"{option} '': write an amount; leave it out for no limit")
    given = {"max_memory": max_memory, "time": time_budget}
    return tuple(f"budget.{name}={value!r}" for name, value in given.items() if value is not None)


def _numbers(option: str, text: str | None) -> tuple[int, ...]:
    """``0,1,2`` as numbers; none where the option is absent."""
    words = [] if text is None else text.split(",")
    if not all(word.strip().isdecimal() for word in words) or len({int(word) for word in words}) < len(words):
        raise InputError(f"{option} '{text}': write different numbers with commas between them: 0,1,2")
    return tuple(map(int, words))


def _require_positive(option: str, values: Sequence[float], most: float = math.inf) -> None:
    if not all(0 < value <= most and math.isfinite(value) for value in values):
        limit = f"at most {most:g}" if math.isfinite(most) else "finite"
        raise InputError(f"{option} {' '.join(map(str, values))}: it must be more than 0 and {limit}")


def _tell(session: RunSession, reported: bool) -> int:
    """Print how a training call ended; its exit code."""
    from turbogs_plugin.report.tables import history_table

    folder = session.folder
    if session.signal is not None:
        print(f"stopped and saved: go on with  turbogs train --resume {folder.path}", file=sys.stderr)
        return 128 + session.signal
    print(history_table(session.history))
    print(f"\n{session.wall.text()}")
    if reported:
        print(f"report  {folder.report}\nrenders {folder.path / 'report'}")
    print(f"model   {folder.model}")
    return 0


def _gathered(arguments: list[str]) -> list[str]:
    """Arguments with later overrides brought before the first option, where a word besides the verb stands there.

    What follows an option is its value, whatever it looks like, unless the option is one of `FLAGS`.
    """
    first = next((place for place, text in enumerate(arguments) if text.startswith("-")), 0)
    if first < 2:
        return arguments
    overrides, rest = [], arguments[first : first + 1]
    for before, text in itertools.pairwise(arguments[first:]):
        value = before.startswith("-") and before not in FLAGS
        (overrides if OVERRIDE.fullmatch(text) and not value else rest).append(text)
    return [*arguments[:first], *overrides, *rest]


def _with_port(arguments: list[str]) -> list[str]:
    """Arguments in which --viewer without a port has the usual one."""
    filled = []
    for text, following in itertools.zip_longest(arguments, arguments[1:], fillvalue=""):
        filled.append(text)
        if text == "--viewer" and not following.isdecimal():
            filled.append(str(PORT))
    return filled


def _warning_line(message: Warning | str, *place: object) -> str:
    """A warning on one line, without the place in the source."""
    return f"turbogs: warning: {' '.join(str(message).split())}\n"


def main() -> None:
    """The `turbogs` command."""
    atexit.register(gc.freeze)  # or the collector walks through all of torch at the end, for a second
    description = "TurboGS: train 3D Gaussian Splatting on few, well chosen pixels."
    warnings.formatwarning = _warning_line
    arguments = _gathered(_with_port(sys.argv[1:]))
    sys.exit(exit_code(lambda: app.cli(prog="turbogs", description=description, args=arguments)))


if __name__ == "__main__":
    main()
