"""Models to and from gsplat's .pt."""

import numpy as np
import pytest
import torch
from helpers.models import random_gaussians
from helpers.refusals import assert_refused

from turbogs_plugin.model.ply import OWN
from turbogs_plugin.model.similarity import Similarity, placed
from turbogs_plugin.model.torch_file import read_gsplat, save_gsplat
from turbogs_plugin.scene import Frame


@pytest.mark.parametrize("sh_degree", [0, 2, 3])
def test_what_is_written_is_what_gsplat_loads(tmp_path, sh_degree):
    """The keys, shapes and types that `simple_trainer.py --ckpt` copies into its own parameters."""
    gaussians, frame = random_gaussians(sh_degree=sh_degree), Frame(np.array([0.1, -0.2, 3.0]), 6.0)
    save_gsplat(gaussians, tmp_path / "model.pt", frame, step=7)
    state = torch.load(tmp_path / "model.pt", weights_only=True)
    assert state["step"] == 7 and set(state) == {"step", "splats"}
    shapes = {"means": (40, 3), "quats": (40, 4), "scales": (40, 3), "opacities": (40,), "sh0": (40, 1, 3)}
    shapes["shN"] = (40, (sh_degree + 1) ** 2 - 1, 3)
    assert {name: tuple(value.shape) for name, value in state["splats"].items()} == shapes
    assert all(value.dtype == torch.float32 for value in state["splats"].values())
    torch.testing.assert_close(state["splats"]["means"], gaussians.means * 6 + torch.tensor([0.1, -0.2, 3.0]))
    torch.testing.assert_close(state["splats"]["scales"].exp(), gaussians.scales.exp() * 6)
    back = placed(read_gsplat(state, "model.pt"), Similarity.into(frame), "model.pt")
    for (name, value), (_, read) in zip(gaussians.items(), back.items(), strict=True):
        torch.testing.assert_close(read, value, msg=name)


def test_what_cannot_be_written_is_refused(tmp_path):
    assert_refused("none of its 0 Gaussians", save_gsplat, random_gaussians(0), tmp_path / "model.pt", OWN)
    with pytest.raises(OSError, match="absent"):
        save_gsplat(random_gaussians(), tmp_path / "absent" / "model.pt", OWN)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"shN": torch.zeros(40, 24, 3)}, "shN has 24 bands: .* 0, 3, 8 or 15"),
        ({"shN": None}, "its splats lack shN"),
        ({"sh0": None, "shN": None, "features": torch.zeros(40, 32)}, "appearance network"),
        ({"quats": torch.zeros(39, 4)}, r"quats is float32 \(39, 4\) where gsplat has float32 \(40, 4\)"),
        ({"opacities": torch.zeros(40, dtype=torch.int64)}, r"opacities is int64 \(40,\)"),
        ({"means": torch.tensor(1.0)}, r"means is float32 \(\)"),
        (dict(random_gaussians(0).items()), "holds 0 Gaussians"),
        (None, "lack means"),
    ],
)
def test_splats_that_are_no_model(changes, words):
    splats = [1] if changes is None else {**dict(random_gaussians().items()), **changes}
    if changes:
        splats = {name: value for name, value in splats.items() if value is not None}
    assert_refused(words, read_gsplat, {"splats": splats}, "model.pt")
