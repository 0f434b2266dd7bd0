"""Checkpoints: plain tensors and numbers in one file, never half-written, never executed.

A run's folder ``checkpoints/`` holds ``iteration-NNNNNN.pt`` files and ``latest``, a text file with the name of the
newest complete one. Both are put in place by one rename each, first the checkpoint, then `latest`. Older checkpoints
are removed after that. So at every moment `latest` names a complete file. What a checkpoint holds:
`RunSession.state_dict` and `Trainer.state_dict`.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.engine.layout import MAX_SH_DEGREE
from turbogs_plugin.errors import InputError, TrainingStopped
from turbogs_plugin.files import read_text, write_text_atomically
from turbogs_plugin.model.torch_file import leaves, read_plain, save_plain
from turbogs_plugin.types import PARAMETER_NAMES, Gaussians

FORMAT = 2
KEPT = 2
"""Checkpoints that stay on the disk: the newest and one before it."""

COUNT_LIMIT = 2**31
"""All whole numbers in a state are counts below this."""

CHECKED_AT_ONCE = 2**24
"""Numbers: error maps may be larger than the memory."""

_NAME = re.compile(r"iteration-(\d{6,})\.pt")


def save_checkpoint(folder: Path, iteration: int, state: dict[str, Any]) -> Path:
    """Write the state of a run and make it the newest one.

    Args:
        folder: ``checkpoints/`` of the run; made if absent.
        iteration: finished iterations.
        state: nested dicts, lists and tuples of tensors, numbers, text, booleans and None.

    Returns:
        The file.

    Raises:
        TrainingStopped: the disk refused; the newest checkpoint is the one before.
        TypeError: something in `state` is not plain.
    """
    for place, value in leaves(state, "state"):
        if type(value) not in (Tensor, int, float, bool, str, type(None)):
            raise TypeError(f"{place}: a checkpoint holds tensors and plain values, not {type(value).__name__}")
    path = folder / f"iteration-{iteration:06d}.pt"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        save_plain(path, {"format": FORMAT, **state})
        write_text_atomically(folder / "latest", path.name)
    except OSError as error:
        raise TrainingStopped(
            f"iteration {iteration}: the checkpoint could not be written to '{folder}' ({error.strerror or error}): "
            "once it can be, go on with --resume"
        ) from error
    for leftover in folder.glob(".iteration-*.part"):  # from a killed process
        leftover.unlink(missing_ok=True)
    others = _others(folder, path.name)
    # First those of a later iteration: a resume went back from it.
    others.sort(key=lambda file: _iteration(file) < iteration)
    for old in others[: len(others) - (KEPT - 1)]:
        old.unlink(missing_ok=True)
    return path


def _others(folder: Path, name: str) -> list[Path]:
    """The checkpoints beside the one of this name, by iteration."""
    found = [file for file in folder.iterdir() if _NAME.fullmatch(file.name) and file.name != name]
    return sorted(found, key=_iteration)


def _iteration(file: Path) -> int:
    return int(file.stem.removeprefix("iteration-"))


def _remedy(folder: Path, name: str) -> str:
    """What to do where the checkpoint of this name cannot be used."""
    others = _others(folder, name) if folder.is_dir() else []
    use = f"write {others[-1].name} into '{folder / 'latest'}' to use that one, or " if others else ""
    return f"; {use}train anew with another --out"


def latest_checkpoint(folder: Path) -> Path | None:
    """The newest complete checkpoint of a ``checkpoints/`` folder, or None if there is none.

    Raises:
        InputError: `latest` names no checkpoint of this folder.
    """
    text = read_text(folder / "latest")
    if text is None:
        complete = _others(folder, "") if folder.is_dir() else []
        return complete[-1] if complete else None  # killed before the first `latest`, or that was not copied
    name = text.strip()
    if not _NAME.fullmatch(name) or not (folder / name).is_file():
        said = f"'{folder / 'latest'}' names no checkpoint of its folder: '{name[:60]}'"
        raise InputError(said + _remedy(folder, name))
    return folder / name


def load_checkpoint(path: Path) -> dict[str, Any]:
    """The state in a checkpoint, on the CPU.

    Raises:
        InputError: not a checkpoint of TurboGS, truncated, or with anything but plain tensors and values in it.
    """
    remedy = _remedy(path.parent, path.name)
    state = read_plain(path, f"checkpoint '{path}'", remedy)
    if not isinstance(state, dict) or state.pop("format", None) != FORMAT:
        raise InputError(f"checkpoint '{path}' cannot be used: not a checkpoint of this version of TurboGS{remedy}")
    return state


def gaussians_of_state(state: dict[str, Any], device: torch.device) -> Gaussians:
    """The model in a checkpoint's state.

    Raises:
        ValueError: the tensors are not the parameters of one model, or not finite.
    """
    gaussians = Gaussians(**{name: state["gaussians"][name].to(device) for name in PARAMETER_NAMES})
    count, bands = len(gaussians), gaussians.shN.shape[1]
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, 1, 3), (count, bands, 3))
    for (name, value), shape in zip(gaussians.items(), shapes, strict=True):
        if value.shape != shape or value.dtype != torch.float32:
            raise ValueError(f"gaussians.{name} has shape {tuple(value.shape)} where {shape} was expected")
        if not value.isfinite().all():
            raise ValueError(f"gaussians.{name} is not finite")
    if bands not in [(degree + 1) ** 2 - 1 for degree in range(MAX_SH_DEGREE + 1)]:
        raise ValueError(f"gaussians.shN has {bands} bands")
    return gaussians


def require_like(saved: Any, present: Any, place: str) -> None:
    """Refuse a state whose structure differs from the present one: other keys or types, other dtypes or dimensions of
    tensors. Numbers that are not finite are refused too.

    The number of rows of a tensor may differ, as it depends on how far the run had come. None instead of a mapping is
    allowed too: a part without state.

    Raises:
        ValueError: the message names the place.
    """
    if present is None or (saved is None and isinstance(present, dict)):
        return
    if type(saved) is not type(present):
        raise ValueError(f"{place} is of type {type(saved).__name__}, not {type(present).__name__}")
    if isinstance(present, dict):
        if saved.keys() != present.keys():
            names = ", ".join(sorted(map(str, saved.keys() ^ present.keys()))[:4])
            raise ValueError(f"{place} lacks, or has in excess: {names}")
        for key, value in present.items():
            require_like(saved[key], value, f"{place}.{key}")
    elif isinstance(present, Tensor):
        if saved.dtype != present.dtype or saved.dim() != present.dim() or saved.shape[1:] != present.shape[1:]:
            raise ValueError(f"{place} is {_layout(saved)}, which does not fit {_layout(present)}")
        if not all(part.isfinite().all() for part in saved.reshape(-1).split(CHECKED_AT_ONCE)):
            raise ValueError(f"{place} is not finite")
    elif isinstance(present, float) and not math.isfinite(saved):
        raise ValueError(f"{place} is {saved}")
    elif isinstance(present, int) and not 0 <= saved < COUNT_LIMIT:
        raise ValueError(f"{place} is {saved}, which is no count")


def _layout(tensor: Tensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')} {tuple(tensor.shape)}"
