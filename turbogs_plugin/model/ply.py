"""Writing and reading a model as a .ply file, with the properties of the original 3DGS."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import torch

from turbogs_plugin.errors import InputError
from turbogs_plugin.files import write_atomically
from turbogs_plugin.model.similarity import Similarity, in_capture, placed, rounding
from turbogs_plugin.model.torch_file import BANDS
from turbogs_plugin.scene.frame import Frame
from turbogs_plugin.scene.ply import read_vertices
from turbogs_plugin.types import Gaussians

POSITION_ERROR = 1e-6
"""Largest `rounding` of positions that are written as float."""
OWN = Frame(np.zeros(3), 1.0)  # the frame that is the capture's own coordinates
FEWEST_TOLD = 100  # Gaussians; no trained model has scales all above 1, and half below e^.1 or logits, too, in [0, 1]
HEADER_AT_MOST = 1 << 16  # bytes of a file in which a comment is looked for
ANTIALIASED = re.compile(rb"^comment\s+(splatrendermode:\s*mip|antialiased\W+(1|true))\b", re.MULTILINE | re.IGNORECASE)
"""Brush's comment, which splat-transform writes, too, and Postshot's."""


def save_ply(gaussians: Gaussians, path: Path, frame: Frame = OWN, step: int = 0, antialiased: bool = False) -> None:
    """Write a model (`formats.Write`), with normals of zero. A comment says in Brush's words how it is drawn.

    All properties are float, as viewers expect. Only x, y and z are double, if the capture lies so far from the origin
    that float would round positions by more than `POSITION_ERROR` of its extent (UTM metres).
    """
    rows = in_capture(gaussians, frame, path, double_means=True)
    groups = _property_groups(rows.shN.shape[1])
    kinds = dict.fromkeys(groups, "float") | ({"means": "double"} if rounding(frame) > POSITION_ERROR else {})
    # A field for each parameter, not for each property: the rows have equal bytes, and are filled ten times as fast.
    fields = [(name, {"float": "<f4", "double": "<f8"}[kind], (len(groups[name]),)) for name, kind in kinds.items()]
    table = np.zeros(len(rows), dtype=fields)
    for name, value in rows.items():
        array = value.mT.numpy() if name == "shN" else value.numpy()
        table[name].reshape(array.shape)[...] = array
    mode = f"comment SplatRenderMode: {'mip' if antialiased else 'default'}"
    header = ["ply", "format binary_little_endian 1.0", mode, f"element vertex {len(table)}"]
    header += [f"property {kind} {name}" for parameter, kind in kinds.items() for name in groups[parameter]]
    head = "\n".join([*header, "end_header\n"]).encode()
    write_atomically(path, lambda file: file.writelines([head, table.data]))


def read_ply(path: Path) -> tuple[Gaussians, bool]:
    """A model (`formats.Read`) from a .ply with the properties of 3DGS, on the CPU, perhaps with rows that are not
    finite; a comment may say that it is drawn with antialiasing. Other properties are ignored but the ``filter_3D`` of
    Mip-Splatting, which is fused into scales and opacities (Yu et al. 2024, equation 7). Raises `InputError` where the
    file is not such a .ply, lacks a property, or has no Gaussian."""
    vertices = read_vertices(path)
    rest = sum(name.startswith("f_rest_") for name in vertices)
    if rest not in [3 * each for each in BANDS]:
        raise InputError(f"{path} has {rest} properties f_rest_*: harmonics of degree 0 .. 3 have 0, 9, 24 or 45")
    groups = _property_groups(rest // 3)
    del groups["normals"]  # not part of a model
    names = [name for group in groups.values() for name in group]
    missing = [name for name in names if name not in vertices]
    if missing == ["scale_2"]:
        remedy = "train the capture anew as 3DGS, or draw it with the program that trained it"
        raise InputError(f"{path} lacks scale_2: it is a model of 2D Gaussian Splatting, of disks: {remedy}")
    if missing:
        lacks = f"it lacks the properties {', '.join(missing[:4])}, as a mesh or a cloud of points does"
        raise InputError(f"{path} is not a 3DGS model: {lacks}: give the .ply that a 3DGS trainer exports")
    if not (count := len(vertices["x"])):
        raise InputError(f"{path} holds no Gaussians: export the model again")
    table = torch.from_numpy(np.stack([vertices[name] for name in names], axis=1, dtype=np.float64))  # [N, D]
    means, sh0, shN, opacities, scales, quats = table.split([len(group) for group in groups.values()], dim=1)
    opacities = opacities[:, 0]
    shares, small = 0 <= opacities.min() < opacities.max() <= 1, scales.median() < 0.1
    if count >= FEWEST_TOLD and (scales > 0).all() and (shares or small):
        raise InputError(f"{path} has activated scales: export logarithms of scales, logits of opacities, as 3DGS does")
    if "filter_3D" in vertices:
        sizes = torch.from_numpy(vertices["filter_3D"].astype(np.float64))  # [N] standard deviations
        wider = 0.5 * torch.logaddexp(2.0 * scales, 2.0 * sizes.log()[:, None])
        opacities = torch.logit(torch.sigmoid(opacities) * (scales - wider).sum(dim=1).exp())
        scales = wider
    with path.open("rb") as file:
        header = file.read(HEADER_AT_MOST).replace(b"\r", b"\n").partition(b"\nend_header")[0]
    model = Gaussians(means, quats, scales, opacities, sh0[:, None], shN.reshape(count, 3, rest // 3).mT)
    return model, ANTIALIASED.search(header) is not None


def load_ply(path: Path, frame: Frame = OWN) -> Gaussians:
    """The model of `read_ply` as training and rendering take it, in a frame of the file's coordinates."""
    return placed(read_ply(path)[0], Similarity.into(frame), path)


def _property_groups(bands: int) -> dict[str, list[str]]:
    """Parameter -> its properties in the file, in the order of the original 3DGS. For shN: all bands of red, then of
    green, then of blue. `bands`: rows of `Gaussians.shN`."""
    return {
        "means": ["x", "y", "z"],
        "normals": ["nx", "ny", "nz"],
        "sh0": [f"f_dc_{i}" for i in range(3)],
        "shN": [f"f_rest_{i}" for i in range(3 * bands)],
        "opacities": ["opacity"],
        "scales": [f"scale_{i}" for i in range(3)],
        "quats": [f"rot_{i}" for i in range(4)],
    }
