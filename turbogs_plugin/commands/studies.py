"""`turbogs ablate` and `turbogs report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from turbogs_plugin.commands.options import Count, Overrides, require_positive
from turbogs_plugin.errors import InputError


def ablate(
    name: Annotated[Positional[str], arg(metavar="NAME_OR_FILE")],
    overrides: Overrides = (),
    /,
    *,
    out: Path,
    scene: Annotated[UseAppendAction[tuple[Path, ...]], arg(metavar="SCENE")] = (),
    seeds: Annotated[tuple[int, ...], arg(metavar="N ...")] = (0,),
    steps: Count = None,
    only: Annotated[tuple[str, ...], arg(metavar="VARIANT ...")] = (),
    gpus: Count = None,
) -> int:
    """Train named variants over captures and seeds: error against run time. A call may be stopped at any moment; the
    same call goes on, and several calls may share the folder --out: no cell is trained twice.

    Args:
        name: packaged ablation (parts, components, tables, ...) or .yaml file.
        overrides: changes of every variant's configuration; train.device=cpu trains on the CPU.
        out: folder of the study; finished cells in it are kept.
        scene: folder of a capture; may be given several times.
        seeds: of each variant; three at least, or no difference can be called clear.
        steps: iterations of every cell; what counts iterations is scaled with them.
        only: these variants and the baseline.
        gpus: number of this machine's GPUs, each of which trains a cell at a time.
    """
    from turbogs_plugin.study.grid import load_ablation
    from turbogs_plugin.study.run_cells import CellChoice, run_study

    if not scene:
        raise InputError("ablate needs --scene SCENE: the folder of a capture")
    require_positive("--steps", steps)
    require_positive("--gpus", gpus)
    choice = CellChoice(scene, seeds, only, overrides, steps)
    failures = run_study(load_ablation(name), choice, out, gpus)
    for failure in failures:
        print(f"failed  {failure}")
    return 1 if failures else 0


def report(
    paths: Annotated[Positional[tuple[Path, ...]], arg(metavar="STUDY ... | RUN RUN ...")],
    /,
    *,
    out: Path | None = None,
) -> int:
    """Write the reports of studies again, from their results.json; or a report of runs side by side, where runs that
    were asked the same, but for the seed, count as one variant.

    Args:
        paths: folders of studies; or of two runs or more, the first of which the others are compared with.
        out: new folder for the report of runs.
    """
    from turbogs_plugin.study.results import StudyFolder
    from turbogs_plugin.study.runs import study_of_runs
    from turbogs_plugin.study.study_report import write_report

    if not paths:
        raise InputError("report needs STUDY ..., folders of studies, or RUN RUN ... --out NEW, folders of runs")
    if out is not None:
        if len(paths) < 2:
            raise InputError("report --out compares runs: give it the folders of two runs or more")
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise InputError(f"--out '{out}' is there and not empty: choose a new folder")
        StudyFolder(out).write_study(study_of_runs(paths))
    for folder in map(StudyFolder, paths if out is None else (out,)):
        if not folder.read_study().results:
            raise InputError(f"'{folder.path}' has no finished cells to report on: go on with turbogs ablate")
        print(f"report  {write_report(folder)}")
    return 0
