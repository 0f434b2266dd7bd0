"""Models as gsplat's example trainer saves them: ``{"step": int, "splats": {parameter: tensor}}`` by `torch.save`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.errors import InputError
from turbogs_plugin.model.similarity import in_capture
from turbogs_plugin.model.torch_file import save_plain
from turbogs_plugin.scene.frame import Frame
from turbogs_plugin.types import PARAMETER_NAMES, Gaussians

BANDS = (0, 3, 8, 15)
"""Numbers of bands of harmonics above degree 0, of the degrees 0 .. 3."""


def save_gsplat(gaussians: Gaussians, path: Path, frame: Frame, step: int = 0) -> None:
    """Write a model as gsplat's trainer does, whole or not at all, in the capture's own coordinates. Arguments and
    errors as of `in_capture`; `step`: iterations of its training."""
    save_plain(path, {"step": step, "splats": dict(in_capture(gaussians, frame, path).items())})


def read_gsplat(state: Mapping[str, Any], path: str | Path) -> Gaussians:
    """The model in a state that gsplat's trainer saved, in the file's own coordinates.

    Args:
        state: plain tensors and values, with ``splats``.
        path: the file, for messages.

    Returns:
        float64, on the CPU; rows may be not finite.

    Raises:
        InputError: parameters that are missing, of other shapes, or none at all.
    """
    splats = state["splats"] if isinstance(state["splats"], Mapping) else {}
    if missing := [name for name in PARAMETER_NAMES if not isinstance(splats.get(name), Tensor)]:
        present = ", ".join(sorted(map(str, splats))[:8]) or "nothing"
        raise InputError(
            f"{path}: its splats lack {', '.join(missing)} (there is {present}): give a 3DGS model, trained without "
            "gsplat's appearance network (app_opt)"
        )
    count = len(splats["means"]) if splats["means"].dim() else 0
    bands = splats["shN"].shape[1] if splats["shN"].dim() == 3 else -1
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, 1, 3), (count, bands, 3))
    for name, shape in zip(PARAMETER_NAMES, shapes, strict=True):
        value = splats[name]
        if value.shape != shape or not value.is_floating_point() or value.layout != torch.strided:
            kind = f"{str(value.dtype).removeprefix('torch.')} {tuple(value.shape)}"
            raise InputError(f"{path}: {name} is {kind} where gsplat has float32 {shape}: export the model again")
    if not count or bands not in BANDS:
        raise InputError(
            f"{path} holds {count} Gaussians whose shN has {bands} bands: export a model with harmonics of degree "
            "0 .. 3, which has 0, 3, 8 or 15"
        )
    return Gaussians(**{name: splats[name].detach().double() for name in PARAMETER_NAMES})
