"""Gaussians in gsplat's layout: made from points, and to and from .ply."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.errors import InputError
from turbogs_plugin.files import write_atomically
from turbogs_plugin.scene.frame import Frame
from turbogs_plugin.scene.nearest import mean_neighbor_distances
from turbogs_plugin.scene.ply import read_vertices
from turbogs_plugin.types import Gaussians

SH_C0 = 0.28209479177387814
"""Band 0 of the spherical harmonics: colour = SH_C0 * sh0 + 0.5."""

INITIAL_OPACITY = 0.1
DARKEST = 0.5
"""A new Gaussian's channel, of 255: at 0 it would lie on the clamp of colours, where rounding says if it can learn."""
SMALLEST_SCALE = 1e-4
"""Of a new Gaussian, in extents: coincident points would otherwise give a scale of zero."""
LONELY_SCALE = 0.01
"""Scale of a Gaussian without neighbours, in extents."""
POSITION_ERROR = 1e-6
"""Largest rounding of exported positions that the place of the capture may cause, in units of the frame's scale."""
LARGEST_SH_DEGREE = 4
BACKDROP_COUNT = 3000
BACKDROP_RADIUS = 20.0
"""In extents: beyond what a capture shows, near enough that floats tell its Gaussians apart."""
BACKDROP_OPACITY = 0.88
"""Several of its Gaussians cover a direction, so that nothing shines through."""
DISTANT = 2.0
"""In extents: what lies beyond is bounded in size by its distance."""
RESTRAIN_EVERY = 10
"""Iterations between two looks at these sizes; in so few they grow by a quarter."""


def gaussians_from_points(
    points: Tensor, colors: Tensor, sh_degree: int, extent: float, opacity: float = INITIAL_OPACITY, size: float = 1.0
) -> Gaussians:
    """One isotropic Gaussian a point, as 3DGS starts (Kerbl et al. 2023, section 5.1).

    Its scale is `size` times the mean distance to the three nearest points, its colour the point's, black as half a
    step above it; the higher bands are zero.

    Args:
        points: [M, 3] float. Points that are not finite are left out, with a warning that counts them.
        colors: [M, 3] uint8.
        sh_degree: the degree to make room for, 0 .. 4.
        extent: the scene's, in the points' unit; bounds the scales from below where points coincide.
        opacity: of every Gaussian, within (0, 1).
        size: factor of the scales.

    Raises:
        InputError: no finite points, a degree out of range, an extent that is not positive.
    """
    if not 0 <= sh_degree <= LARGEST_SH_DEGREE:
        raise InputError(f"sh_degree is {sh_degree}: it must be 0 .. {LARGEST_SH_DEGREE}")
    if not (math.isfinite(extent) and extent > 0):
        raise InputError(f"extent is {extent}: it must be finite and positive")
    finite = points.isfinite().all(dim=1)
    if not finite.all():
        warnings.warn(f"{int((~finite).sum())} of {len(points)} points are not finite and left out", stacklevel=2)
        points, colors = points[finite], colors[finite]
    count = len(points)
    if count == 0:
        raise InputError("there are no points to start from")
    distances = (
        mean_neighbor_distances(points, neighbors=3) if count > 1 else points.new_full((1,), LONELY_SCALE * extent)
    )
    scales = (size * distances).clamp(min=SMALLEST_SCALE * extent).log()
    quats = points.new_zeros(count, 4)
    quats[:, 0] = 1.0
    return Gaussians(
        means=points.clone(),
        quats=quats,
        scales=scales[:, None].repeat(1, 3),
        opacities=points.new_full((count,), math.log(opacity / (1.0 - opacity))),
        sh0=((colors.to(points).clamp(min=DARKEST) / 255.0 - 0.5) / SH_C0)[:, None, :],
        shN=points.new_zeros(count, (sh_degree + 1) ** 2 - 1, 3),
    )


