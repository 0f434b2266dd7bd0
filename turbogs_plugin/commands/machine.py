"""`turbogs bench` and `turbogs doctor`: how fast this machine is, and what it lacks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from turbogs_plugin.commands.options import Count, Device, Overrides, RunOptions, Scene, require_positive
from turbogs_plugin.errors import InputError


def bench(
    what: Annotated[
        Positional[Literal["step", "ranks", "raster", "numerics", "wall", "viewer"]],
        arg(metavar="step|ranks|raster|numerics|wall|viewer"),
    ],
    overrides: Overrides = (),
    /,
    *,
    scene: Scene = None,
    ply: Annotated[Path | None, arg(metavar="MODEL.ply")] = None,
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
        ply: step: a trained model in place of one that is trained here, so that several builds time the same.
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
    from turbogs_plugin.train.inputs import resolve_device

    times = repeats if repeats is not None else 3 if what in ("wall", "viewer") else 100
    counts = {"gaussians": gaussians, "views": views, "repeats": (times,), "size": size, "gpus": gpus}
    for name, values in counts.items():
        if not values or min(values) < 1:
            raise InputError(f"--{name} {' '.join(map(str, values))}: each must be at least 1")
    require_positive("--rates", rates, most=1.0)
    require_positive("--pixel-budget", (pixel_budget,))
    if training is not None and training < 0:
        raise InputError(f"--training {training}: it must be at least 0")
    if ply is not None and (what != "step" or scene is None or training is not None):
        raise InputError("--ply is for bench step with the --scene of the model: leave --training out")
    iterations = TRAINING_ITERATIONS if training is None else training
    where = resolve_device(device)
    if (what, device, where.type) == ("ranks", "auto", "cpu"):
        raise InputError("bench ranks: no GPU answers here; --device cpu measures processes on this CPU, for minutes")
    if what != "numerics":  # its --out is a folder
        commands.require_result_file(out)
    of_step_or_raster = library or photos or offload
    if what == "numerics":
        if out is None or overrides or scene is not None or library:
            raise InputError("bench numerics needs --out FOLDER, and takes --device besides")
        commands.run_numerics(where, out)
    elif what in ("wall", "viewer"):
        if scene is None or of_step_or_raster or training is not None:
            raise InputError(
                f"bench {what} needs --scene SCENE, and takes --repeats, --factor, --device and --out besides"
            )
        if what == "viewer":
            options = RunOptions(factor=factor, device=where.type)
            commands.run_viewer(options.settings(scene, overrides), times, where, out)
        else:
            arguments = [str(scene), *overrides, "--device", where.type, "--factor", str(factor)]
            commands.run_wall(arguments, times, where, out)
    elif what == "ranks":
        if scene is None or of_step_or_raster:
            raise InputError("bench ranks needs --scene SCENE; a library, synthetic photos and offload are not for it")
        step = StepBench(gaussians, views, pixel_budget, iterations, times, overrides)
        commands.run_ranks(RanksBench(gpus, grown, step), scene, factor, where, out)
    elif what == "step":
        step = StepBench(gaussians, views, pixel_budget, iterations, times, overrides, offload, photos, size, ply)
        commands.run_step(step, scene, factor, where, out)
    else:
        if overrides:
            raise InputError("bench raster times the rasterizer alone: it has no section.key=value")
        if training is not None and scene is None:
            raise InputError("--training needs --scene: without a capture, bench raster times synthetic models")
        raster = RasterBench(gaussians, views, rates, pixel_budget, size, times, iterations, library)
        commands.run_raster(raster, scene, factor, where, out)
    return 0


def doctor() -> int:
    """Print versions, devices and the state of the kernels, and what is missing."""
    from turbogs_plugin.doctor import diagnosis

    print(diagnosis())
    return 0
