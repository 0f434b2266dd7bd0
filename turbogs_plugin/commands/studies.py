"""`turbogs ablate`, `compare` and `report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from turbogs_plugin.commands.options import (
    Count,
    Decibels,
    Device,
    Studies,
    Time,
    budget_overrides,
    read_amount,
    require_positive,
)
from turbogs_plugin.errors import InputError


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
    merge: Studies = (),
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
        merge: put these studies together in --out and write the report, without training.
        within: begin no further cell after so much time: 9m. The same call then goes on; the exit code is 3.
        gpus: numbers of GPUs, a process each, which share the cells.
        device: where to train.
    """
    from turbogs_plugin.config.configuration import DEFAULT_CONFIG, require_one_length
    from turbogs_plugin.config.sections import parse_seconds
    from turbogs_plugin.study import commands
    from turbogs_plugin.study.sweep import SweepOptions

    require_positive("--psnr", psnr)
    ablations = [text for text in names if "=" not in text]
    budget = budget_overrides(None, time_budget)
    overrides = (*(text for text in names if "=" in text), *budget)
    if merge:
        if names or scene or only or seeds != (0,) or device != "auto" or {steps, time_budget, within, gpus} != {None}:
            raise InputError("--merge trains nothing: give it --out and --psnr alone")
        return commands.merge(merge, out, psnr)
    if not ablations or not scene:
        raise InputError("ablate needs NAME_OR_FILE and --scene SCENE, or --merge STUDY ...")
    if only and len(ablations) > 1:
        raise InputError("--only names variants of one ablation: give it one NAME_OR_FILE")
    if steps is not None:
        require_positive("--steps", (steps,))
    require_one_length(DEFAULT_CONFIG, overrides)
    limit = None if within is None else read_amount("--within", within, parse_seconds)
    options = SweepOptions(scene, seeds, overrides, steps, device, limit, numbers("--gpus", gpus))
    return commands.ablate(ablations, options, out, only, psnr)


def compare(
    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN RUN ...")], /, *, out: Path, psnr: Decibels = ()
) -> int:
    """Report any runs side by side; runs that were asked the same, but for the seed, count as one variant.

    Args:
        runs: folders of runs; the first one is what the others are compared with.
        out: new folder for the report.
        psnr: test PSNRs whose time is asked for; from the first run's result where absent.
    """
    from turbogs_plugin.study import commands

    if len(runs) < 2:
        raise InputError("compare needs RUN RUN ...: folders of two runs or more")
    require_positive("--psnr", psnr)
    return commands.compare(runs, out, psnr)


def report(studies: Positional[Studies], /, *, psnr: Decibels = ()) -> int:
    """Write the report of studies again, from their results.json. A plot whose data did not change is left as it is.

    Args:
        studies: folders of studies.
        psnr: test PSNRs whose time is asked for; those of the last report where absent.
    """
    from turbogs_plugin.study import commands

    if not studies:
        raise InputError("report needs STUDY ...: folders of studies")
    require_positive("--psnr", psnr)
    return commands.report(studies, psnr)


def numbers(option: str, text: str | None) -> tuple[int, ...]:
    """``0,1,2`` as numbers; none where the option is absent."""
    words = [] if text is None else text.split(",")
    if not all(word.strip().isdecimal() for word in words) or len({int(word) for word in words}) < len(words):
        raise InputError(f"{option} '{text}': write different numbers with commas between them: 0,1,2")
    return tuple(map(int, words))
