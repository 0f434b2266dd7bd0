"""Writing and reading a model as a .ply file, with the properties of the original 3DGS."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.errors import InputError
from turbogs_plugin.files import write_atomically
from turbogs_plugin.model.gsplat_file import BANDS
from turbogs_plugin.model.similarity import Similarity, in_capture, placed, rounding
from turbogs_plugin.scene.frame import Frame
from turbogs_plugin.scene.ply import read_vertices
from turbogs_plugin.types import Gaussians

POSITION_ERROR = 1e-6
"""Largest `rounding` of positions that are written as float."""
HEADER_AT_MOST = 1 << 16
"""Bytes of a file in which a comment is looked for."""
ANTIALIASED = re.compile(rb"^comment\s+(splatrendermode:\s*mip|antialiased\W+(1|true))\b", re.MULTILINE | re.IGNORECASE)
"""Brush's comment, which splat-transform writes, too, and Postshot's."""


def save_ply(gaussians: Gaussians, path: str | Path, frame: Frame | None = None, antialiased: bool = False) -> None:
    """Write a model as a .ply with the properties of the original 3DGS, normals (zero) included, whole or not at all.
    Arguments and errors as of `in_capture`.

    All properties are float, as viewers expect. Only x, y and z are double, if the capture lies so far from the origin
    that float would round positions by more than 1e-6 of its extent (UTM metres).

    Args:
        frame: None for a model in the capture's own coordinates.
        antialiased: how the model is drawn, which a comment says in Brush's words.
    """
    path, frame = Path(path), frame or Frame(np.zeros(3), 1.0)
    rows = in_capture(gaussians, frame, path, double_means=True)
    groups = _property_groups(rows.shN.shape[1])
    kinds = dict.fromkeys(groups, "float")
    if rounding(frame) > POSITION_ERROR:
        kinds["means"] = "double"
    # A field for each parameter, not for each property: the rows have equal bytes, and are filled ten times as fast.
    fields = [(name, {"float": "<f4", "double": "<f8"}[kind], (len(groups[name]),)) for name, kind in kinds.items()]
    table = np.zeros(len(rows), dtype=fields)
    for name, value in rows.items():
        array = value.transpose(1, 2).numpy() if name == "shN" else value.numpy()
        table[name].reshape(array.shape)[...] = array
    mode = f"comment SplatRenderMode: {'mip' if antialiased else 'default'}"
    header = ["ply", "format binary_little_endian 1.0", mode, f"element vertex {len(table)}"]
    header += [f"property {kind} {name}" for parameter, kind in kinds.items() for name in groups[parameter]]

    def write(file: BinaryIO) -> None:
        file.write("\n".join([*header, "end_header\n"]).encode())
        file.write(table.data)

    write_atomically(path, write)


def read_ply(path: str | Path) -> Gaussians:
    """Read a model from a .ply with the properties of 3DGS; others are ignored but the ``filter_3D`` of Mip-Splatting,
    which is fused into scales and opacities.

    Returns:
        float64, on the CPU, in the file's own coordinates; rows may be not finite.

    Raises:
        InputError: the file is not such a .ply, lacks a property, or has no Gaussian.
    """
    path = Path(path)
    vertices = read_vertices(path)
    rest = sum(name.startswith("f_rest_") for name in vertices)
    bands = rest // 3
    if rest not in [3 * each for each in BANDS]:
        raise InputError(f"{path} has {rest} properties f_rest_*: harmonics of degree 0 .. 3 have 0, 9, 24 or 45")
    groups = _property_groups(bands)
    del groups["normals"]  # not part of a model
    missing = [name for group in groups.values() for name in group if name not in vertices]
    if missing == ["scale_2"]:
        raise InputError(
            f"{path} lacks scale_2: it is a model of 2D Gaussian Splatting, whose disks are drawn otherwise: train the "
            "capture anew as 3DGS, or draw it with the program that trained it"
        )
    if missing:
        raise InputError(
            f"{path} is not a 3DGS model: it lacks the properties {', '.join(missing[:4])}, as a mesh or a cloud of "
            "points does: give the .ply that a 3DGS trainer exports, or of a compressed .ply what  npx "
            "@playcanvas/splat-transform  makes of it"
        )
    count = len(vertices["x"])
    if not count:
        raise InputError(f"{path} holds no Gaussians: export the model again")
    values = {parameter: torch.empty(count, len(group), dtype=torch.float64) for parameter, group in groups.items()}
    for parameter, group in groups.items():
        for place, name in enumerate(group):
            values[parameter][:, place] = torch.from_numpy(vertices[name].astype(np.float64))
    values["opacities"] = values["opacities"][:, 0]
    values["sh0"] = values["sh0"][:, None]
    values["shN"] = values["shN"].view(count, 3, bands).transpose(1, 2).contiguous()
    gaussians = Gaussians(**values)
    if "filter_3D" not in vertices:
        return gaussians
    return _fused(gaussians, torch.from_numpy(vertices["filter_3D"].astype(np.float64)))


def load_ply(path: str | Path, frame: Frame | None = None) -> Gaussians:
    """The model of `read_ply` as training and rendering take it (`placed`), in a frame of the file's coordinates."""
    return placed(read_ply(path), Similarity.into(frame or Frame(np.zeros(3), 1.0)), path)


def is_antialiased_ply(path: Path) -> bool:
    """Whether a comment of the header says that the model is drawn with antialiasing. Raises `OSError`."""
    with path.open("rb") as file:
        return (
            ANTIALIASED.search(file.read(HEADER_AT_MOST).replace(b"\r", b"\n").partition(b"\nend_header")[0])
            is not None
        )


def _fused(gaussians: Gaussians, sizes: Tensor) -> Gaussians:
    """The model with a 3D filter applied (Yu et al. 2024, "Mip-Splatting", equation 7).

    Args:
        sizes: [N] standard deviations of the filter.
    """
    scales = 0.5 * torch.logaddexp(2.0 * gaussians.scales, 2.0 * sizes.log()[:, None])
    opacities = torch.sigmoid(gaussians.opacities) * (gaussians.scales - scales).sum(dim=1).exp()
    return replace(gaussians, scales=scales, opacities=torch.logit(opacities))


def _property_groups(bands: int) -> dict[str, list[str]]:
    """Parameter -> its properties in the file, in the order of the original 3DGS.

    For shN: all bands of red, then of green, then of blue. `bands`: rows of `Gaussians.shN`.
    """
    return {
        "means": ["x", "y", "z"],
        "normals": ["nx", "ny", "nz"],
        "sh0": [f"f_dc_{i}" for i in range(3)],
        "shN": [f"f_rest_{i}" for i in range(3 * bands)],
        "opacities": ["opacity"],
        "scales": [f"scale_{i}" for i in range(3)],
        "quats": [f"rot_{i}" for i in range(4)],
    }
