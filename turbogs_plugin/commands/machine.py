"""`turbogs bench` and `turbogs doctor`: how fast this machine is, and what it lacks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from turbogs_plugin.commands.options import Count, Overrides, require_positive
from turbogs_plugin.errors import InputError


def bench(
    what: Annotated[Positional[Literal["step", "raster", "wall"]], arg(metavar="step|raster|wall")],
    overrides: Overrides = (),
    /,
    *,
    scene: Annotated[Path, arg(metavar="SCENE")],
    ply: Annotated[Path | None, arg(metavar="MODEL.ply")] = None,
    gaussians: Annotated[tuple[int, ...], arg(metavar="M ...")] = (150_000, 600_000),
    views: Annotated[tuple[int, ...], arg(metavar="K ...")] = (10, 5, 3),
    repeats: Count = None,
    out: Annotated[Path | None, arg(metavar="FILE")] = None,
) -> int:
    """Time an iteration of training, the rasterizer, or the whole `turbogs train`.

    Step and raster need a model of the scene, too: turbogs train SCENE --out RUN writes RUN/model.ply.

    Args:
        what: step: an iteration, step by step beside what memory and arithmetic allow. raster: both passes, stage by
            stage beside gsplat's dense ones. wall: the command itself by the clock on the wall, part by part.
        overrides: changes of the configuration that is timed, e.g. scene.factor=2, train.device=cpu.
        scene: folder of the capture.
        ply: step, raster: the trained model to time, so that several builds time the same.
        gaussians: step, raster: sizes that the model is brought to.
        views: step, raster: views of an iteration or a pass.
        repeats: timed iterations or passes, 100 where absent; timed runs of wall, 3 where absent.
        out: JSON file for all numbers, with machine and commit.
    """
    from turbogs_plugin.bench import jobs
    from turbogs_plugin.bench.wall import bench_wall
    from turbogs_plugin.config.configuration import load_config
    from turbogs_plugin.train.inputs import resolve_device

    times = repeats if repeats is not None else 3 if what == "wall" else 100
    for name, values in {"gaussians": gaussians, "views": views, "repeats": (times,)}.items():
        require_positive(f"--{name}", *(values or (0,)))
    where = resolve_device(load_config(overrides=overrides).train.device)
    if out is not None:
        jobs.require_result_file(out)
    if what == "wall":
        if ply is not None:
            raise InputError("bench wall times whole trainings: leave --ply out")
        measured = bench_wall([str(scene), *overrides], times)
    elif ply is None:
        raise InputError(f"bench {what} needs --ply MODEL.ply: turbogs train {scene} --out RUN writes RUN/model.ply")
    else:
        measured = jobs.time_engine(what, scene, ply, gaussians, views, times, overrides, where)
    jobs.write(what, measured, where, out)
    return 0


def doctor() -> int:
    """Print versions, devices and the state of the kernels, and what is missing."""
    from turbogs_plugin.doctor import diagnosis

    print(diagnosis())
    return 0
