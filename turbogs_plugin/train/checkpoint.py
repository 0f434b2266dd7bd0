"""Checkpoints: plain tensors and numbers (`RunSession.state_dict`, `TrainingState.state_dict`), never executed.

A run's folder ``checkpoints/`` holds ``iteration-NNNNNN.pt`` files, each put in place by one rename, so every one is
complete, and the newest is of the latest iteration.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.errors import InputError, TrainingStopped
from turbogs_plugin.model.torch_file import leaves, read_plain, save_plain

FORMAT = 2
KEPT = 2
"""Checkpoints that stay on the disk: the newest and one before it."""
COUNT_LIMIT = 2**31
"""All whole numbers in a state are counts below this, in tensors below half of it."""
CHECKED_AT_ONCE = 2**24
"""Numbers: error maps may be larger than the memory."""
REMEDY = "train anew with another --out"
_NAME = re.compile(r"iteration-(\d{6,})\.pt")


def save_checkpoint(folder: Path, iteration: int, state: dict[str, Any]) -> Path:
    """Write the state of a run, nested dicts, lists and tuples of tensors and plain values, after this number of
    iterations, into its folder ``checkpoints/``, and make it the newest one. Raises `TrainingStopped` where the disk
    refused, and the checkpoint before stays the newest; `TypeError` where something is not plain."""
    for place, value in leaves(state, "state"):
        if type(value) not in (Tensor, int, float, bool, str, type(None)):
            raise TypeError(f"{place}: a checkpoint holds tensors and plain values, not {type(value).__name__}")
    path = folder / f"iteration-{iteration:06d}.pt"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        save_plain(path, {"format": FORMAT, **state})
    except OSError as error:
        said = f"the checkpoint could not be written to '{folder}' ({error.strerror or error})"
        raise TrainingStopped(f"iteration {iteration}: {said}: once it can be, go on with --resume") from error
    for leftover in folder.glob(".iteration-*.part"):  # from a killed process
        leftover.unlink(missing_ok=True)
    for old in _complete(folder)[:-KEPT]:
        old.unlink(missing_ok=True)
    return path


def _complete(folder: Path) -> list[Path]:
    """The checkpoints in a folder, by iteration; none where there is no such folder."""
    found = folder.iterdir() if folder.is_dir() else ()
    return sorted((file for file in found if _NAME.fullmatch(file.name)), key=lambda file: int(file.stem[10:]))


def latest_checkpoint(folder: Path) -> Path | None:
    """The newest checkpoint of a ``checkpoints/`` folder, or None if there is none."""
    return next(reversed(_complete(folder)), None)


def load_checkpoint(path: Path) -> dict[str, Any]:
    """The state in a checkpoint, on the CPU. Raises `InputError` for what is no checkpoint of TurboGS, truncated, or
    with anything but plain tensors and values in it."""
    others = [file for file in _complete(path.parent) if file.name != path.name]
    remedy = f"; remove it to go on from {others[-1].name}, or {REMEDY}" if others else f"; {REMEDY}"
    state = read_plain(path, f"checkpoint '{path}'", remedy)
    if not isinstance(state, dict) or state.pop("format", None) != FORMAT:
        raise InputError(f"checkpoint '{path}' cannot be used: not a checkpoint of this version of TurboGS{remedy}")
    return state


def require_like(saved: Any, present: Any, place: str) -> None:
    """Raise `ValueError`, which names the place, for a state of another structure than the present one: other keys or
    types, other dtypes or dimensions of tensors; or for numbers that are not finite. The number of rows of a tensor may
    differ, as it depends on how far the run had come; None may stand for a mapping: a part without state."""
    if present is None or (saved is None and isinstance(present, dict)):
        return
    fits = type(saved) is type(present)
    if fits and isinstance(present, dict):
        fits = saved.keys() == present.keys()
        for key in present if fits else ():
            require_like(saved[key], present[key], f"{place}.{key}")
    elif fits and isinstance(present, Tensor):
        fits = saved.dtype == present.dtype and saved.dim() == present.dim() and saved.shape[1:] == present.shape[1:]
        fits = fits and all(part.isfinite().all() for part in saved.reshape(-1).split(CHECKED_AT_ONCE))
        if fits and saved.dtype in (torch.int32, torch.int64):
            fits = not saved.numel() or -COUNT_LIMIT // 2 < int(saved.min()) <= int(saved.max()) < COUNT_LIMIT // 2
    elif fits and isinstance(present, float):
        fits = math.isfinite(saved)
    elif fits and isinstance(present, int):
        fits = 0 <= saved < COUNT_LIMIT
    if not fits:
        raise ValueError(f"{place} is not finite, or has another form than this run's")
