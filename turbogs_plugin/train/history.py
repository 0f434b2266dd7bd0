"""``history.jsonl``, the record of error against run time: one line per evaluation."""

from __future__ import annotations

import json
import math
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from turbogs_plugin.errors import InputError
from turbogs_plugin.files import naming, read_text, write_text_atomically
from turbogs_plugin.yaml_json import parse_json

MEASURES = ("psnr", "ssim", "l1")
"""The errors that every comparison of a render with a photo gives."""


@dataclass(kw_only=True)
class FurtherErrors:
    """Errors beside the plain ones, at the end of a run; NaN where they were not computed. `own`: of the model's own
    colours in runs that learn exposures, where plain ones are of views with the exposures of their neighbours
    (`interpolated_exposures`). `refined`: by refined cameras of the test photos (`PosedImages.refined`)."""

    own_psnr: float = field(default=math.nan, repr=False)
    own_ssim: float = field(default=math.nan, repr=False)
    own_l1: float = field(default=math.nan, repr=False)
    refined_psnr: float = field(default=math.nan, repr=False)
    refined_ssim: float = field(default=math.nan, repr=False)
    refined_l1: float = field(default=math.nan, repr=False)


@dataclass
class Evaluation(FurtherErrors):
    """One evaluation.

    Args:
        iteration: finished iterations.
        train_seconds: training time until then, without loading, evaluation, checkpoints and report.
        psnr, ssim, l1: means over the test views, as further errors are; `ssim` is NaN if images are too small for it.
        num_gaussians: N.
        memory_bytes: peak of the GPU's tensors, or of the process on a CPU; 0 where it was not kept.
        nonfinite_losses: iterations so far whose loss was not finite.
        skipped_updates: updates of Gaussians skipped so far because their gradient was not finite.
        worst_psnr: PSNR of the worst test view.
    """

    iteration: int
    train_seconds: float
    psnr: float
    ssim: float
    l1: float
    num_gaussians: int
    memory_bytes: int = 0
    nonfinite_losses: int = 0
    skipped_updates: int = 0
    worst_psnr: float = math.nan


def without_nan(measured: FurtherErrors) -> dict[str, Any]:
    """The fields of an evaluation or a view's errors for JSON, which has null for NaN."""
    return {name: None if value != value else value for name, value in asdict(measured).items()}


def measure(value: Any) -> Any:
    """A number of a file; NaN for null. Raises `TypeError` for what is none, or finite and as large as none is."""
    if not isinstance(value, int | float | None) or 1e15 < abs(value or 0) < math.inf:
        raise TypeError(f"{str(value)[:40]} is no measure")
    return math.nan if value is None else value


def append_evaluation(path: Path, evaluation: Evaluation) -> None:
    """Add one line to a history."""
    with naming(path), open(path, "a", opener=lambda name, flags: os.open(name, flags | os.O_NOFOLLOW, 0o666)) as file:
        file.write(json.dumps(without_nan(evaluation)) + "\n")


def read_history(path: Path) -> list[Evaluation]:
    """All complete lines of a history, without a last one that a loss of power, say, cut short. Raises `InputError`
    where it cannot be read, or a line is not an evaluation."""
    text, evaluations = read_text(path) or "", []
    lines = text[: text.rfind("\n") + 1].splitlines()
    for number, line in enumerate(lines, start=1):
        if number == len(lines) and not line.endswith("}"):
            break
        try:
            found = parse_json(line, "it").items()
            evaluations.append(Evaluation(**{name: measure(value) for name, value in found}))
        except (ValueError, TypeError, AttributeError):
            raise InputError(f"'{path}' line {number} is not an evaluation: take that line out") from None
    return evaluations


def rewind_history(path: Path, iteration: int) -> list[Evaluation]:
    """Drop the evaluations after this iteration, as a resumed run will make them again."""
    kept = [evaluation for evaluation in read_history(path) if evaluation.iteration <= iteration]
    write_text_atomically(path, "".join(json.dumps(without_nan(evaluation)) + "\n" for evaluation in kept))
    return kept