def backdrop_gaussians(color: Tensor, sh_degree: int, extent: float) -> Gaussians:
    """A sphere around the scene and all cameras, of one colour: what is seen where the model has nothing.

    Without it, that is black. Its Gaussians lie on a Fibonacci lattice and train like all others.

    Args:
        color: [3] float, 0 .. 1, for instance the mean of the photos.
        sh_degree: the degree to make room for, 0 .. 4.
        extent: the scene's.
    """
    index = torch.arange(BACKDROP_COUNT, dtype=torch.float64) + 0.5
    height = 1.0 - 2.0 * index / BACKDROP_COUNT
    angle = index * math.pi * (1.0 + math.sqrt(5.0))
    ring = (1.0 - height * height).sqrt()
    directions = torch.stack([ring * angle.cos(), ring * angle.sin(), height], dim=1).float()
    colors = (color.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).expand(BACKDROP_COUNT, 3)
    backdrop = gaussians_from_points(directions * BACKDROP_RADIUS * extent, colors, sh_degree, extent)
    backdrop.opacities.fill_(math.log(BACKDROP_OPACITY / (1.0 - BACKDROP_OPACITY)))
    return backdrop


@torch.no_grad()
def restrain_distant(gaussians: Gaussians, extent: float, size: float) -> None:
    """Keep Gaussians beyond `DISTANT` extents from growing, in place, past a share of their distance from all cameras.

    A splat is as large as its Gaussian over its depth, and as far from the image's middle as its centre over that
    depth. So one beside a camera reaches the middle of its image, whatever its depth and perhaps in front of all else,
    once its deviation is a third of its distance (splats are cut at 3.33). No training view need show it.

    Args:
        gaussians: about the cameras' centre.
        extent: the scene's, which holds all cameras.
        size: largest standard deviation over the distance from the nearest place where a camera may be.
    """
    distances = gaussians.means.norm(dim=-1, keepdim=True)  # [N, 1]
    limits = (size * (distances - extent)).log()
    limits = torch.where(distances > DISTANT * extent, limits, torch.inf)
    torch.minimum(gaussians.scales, limits, out=gaussians.scales)


def save_ply(gaussians: Gaussians, path: str | Path, frame: Frame | None = None) -> None:
    """Write a model as a .ply with the properties of the original 3DGS, normals (zero) included.

    All properties are float, as viewers expect. Only where the capture lies so far from the origin that float would
    round positions by more than 1e-6 of its extent (UTM metres) are x, y and z double. The file appears whole or not
    at all.

    Args:
        gaussians: the model. Gaussians that are not finite are left out, with a warning that counts them.
        path: the file to write; its folder must exist.
        frame: where given, the model is taken back to the capture's own coordinates.

    Raises:
        InputError: nothing to write, or the file cannot be written.
    """
    path = Path(path)
    frame = frame or Frame(np.zeros(3), 1.0)
    rows = gaussians.map(lambda value: value.detach().cpu())
    finite = torch.stack([value.flatten(1).isfinite().all(dim=1) for _, value in _columns(rows)]).all(dim=0)
    if not finite.all():
        warnings.warn(f"{int((~finite).sum())} of {len(rows)} Gaussians are not finite and left out", stacklevel=2)
        rows = rows.map(lambda value: value[finite])
    if not len(rows):
        raise InputError(f"there are no Gaussians to write to {path}")
    far = np.abs(frame.center).max() * np.finfo(np.float32).eps / 2 > POSITION_ERROR * frame.scale
    values = {name: value.flatten(1).numpy() for name, value in _columns(rows)}
    values["means"] = frame.restore_points(values["means"])
    values["scales"] = values["scales"] + math.log(frame.scale)

    names = ply_properties(rows.shN.shape[1])
    table = np.zeros(len(rows), dtype=[(name, "<f8" if far and name in ("x", "y", "z") else "<f4") for name in names])
    for parameter, columns in _property_groups(rows.shN.shape[1]).items():
        for column, name in enumerate(columns):
            table[name] = values[parameter][:, column]
    types = {"<f4": "float", "<f8": "double"}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property {types[table.dtype[name].str]} {name}" for name in names]

    def write(file: BinaryIO) -> None:
        file.write("\n".join([*header, "end_header\n"]).encode())
        file.write(table.tobytes())

    try:
        write_atomically(path, write)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"cannot write {path}: {reason}; choose another place or make room") from error


