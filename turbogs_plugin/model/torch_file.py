"""Files of `torch.save` from anybody: plain tensors and values only, no larger in memory than on the disk; and models
as gsplat's example trainer saves them: ``{"step": int, "splats": {parameter: tensor}}``."""

from __future__ import annotations

import os
import pickletools
import re
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.errors import InputError
from turbogs_plugin.files import write_atomically
from turbogs_plugin.model.similarity import in_capture
from turbogs_plugin.scene.frame import Frame
from turbogs_plugin.scene.host_arrays import too_large
from turbogs_plugin.types import PARAMETER_NAMES, Gaussians

PLAIN = re.compile(
    r"collections OrderedDict|torch\._utils _rebuild_(tensor_v2|parameter)|"
    r"torch (\w+Storage|Size|device|float\d+|bfloat16|u?int\d+|bool)"
)
"""Names that a file may call. torch allows others besides, some of which take any amount of memory."""
MOST_TUPLES = 20_000  # a tensor has five; nested without end, a key of a dict, they end the process
BANDS = (0, 3, 8, 15)
"""Numbers of bands of harmonics above degree 0, of the degrees 0 .. 3."""


def read_plain(path: Path, name: str, remedy: str = "") -> Any:
    """What a file of `torch.save` holds, on the CPU.

    Only plain tensors and values are read (``weights_only``), by the names of `PLAIN`. They must be uncompressed, no
    larger than the file, and in the host's memory, and no tuple may stand in several places. So a file from an
    untrusted source can neither run code nor take more memory than some 100 bytes for each of its own, nor work without
    end. Tensors of one that is large beside the free memory are read from the disk as they are used.

    Raises `InputError` about the file, called `name`, where it cannot be read or used, with the `remedy`."""
    try:
        _require_bounded(path)
        state = torch.load(path, map_location="cpu", weights_only=True, mmap=too_large(os.path.getsize(path)))
        for tensor in _tensors(state):
            if tensor.device.type != "cpu" or tensor.nbytes > tensor.untyped_storage().nbytes():
                raise ValueError("it has a tensor that is not stored whole")
        return state
    except OSError as error:
        raise InputError(f"cannot read {name}: {error.strerror or error}") from None
    except Exception as error:  # torch and zipfile raise a dozen kinds for malformed files
        reason = (str(error) or type(error).__name__).splitlines()[0][:160]
        if "weights only" in str(error).lower().replace("_", " "):
            reason = "it holds more than plain tensors and values"
        raise InputError(f"{name} cannot be used: {reason}{remedy}") from None


def save_plain(path: Path, state: Any) -> None:
    """`torch.save` into a file that is written whole or not at all. Raises `OSError` if the disk refused."""
    try:
        write_atomically(path, lambda file: torch.save(_alone(state), file))
    except RuntimeError as error:  # of torch, about positions in the file
        cause = error.__context__
        raise cause if isinstance(cause, OSError) else OSError(str(error).splitlines()[0]) from error


