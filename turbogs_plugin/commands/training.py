"""`turbogs train`, `plan`, and `reconstruct` and `demo`, which write captures to train on."""

from __future__ import annotations

import gc
import shlex
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import FlagCreatePairsOff, Positional, arg

from turbogs_plugin.commands.options import NO_OPTIONS, PORT, Count, Flat, Overrides, Scene, address, require_positive
from turbogs_plugin.errors import InputError
from turbogs_plugin.train.wall import WallClock

if TYPE_CHECKING:
    from turbogs_plugin.train.session import RunSession

VIEWER_ON_ONE = "--viewer shows a training on one GPU: leave it out, or --gpus"


def train(
    scene: Positional[Scene] = None,
    overrides: Overrides = (),
    /,
    *,
    out: Annotated[Path | None, arg(metavar="RUN")] = None,
    resume: Annotated[Path | None, arg(metavar="RUN")] = None,
    report: bool = True,
    overwrite: FlagCreatePairsOff[bool] = False,
    viewer: Annotated[tuple[str, ...] | None, arg(metavar="[[HOST:]PORT]")] = None,
    gpus: Count = None,
    trust: FlagCreatePairsOff[bool] = False,
    options: Flat = NO_OPTIONS,
) -> int:
    """Train on a capture, or go on with a stopped run.

    Args:
        scene: folder of a capture: a COLMAP reconstruction, a transforms.json or NeRF-synthetic, with its photos; or
            of photos alone, whose cameras are found first (see reconstruct).
        overrides: changes of the configuration, e.g. train.iterations=8000 density.type=none; turbogs plan without a
            SCENE lists all settings.
        out: new folder for the run.
        overwrite: replace a run that --out holds. It lies in RUN.replaced until the new one is finished, and comes back
            if that fails before its first checkpoint.
        resume: folder of a stopped run to go on with, by its own configuration.
        report: at the end, write the report and its pictures; --no-report leaves model, history and checkpoints.
        viewer: show the training in a browser, at this port (or 8080); afterwards its model, until Ctrl-C.
            0.0.0.0:8080 lets others on the network look, and pause the training.
        gpus: number of this machine's GPUs that train one model, a process each; torchrun does the same on several
            machines. docs/scaling.md says what they gain.
        trust: with --resume, run the code that the run's configuration names and that is not installed.
    """
    clock = WallClock()
    if resume is not None:
        if scene or overrides or out or overwrite or options != NO_OPTIONS:
            raise InputError("--resume has its settings: give nothing else but --no-report, --viewer, --gpus, --trust")
    elif trust:
        raise InputError("--trust is for --resume: a configuration that you name yourself is your own word")
    if (target := resume or out) is None or (scene or resume) is None:
        raise InputError("train needs a SCENE and --out RUN, or --resume RUN")
    require_positive("--gpus", gpus)
    if viewer is not None and (gpus or 1) > 1:
        raise InputError(VIEWER_ON_ONE)
    host, port = address("--viewer", viewer or (str(PORT),))
    gc.disable()  # a sixth of the imports' time would go into looking through their objects, which stay
    from turbogs_plugin.distributed.processes import joined, launched, restarts, start
    from turbogs_plugin.report.run_report import write_report
    from turbogs_plugin.train import run

    gc.freeze()  # collections during training pass over them
    gc.enable()
    folder = run.RunFolder(target)
    settings = options.settings(scene, overrides) if resume is None else folder.read_config()
    if resume and viewer is None and folder.finished(report):
        print(f"{resume} is finished: its model is {folder.model}")
        return 0
    if overwrite and (launched() or (gpus or 1) > 1):
        raise InputError("--overwrite is for one process: remove the older run yourself, or leave out --gpus")
    if gpus is not None and gpus > 1 and not launched():
        if resume is None:
            folder.require_new()
        return start(gpus, sys.argv[1:], settings.train.device)
    clock.mark("interpreter and imports")
    page, watch = write_report if report else None, []
    with joined(settings.train.device) as ranks, ExitStack() as pages:
        live = None
        if viewer is not None:
            if ranks.count > 1:
                raise InputError(VIEWER_ON_ONE)  # started by torchrun
            from turbogs_plugin.viewer.live import LiveViewer
            from turbogs_plugin.viewer.server import Page

            live = LiveViewer(Page(host, port, training=True))
            pages.callback(live.page.close)
            watch.append(live.watch)
        if resume is None and not (restarts() and folder.config.is_file()):
            session = run.train(settings, target, page, clock, ranks, watch, overwrite)
        else:  # a configuration that this command has written itself is trusted
            session = run.resume(target, page, clock, ranks, watch, trust or resume is None)
        code = _tell(session, report) if ranks.first else 128 + session.signal if session.signal else 0
        if live is not None and session.signal is None:
            live.stay()
    return code


def plan(
    scene: Positional[Scene] = None, overrides: Overrides = (), /, *, gpus: Count = None, options: Flat = NO_OPTIONS
) -> int:
    """Print what a run on a capture would decide, and why, without training; without a SCENE, every setting.

    Args:
        scene: capture as in train; where absent, the settings of the configuration are printed, each with its value.
        overrides: changes as in train; train.exposure=auto leaves a setting to the plan, any other value forces it.
        gpus: number of GPUs that would train the model.
    """
    if scene is not None and "=" in str(scene) and not scene.exists():
        scene, overrides = None, (str(scene), *overrides)  # a change of the configuration, and no capture
    settings = options.settings(scene, overrides)
    if scene is None:
        from turbogs_plugin.config.configuration import settings_text

        print(settings_text(settings))
        return 0
    from turbogs_plugin.train.run import plan_run

    print(plan_run(settings, gpus or 1).text())
    return 0


def reconstruct(photos: Annotated[Positional[Path], arg(metavar="PHOTOS")], /, *, out: Path) -> int:
    """Find the cameras of photos alone, and write a capture to train on. The same call goes on where it stopped.

    Args:
        photos: folder of at least three photos of one scene.
        out: new folder for the capture, with images and sparse/0 (COLMAP).
    """
    from turbogs_plugin.reconstruct import reconstruct

    print(reconstruct(photos, out).text())
    return 0


def demo(path: Positional[Path], /) -> int:
    """Write a small synthetic capture to try things on: a textured scene as a COLMAP dataset.

    Args:
        path: new folder.
    """
    from turbogs_plugin.captures import write_demo_capture

    folder = write_demo_capture(path)
    print(f"capture  {folder}\nnext     turbogs train {shlex.quote(str(folder))} --out RUN --config demo")
    return 0


def _tell(session: RunSession, reported: bool) -> int:
    """Print how a training call ended, and give its exit code."""
    folder = session.folder
    if session.signal is not None:
        from turbogs_plugin.config.components import foreign_code

        trust = ["--trust"] if foreign_code(session.trainer.config.to_mapping()) else []
        path, aside = shlex.quote(str(folder.path)), shlex.quote(str(folder.aside))
        back = f"{older}: to have it back,  rm -r {path} && mv {aside} {path}" if (older := folder.older()) else ""
        print("stopped and saved: go on with  turbogs train --resume", " ".join([path, *trust]) + back, file=sys.stderr)
        return 128 + session.signal
    wall = session.wall.wall_seconds
    print(f"trained {session.wall.train_seconds:.1f} s" + ("" if wall is None else f", {wall:.1f} s on the wall"))
    if reported:
        print(f"report  {folder.report}\nrenders {folder.path / 'report'}")
    print(f"model   {folder.model}")
    return 0
