"""What `turbogs ablate` and `turbogs compare` do."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from turbogs_plugin.ablation.compare import study_of_runs
from turbogs_plugin.ablation.grid import load_ablation
from turbogs_plugin.ablation.pages import write_study
from turbogs_plugin.ablation.results import StudyFolder, merge_studies
from turbogs_plugin.ablation.sweep import SweepOptions, run_sweep
from turbogs_plugin.errors import InputError


def ablate(name_or_file: str, options: SweepOptions, out: Path, only: Sequence[str], targets: Sequence[float]) -> int:
    """Train what is missing of a grid and write its report; the exit code.

    The report is also written where the call is interrupted, of what is there.
    """
    folder = StudyFolder(out)
    ablation = load_ablation(name_or_file).only(only)
    try:
        run_sweep(ablation, options, folder)
    finally:
        # Not after a refusal, which leaves no cells.
        if any(folder.cells.glob("*/*.json")):
            print(f"report  {write_study(out, folder.read_study(), targets)}")
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