def _alone(value: Any) -> Any:
    """`value` with tensors of a GPU that are parts of a larger storage copied to the host: torch saves whole storages.
    Tensors of the host are left: maps there may lie in files."""
    if isinstance(value, dict):
        return {key: _alone(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(map(_alone, value))
    part = isinstance(value, Tensor) and value.is_cuda and value.untyped_storage().nbytes() > value.nbytes
    return value.cpu() if part else value


def leaves(value: Any, place: str) -> Iterator[tuple[str, Any]]:
    """(place, value) of every value in nested dicts, lists and tuples, and of the dicts' keys."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield f"{place}.{key}", key
            yield from leaves(item, f"{place}.{key}")
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            yield from leaves(item, f"{place}[{index}]")
    else:
        yield place, value


def _tensors(state: Any) -> Iterator[Tensor]:
    """The tensors in nested dicts, lists and tuples, each object of which is looked at once."""
    left, seen = [state], {id(state)}
    while left:
        value = left.pop()
        if isinstance(value, Tensor):
            yield value
        inner = [*value.values()] if isinstance(value, dict) else value if isinstance(value, list | tuple) else []
        left += [item for item in inner if id(item) not in seen]
        seen.update(map(id, inner))


def _require_bounded(path: Path) -> None:
    """Refuse archives that unpack to more than their size, or whose values do (`_require_plain`)."""
    with zipfile.ZipFile(path) as archive:
        # torch does not tell capitals from small letters.
        entries = {entry.filename.lower(): entry for entry in archive.infolist()}
        if len(entries) < len(archive.infolist()):
            raise ValueError("it has two entries of one name")
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries.values()):
            raise ValueError("its entries are compressed")
        if sum(entry.file_size for entry in entries.values()) > os.path.getsize(path):
            raise ValueError("its entries overlap")
        for name, entry in entries.items():
            if name.endswith(".pkl"):
                _require_plain(archive.read(entry))


def _require_plain(pickled: bytes) -> None:
    """Refuse values that call other names than those of `PLAIN`, and tuples in several places: nested, they are keys
    whose hash takes endless time, and values that no walk comes to the end of."""
    tuples: set[object] = set()
    made, count = "", 0
    for code, argument, _ in pickletools.genops(pickled):
        if code.name == "GLOBAL" and not PLAIN.fullmatch(str(argument)):
            raise ValueError(f"it holds more than plain tensors and values: {str(argument)[:60]}")
        if code.name in ("BINPUT", "LONG_BINPUT"):
            (tuples.add if made.startswith("TUPLE") else tuples.discard)(argument)
        elif code.name in ("BINGET", "LONG_BINGET") and argument in tuples:
            raise ValueError("it has one tuple in several places")
        else:
            made = code.name
            if (count := count + made.startswith("TUPLE")) > MOST_TUPLES:
                raise ValueError(f"it has more than {MOST_TUPLES} tuples")


def save_gsplat(gaussians: Gaussians, path: Path, frame: Frame, step: int = 0, antialiased: bool = False) -> None:
    """Write a model (`formats.Write`) as gsplat's trainer does."""
    save_plain(path, {"step": step, "splats": dict(in_capture(gaussians, frame, path).items())})


def read_gsplat(state: Mapping[str, Any], path: str | Path) -> Gaussians:
    """The model in a state that gsplat's trainer saved, in the file's own coordinates; float64, on the CPU, perhaps
    with rows that are not finite. Raises `InputError`, about the file `path`, where parameters are missing or of other
    shapes."""
    splats = state["splats"] if isinstance(state["splats"], Mapping) else {}
    if missing := [name for name in PARAMETER_NAMES if not isinstance(splats.get(name), Tensor)]:
        present = ", ".join(sorted(map(str, splats))[:8]) or "nothing"
        remedy = "give a 3DGS model, trained without gsplat's appearance network (app_opt)"
        raise InputError(f"{path}: its splats lack {', '.join(missing)} (there is {present}): {remedy}")
    count = len(splats["means"]) if splats["means"].dim() else 0
    bands = splats["shN"].shape[1] if splats["shN"].dim() == 3 else -1
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, 1, 3), (count, bands, 3))
    for name, shape in zip(PARAMETER_NAMES, shapes, strict=True):
        value = splats[name]
        if value.shape != shape or not value.is_floating_point() or value.layout != torch.strided:
            kind = f"{str(value.dtype).removeprefix('torch.')} {tuple(value.shape)}"
            raise InputError(f"{path}: {name} is {kind} where gsplat has float32 {shape}: export the model again")
    if not count or bands not in BANDS:
        remedy = "export a model with harmonics of degree 0 .. 3, which has 0, 3, 8 or 15"
        raise InputError(f"{path} holds {count} Gaussians whose shN has {bands} bands: {remedy}")
    return Gaussians(**{name: splats[name].detach().double() for name in PARAMETER_NAMES})
