"""What `turbogs ablate`, `turbogs compare` and `turbogs report` do."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path

from turbogs_plugin.errors import InputError
from turbogs_plugin.report.provenance import provenance
from turbogs_plugin.study.compare import study_of_runs
from turbogs_plugin.study.folder import StudyFolder, merged
from turbogs_plugin.study.grid import Ablation, alike_at, load_ablation
from turbogs_plugin.study.pages import write_report
from turbogs_plugin.study.sweep import SweepOptions, run_sweep
from turbogs_plugin.study.workers import UNFINISHED, run_on_gpus
from turbogs_plugin.train.inputs import resolve_device


def ablate(
    names: Sequence[str], options: SweepOptions, out: Path, only: Sequence[str], targets: Sequence[float]
) -> int:
    """Train what is missing of one or more grids and write their reports; the exit code.

    Args:
        names: packaged ablations or YAML files. The study of one is `out` itself; of several, each has a folder in it.

    A report is also written where the call is interrupted, of what is there.
    """
    ablations = {Path(name).stem: load_ablation(name) for name in names}
    if len(ablations) < len(names):
        raise InputError(f"ablations of one name would share a folder: {', '.join(names)}")
    folders = [StudyFolder(out if len(names) == 1 else out / name) for name in ablations]
    here = provenance(resolve_device(options.device).type)
    chosen = [_variants(ablation, only, options) for ablation in ablations.values()]
    code, begun = 0, time.monotonic()
    for number, (ablation, variants, folder) in enumerate(zip(ablations.values(), chosen, folders, strict=True)):
        try:
            sweep = (ablation, variants, options, here, folder, folders[:number], begun)
            left = run_sweep(*sweep) if len(options.gpus) < 1 else run_on_gpus(options, sweep)
        finally:
            if folder.file.is_file() and folder.read_study().results:  # after a refusal there may be none
                _report(folder, targets)
        for failure in folder.read_study().failures:
            print(f"failed  {failure.key}: {failure.reason}")
            code = 1
        if left:
            print(f"stopped after --within, with {left} cells left in {folder.path}: the same call goes on")
            return UNFINISHED
    return code


def _variants(ablation: Ablation, only: Sequence[str], options: SweepOptions) -> list[str]:
    """The variants to train. What `--steps` makes a copy of another one is left out, and said."""
    variants = ablation.only(only)
    if options.steps is None:
        return variants
    alike = alike_at(ablation, variants, options.overrides, options.steps)
    if alike:
        named = ", ".join(f"{variant} (as {known})" for variant, known in alike.items())
        print(f"left out, for with --steps {options.steps} nothing tells them apart: {named}", file=sys.stderr)
    return [variant for variant in variants if variant not in alike]


def merge(sources: Sequence[Path], out: Path, targets: Sequence[float]) -> int:
    """Put studies together and write the report, without training. What `out` holds of a study stays in it."""
    folder = StudyFolder(out)
    folder.require_usable()
    paths = [*sources, out] if folder.file.is_file() else sources
    study = merged([StudyFolder(path) for path in paths])
    if not study.results:
        raise InputError("there are no finished cells to report on")
    folder.write_study(study)
    _report(folder, targets)
    return 0


def compare(runs: Sequence[Path], out: Path, targets: Sequence[float]) -> int:
    """Write a report of any runs side by side into a new folder."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"--out '{out}' is there and not empty: choose a new folder")
    folder = StudyFolder(out)
    folder.write_study(study_of_runs(runs))
    _report(folder, targets)
    return 0


def report(studies: Sequence[Path], targets: Sequence[float]) -> int:
    """Write the reports of studies again, from what is in their folders."""
    for path in studies:
        folder = StudyFolder(path)
        if not folder.read_study().results:
            raise InputError(f"'{path}' has no finished cells to report on")
        _report(folder, targets or None)
    return 0


def _report(folder: StudyFolder, targets: Sequence[float] | None) -> None:
    print(f"report  {write_report(folder, targets)}")
