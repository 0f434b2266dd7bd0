"""What `turbogs ablate` and `turbogs compare` do."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from turbogs_plugin.errors import InputError
from turbogs_plugin.report.provenance import Provenance, provenance
from turbogs_plugin.study.compare import study_of_runs
from turbogs_plugin.study.grid import Ablation, alike_at, load_ablation
from turbogs_plugin.study.pages import write_study
from turbogs_plugin.study.results import StudyFolder, merge_studies
from turbogs_plugin.study.sweep import SweepOptions, run_sweep
from turbogs_plugin.train.run import resolve_device


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
    code = 0
    for number, (ablation, variants, folder) in enumerate(zip(ablations.values(), chosen, folders, strict=True)):
        code = max(code, _study(ablation, variants, options, here, folder, folders[:number], targets))
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


def _study(
    ablation: Ablation,
    variants: Sequence[str],
    options: SweepOptions,
    here: Provenance,
    folder: StudyFolder,
    siblings: Sequence[StudyFolder],
    targets: Sequence[float],
) -> int:
    try:
        run_sweep(ablation, variants, options, here, folder, siblings)
    finally:
        # Not after a refusal, which leaves no cells.
        if any(folder.cells.glob("*/*.json")):
            print(f"report  {write_study(folder.path, folder.read_study(), targets)}")
    failures = folder.read_study().failures
    for failure in failures:
        print(f"failed  {failure.key}: {failure.reason}")
    return 1 if failures else 0


def merge(sources: Sequence[Path], out: Path, targets: Sequence[float]) -> int:
    """Put studies together and write the report again, without training."""
    folder = StudyFolder(out)
    folder.require_usable()
    merge_studies([StudyFolder(source) for source in sources], folder)
    study = folder.read_study()
    if not study.results:
        raise InputError("there are no finished cells to report on")
    print(f"report  {write_study(out, study, targets)}")
    return 0


def compare(runs: Sequence[Path], out: Path, targets: Sequence[float]) -> int:
    """Write a report of any runs side by side into a new folder."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"--out '{out}' is there and not empty: choose a new folder")
    study = study_of_runs(runs)
    out.mkdir(parents=True, exist_ok=True)
    print(f"report  {write_study(out, study, targets)}")
    return 0
