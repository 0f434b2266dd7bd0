"""Models for scenes and for the web, by `formats.Write`: glTF with KHR_gaussian_splatting, OpenUSD's
ParticleField3DGaussianSplat (of version 26.03), and antimatter15's ``.splat``.

glTF and OpenUSD have all numbers in float32, as trained; axes are x right, y up, z backward. A ``.splat`` has 32 bytes
a Gaussian, one colour each, the most visible first, in the capture's own axes.
"""

from __future__ import annotations

import itertools
import json
import math
import struct
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from turbogs_plugin.errors import InputError
from turbogs_plugin.files import write_atomically, write_text_atomically
from turbogs_plugin.model.similarity import in_capture, upright
from turbogs_plugin.scene.frame import Frame
from turbogs_plugin.types import SH_C0, Gaussians

GLTF = "KHR_gaussian_splatting"
FLOAT, VERTICES, POINTS, TYPES = 5126, 34962, 0, {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
"""glTF's numbers for float32, for a buffer of vertices, and for primitives that are points; its vectors."""
LARGEST_GLB = 2**32 - 1
ROWS_AT_ONCE = 10_000
"""Rows of numbers that become text at a time."""
SPLAT = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("colors", "u1", 4), ("quats", "u1", 4)])


def save_glb(gaussians: Gaussians, path: Path, frame: Frame, step: int = 0, antialiased: bool = False) -> None:
    """Write a binary glTF: points that readers of the extension draw as Gaussians. `InputError` for more than 4 GB."""
    model = upright(in_capture(gaussians, frame, path))
    color = (SH_C0 * model.sh0[:, 0] + 0.5).clamp(0.0, 1.0)
    linear = torch.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)  # as glTF has COLOR_0
    opacities = torch.sigmoid(model.opacities)[:, None]
    columns = {
        "POSITION": model.means,
        "COLOR_0": torch.cat([linear, opacities], dim=1),
        f"{GLTF}:ROTATION": normalize(model.quats, dim=1)[:, [1, 2, 3, 0]],
        f"{GLTF}:SCALE": model.scales.exp(),
        f"{GLTF}:OPACITY": opacities,
    }
    for band, column in enumerate(torch.cat([model.sh0, model.shN], dim=1).unbind(dim=1)):
        degree = math.isqrt(band)
        columns[f"{GLTF}:SH_DEGREE_{degree}_COEF_{band - degree**2}"] = column
    parts = [column.numpy().astype("<f4").tobytes() for column in columns.values()]
    starts = [0, *itertools.accumulate(map(len, parts))]
    ends = {"min": model.means.amin(dim=0).tolist(), "max": model.means.amax(dim=0).tolist()}
    primitive = {
        "attributes": {name: place for place, name in enumerate(columns)},
        "mode": POINTS,
        "extensions": {GLTF: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    content = {
        "asset": {"version": "2.0", "generator": "TurboGS"},
        "extensionsUsed": [GLTF],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": starts[-1]}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": len(part), "target": VERTICES}
            for start, part in zip(starts, parts, strict=False)
        ],
        "accessors": [
            {"bufferView": place, "componentType": FLOAT, "count": len(model), "type": TYPES[column.shape[1]]}
            | ({} if place else ends)
            for place, column in enumerate(columns.values())
        ],
    }
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + starts[-1]
    if size > LARGEST_GLB:
        raise InputError(f"{path} would have {size} bytes, more than a .glb can: export fewer by --max-gaussians")
    head = struct.pack("<4sIII4s", b"glTF", 2, size, len(text), b"JSON"), text, struct.pack("<I4s", starts[-1], b"BIN")
    write_atomically(path, lambda file: file.writelines([*head, *parts]))


def save_usda(gaussians: Gaussians, path: Path, frame: Frame, step: int = 0, antialiased: bool = False) -> None:
    """Write OpenUSD's text."""
    model = upright(in_capture(gaussians, frame, path))
    scales = model.scales.exp()
    reach = 3.0 * scales.amax(dim=1, keepdim=True)
    attributes = {
        "float3[] extent": torch.stack([(model.means - reach).amin(dim=0), (model.means + reach).amax(dim=0)]),
        "point3f[] positions": model.means,
        "quatf[] orientations": normalize(model.quats, dim=1),
        "float3[] scales": scales,
        "float[] opacities": torch.sigmoid(model.opacities),
        "float3[] radiance:sphericalHarmonicsCoefficients": torch.cat([model.sh0, model.shN], dim=1).flatten(0, 1),
    }
    lines = [
        '#usda 1.0\n(\n    defaultPrim = "Model"\n    metersPerUnit = 1\n    upAxis = "Y"\n)\n',
        'def Xform "Model"\n{\n    def ParticleField3DGaussianSplat "Gaussians"\n    {',
        *(f"        {name} = [{_tuples(values)}]" for name, values in attributes.items()),
        f"        uniform int radiance:sphericalHarmonicsDegree = {model.sh_degree}\n    }}\n}}\n",
    ]
    write_text_atomically(path, "\n".join(lines))


def _tuples(values: Tensor) -> str:
    """Numbers [N], or tuples of numbers [N, D], with nine digits, which give back every float32."""
    item = "%.9g" if values.dim() == 1 else f"({', '.join(['%.9g'] * values.shape[1])})"
    parts = values.split(ROWS_AT_ONCE)
    return ", ".join(", ".join([item] * len(part)) % tuple(part.flatten().tolist()) for part in parts)


def save_splat(gaussians: Gaussians, path: Path, frame: Frame, step: int = 0, antialiased: bool = False) -> None:
    """Write a ``.splat``, without the higher bands."""
    model = in_capture(gaussians, frame, path)
    opacities = torch.sigmoid(model.opacities)
    table = np.zeros(len(model), SPLAT)
    table["means"], table["scales"] = model.means.numpy(), model.scales.exp().numpy()
    table["colors"] = _bytes(torch.cat([SH_C0 * model.sh0[:, 0] + 0.5, opacities[:, None]], dim=1) * 255.0)
    table["quats"] = _bytes(normalize(model.quats, dim=1) * 128.0 + 128.0)
    order = torch.argsort(model.scales.sum(dim=1) + opacities.log(), descending=True, stable=True)
    write_atomically(path, lambda file: file.write(table[order.numpy()].tobytes()))


def read_splat(path: Path) -> tuple[Gaussians, bool]:
    """What `save_splat` wrote (`formats.Read`), on the CPU."""
    table = np.fromfile(path, SPLAT)
    means, scales, colors, quats = (torch.from_numpy(table[name].astype(np.float64)) for name in SPLAT.names or ())
    sh0 = (colors[:, None, :3] / 255.0 - 0.5) / SH_C0
    opacities = torch.logit((colors[:, 3] / 255.0).clamp(1e-4, 0.9999))
    return Gaussians(means, quats - 128.0, scales.log(), opacities, sh0, means.new_zeros(len(means), 0, 3)), False


def _bytes(values: Tensor) -> np.ndarray:
    return values.round().clamp(0, 255).to(torch.uint8).numpy()
