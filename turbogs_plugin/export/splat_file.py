"""``.splat``, the format of antimatter15's viewer: 32 bytes a Gaussian, one colour each, the most visible first."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from turbogs_plugin.files import write_atomically
from turbogs_plugin.model.similarity import in_capture
from turbogs_plugin.scene.frame import Frame
from turbogs_plugin.types import SH_C0, Gaussians

ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("colors", "u1", 4), ("quats", "u1", 4)])


def save_splat(gaussians: Gaussians, path: Path, frame: Frame) -> None:
    """Write a model without its higher bands, whole or not at all. Arguments and errors as of `in_capture`."""
    model = in_capture(gaussians, frame, path)
    opacities = torch.sigmoid(model.opacities)
    colors = torch.cat([SH_C0 * model.sh0[:, 0] + 0.5, opacities[:, None]], dim=1) * 255.0
    table = np.zeros(len(model), ROW)
    table["means"], table["scales"] = model.means.numpy(), model.scales.exp().numpy()
    table["colors"] = colors.round().clamp(0, 255).numpy()
    table["quats"] = (torch.nn.functional.normalize(model.quats, dim=1) * 128.0 + 128.0).round().clamp(0, 255).numpy()
    order = torch.argsort(model.scales.sum(dim=1) + opacities.log(), descending=True, stable=True)
    write_atomically(path, lambda file: file.write(table[order.numpy()].tobytes()))


def read_splat(path: Path) -> Gaussians:
    """What `save_splat` wrote; float64, on the CPU."""
    table = {name: torch.from_numpy(np.fromfile(path, ROW)[name].astype(np.float64)) for name in ROW.names or ()}
    colors = table["colors"] / 255.0
    return Gaussians(
        means=table["means"],
        quats=table["quats"] - 128.0,
        scales=table["scales"].log(),
        opacities=torch.logit(colors[:, 3].clamp(1e-4, 1.0 - 1e-4)),
        sh0=((colors[:, :3] - 0.5) / SH_C0)[:, None],
        shN=torch.zeros(len(colors), 0, 3, dtype=torch.float64),
    )
