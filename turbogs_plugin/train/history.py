"""``history.jsonl``, the record of error against run time: one line per evaluation."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from turbogs_plugin.errors import InputError
from turbogs_plugin.files import read_text, write_text_atomically

OPTIONAL = ("whole_", "aligned_")
"""Prefixes of measures that only some captures have."""


@dataclass
class Evaluation:
    """One evaluation.

    Args:
        iteration: finished iterations.
        train_seconds: training time until then, without loading, evaluation, checkpoints and report.
        psnr, ssim, l1: means over the test views; `ssim` is NaN if the images are too small for it.
        num_gaussians: N.
        memory_bytes: peak of the GPU's tensors, or of the process on a CPU.
        nonfinite_losses: iterations so far whose loss was not finite.
        skipped_updates: updates of Gaussians skipped so far because their gradient was not finite.
        worst_psnr: PSNR of the worst test view; NaN in old files, which lack it.
        whole_psnr, whole_ssim, whole_l1: means with masked pixels, which have no part in `psnr`, `ssim` and `l1`; NaN,
            and not written, where no test view has any.
        aligned_psnr, aligned_ssim, aligned_l1: means after a colour alignment (`align_colors`), in runs that learn
            exposures; NaN, and not written, in others.
    """

    iteration: int
    train_seconds: float
    psnr: float
    ssim: float
    l1: float
    num_gaussians: int
    memory_bytes: int
    nonfinite_losses: int = 0
    skipped_updates: int = 0
    worst_psnr: float = math.nan
    whole_psnr: float = math.nan
    whole_ssim: float = math.nan
    whole_l1: float = math.nan
    aligned_psnr: float = math.nan
    aligned_ssim: float = math.nan
    aligned_l1: float = math.nan

    def to_json(self) -> str:
        """One line; NaN is written as null."""
        absent = {name for name, value in asdict(self).items() if value != value and name.startswith(OPTIONAL)}
        written = {name: value for name, value in asdict(self).items() if name not in absent}
        return json.dumps({name: None if value != value else value for name, value in written.items()})


def append_evaluation(path: Path, evaluation: Evaluation) -> None:
    """Add one line to a history."""
    with open(path, "a", encoding="utf-8") as file:
        file.write(evaluation.to_json() + "\n")


def read_history(path: Path) -> list[Evaluation]:
    """All complete lines of a history; a last line cut short by a killed process is left out.

    Raises:
        InputError: unreadable, or a line that is not an evaluation.
    """
    text = read_text(path) or ""
    names = {field.name for field in fields(Evaluation)}
    evaluations = []
    for number, line in enumerate(text[: text.rfind("\n") + 1].splitlines(), start=1):
        try:
            values = {name: value for name, value in json.loads(line).items() if name in names}
            evaluations.append(Evaluation(**{name: math.nan if v is None else v for name, v in values.items()}))
        except (ValueError, TypeError, AttributeError):
            raise InputError(f"'{path}' line {number} is not an evaluation") from None
    return evaluations


def rewind_history(path: Path, iteration: int) -> list[Evaluation]:
    """Drop the evaluations after this iteration, as a resumed run will make them again."""
    kept = [evaluation for evaluation in read_history(path) if evaluation.iteration <= iteration]
    write_text_atomically(path, "".join(evaluation.to_json() + "\n" for evaluation in kept))
    return kept