def load_ply(path: str | Path, frame: Frame | None = None) -> Gaussians:
    """Read a model from a .ply with the properties of 3DGS; others are ignored.

    Args:
        path: the file.
        frame: where given, the model is brought from the capture's own coordinates into this frame.

    Returns:
        float32, on the CPU.

    Raises:
        InputError: a file that is not such a .ply, lacks a property, or has values that are not finite.
    """
    vertices = read_vertices(path)
    frame = frame or Frame(np.zeros(3), 1.0)
    names = set(vertices.dtype.names)
    rest = sum(name.startswith("f_rest_") for name in names)
    bands = {3 * ((degree + 1) ** 2 - 1): (degree + 1) ** 2 - 1 for degree in range(LARGEST_SH_DEGREE + 1)}
    if rest not in bands:
        raise InputError(f"{path} has {rest} properties f_rest_*: spherical harmonics have one of {sorted(bands)}")
    groups = _property_groups(bands[rest])
    missing = [name for group in groups.values() for name in group if name not in names]
    if missing:
        raise InputError(f"{path} is not a 3DGS model: it lacks the properties {', '.join(missing[:4])}")
    if not len(vertices):
        raise InputError(f"{path} holds no Gaussians")
    values = {
        parameter: np.stack([vertices[name].astype(np.float64) for name in group], axis=1)
        if group
        else np.zeros((len(vertices), 0))
        for parameter, group in groups.items()
    }
    values["means"] = frame.normalise_points(values["means"])
    values["scales"] = values["scales"] - math.log(frame.scale)
    with np.errstate(over="ignore"):
        tensors = {parameter: torch.from_numpy(value.astype(np.float32)) for parameter, value in values.items()}
    bad = ~torch.cat(list(tensors.values()), dim=1).isfinite().all(dim=1)
    if bad.any():
        raise InputError(f"{path}: {int(bad.sum())} of {len(bad)} Gaussians are not finite")
    return Gaussians(
        means=tensors["means"],
        quats=tensors["quats"],
        scales=tensors["scales"],
        opacities=tensors["opacities"][:, 0],
        sh0=tensors["sh0"][:, None, :],
        shN=tensors["shN"].view(len(vertices), 3, bands[rest]).transpose(1, 2).contiguous(),
    )


def ply_properties(bands: int) -> list[str]:
    """Names and order of the properties in the original 3DGS's files; `bands`: rows of `Gaussians.shN`."""
    groups = _property_groups(bands)
    order = ("means", "normals", "sh0", "shN", "opacities", "scales", "quats")
    groups["normals"] = ["nx", "ny", "nz"]
    return [name for group in order for name in groups[group]]


def _property_groups(bands: int) -> dict[str, list[str]]:
    """Parameter -> the properties that hold it; those of shN run over the bands of red, then green, then blue."""
    return {
        "means": ["x", "y", "z"],
        "sh0": [f"f_dc_{i}" for i in range(3)],
        "shN": [f"f_rest_{i}" for i in range(3 * bands)],
        "opacities": ["opacity"],
        "scales": [f"scale_{i}" for i in range(3)],
        "quats": [f"rot_{i}" for i in range(4)],
    }


def _columns(gaussians: Gaussians) -> list[tuple[str, Tensor]]:
    """(parameter, [N, ...]) whose last dimensions, flattened, are in the order of `_property_groups`."""
    return [
        ("means", gaussians.means),
        ("sh0", gaussians.sh0),
        ("shN", gaussians.shN.transpose(1, 2)),
        ("opacities", gaussians.opacities[:, None]),
        ("scales", gaussians.scales),
        ("quats", gaussians.quats),
    ]
