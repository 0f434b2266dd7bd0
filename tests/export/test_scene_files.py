"""glTF and OpenUSD, read back by libraries of their fields."""

import struct

import numpy as np
import pytest
import torch
from helpers.models import random_gaussians

from turbogs_plugin.engine.reference.projection import rotation_matrices
from turbogs_plugin.engine.reference.spherical_harmonics import evaluate
from turbogs_plugin.export.scene_files import save_glb, save_splat, save_usda
from turbogs_plugin.scene import Frame
from turbogs_plugin.types import Gaussians

FRAME = Frame(np.array([3.0, -2.0, 5.0]), 2.5)
AXES = torch.diag(torch.tensor([1.0, -1.0, -1.0]))


def assert_alike(made: Gaussians, means, quats, scales, opacities, harmonics) -> None:
    """Numpy arrays of a file (y up, z backward; wxyz, linear scales and opacities, harmonics [N, B + 1, 3]) against the
    model in the capture's coordinates."""
    means, quats, scales, opacities, harmonics = map(torch.from_numpy, (means, quats, scales, opacities, harmonics))
    own = made.means * 2.5 + torch.tensor([3.0, -2.0, 5.0])
    torch.testing.assert_close(means, own @ AXES, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(opacities, torch.sigmoid(made.opacities))
    axes = rotation_matrices(quats) * scales[:, None]
    expected = AXES @ rotation_matrices(made.quats) * (2.5 * made.scales.exp())[:, None]
    wanted = expected @ expected.mT
    torch.testing.assert_close(axes @ axes.mT, wanted, rtol=1e-4, atol=1e-4 * float(wanted.abs().max()))
    direction = torch.nn.functional.normalize(torch.tensor([[0.3, -0.8, 0.5]]), dim=1).expand(len(made), 3)
    seen = evaluate(harmonics[:, :1], harmonics[:, 1:], direction @ AXES, made.sh_degree)
    torch.testing.assert_close(seen, evaluate(made.sh0, made.shN, direction, made.sh_degree), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("degree", [0, 3])
def test_gltf(tmp_path, degree):
    pygltflib = pytest.importorskip("pygltflib")
    made = random_gaussians(40, degree)
    save_glb(made, tmp_path / "m.glb", FRAME)
    content, read = (tmp_path / "m.glb").read_bytes(), pygltflib.GLTF2().load(tmp_path / "m.glb")
    assert struct.unpack_from("<4sII", content) == (b"glTF", 2, len(content)) and len(content) % 4 == 0
    length, kind = struct.unpack_from("<I4s", content, 20 + struct.unpack_from("<I", content, 12)[0])
    assert kind == b"BIN\0" and length == read.buffers[0].byteLength == len(read.binary_blob())
    primitive = read.meshes[0].primitives[0]
    assert primitive.mode == pygltflib.POINTS and read.extensionsUsed == ["KHR_gaussian_splatting"]
    assert primitive.extensions["KHR_gaussian_splatting"]["kernel"] == "ellipse"
    columns = {}
    for name, number in vars(primitive.attributes).items():
        if number is not None:
            accessor = read.accessors[number]
            start = read.bufferViews[accessor.bufferView].byteOffset
            width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
            values = np.frombuffer(read.binary_blob(), "<f4", accessor.count * width, start).reshape(-1, width)
            columns[name.removeprefix("KHR_gaussian_splatting:")] = values.copy()
    places = [f"SH_DEGREE_{of}_COEF_{at}" for of in range(degree + 1) for at in range(2 * of + 1)]
    assert set(columns) == {"POSITION", "COLOR_0", "ROTATION", "SCALE", "OPACITY", *places}
    harmonics = np.stack([columns[place] for place in places], axis=1)
    quats = columns["ROTATION"][:, [3, 0, 1, 2]]
    assert_alike(made, columns["POSITION"], quats, columns["SCALE"], columns["OPACITY"][:, 0], harmonics)
    assert np.allclose(read.accessors[0].max, columns["POSITION"].max(axis=0)) and columns["COLOR_0"].max() <= 1


def test_splat_by_hand(tmp_path):
    """One Gaussian after a larger one, byte by byte."""
    made = random_gaussians(2, 1)
    made.means[1], made.scales[:], made.opacities[1] = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([[2.0], [0.0]]), 0.0
    made.quats[1], made.sh0[1, 0] = torch.tensor([2.0, 0.0, -2.0, 0.0]), torch.tensor([0.0, 20.0, -20.0])
    save_splat(made, tmp_path / "m.splat", Frame(np.zeros(3), 1.0))
    content = (tmp_path / "m.splat").read_bytes()
    assert len(content) == 64 and np.frombuffer(content, "<f4", 6, 32).tolist() == [1, 2, 3, 1, 1, 1]
    assert list(content[56:]) == [128, 255, 0, 128, 219, 128, 37, 128]


@pytest.mark.parametrize("degree", [0, 3])
def test_openusd(tmp_path, degree):
    usd, vol = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdVol")
    made = random_gaussians(40, degree)
    save_usda(made, tmp_path / "m.usda", FRAME)
    stage = usd.Stage.Open(str(tmp_path / "m.usda"))
    prim = vol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/Model/Gaussians"))
    assert prim and stage.GetDefaultPrim().GetName() == "Model"
    found = {each.GetName(): each.Get() for each in prim.GetPrim().GetAttributes()}
    assert found["radiance:sphericalHarmonicsDegree"] == degree
    harmonics = np.array(found["radiance:sphericalHarmonicsCoefficients"]).reshape(40, (degree + 1) ** 2, 3)
    quats = np.array([(each.GetReal(), *each.GetImaginary()) for each in found["orientations"]], dtype=np.float32)
    numbers = (np.array(found[name]) for name in ("scales", "opacities"))
    assert_alike(made, np.array(found["positions"]), quats, *numbers, harmonics)
