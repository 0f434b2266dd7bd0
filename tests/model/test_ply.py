"""Models to and from .ply."""

from pathlib import Path

import numpy as np
import pytest
import torch
from gsplat import export_splats
from helpers.models import random_gaussians
from helpers.refusals import assert_refused

from turbogs_plugin.errors import InputError
from turbogs_plugin.model.ply import load_ply, read_ply, save_ply
from turbogs_plugin.scene import Frame
from turbogs_plugin.scene.ply import read_vertices


@pytest.mark.parametrize("sh_degree", [0, 1, 3])
def test_ply_round_trip_is_exact(tmp_path, sh_degree):
    """The header has the properties of 3DGS in its order."""
    gaussians = random_gaussians(sh_degree=sh_degree)
    save_ply(gaussians, tmp_path / "model.ply")
    loaded = load_ply(tmp_path / "model.ply")
    assert loaded.sh_degree == sh_degree
    assert all(torch.equal(value, getattr(loaded, name)) for name, value in gaussians.items())
    header = (tmp_path / "model.ply").read_bytes().split(b"end_header\n")[0].decode().splitlines()
    mode, bands = "comment SplatRenderMode: default", range(3 * (sh_degree + 1) ** 2 - 3)
    assert header[:4] == ["ply", "format binary_little_endian 1.0", mode, "element vertex 40"]
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in bands)]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    assert header[4:] == [f"property float {name}" for name in names]


def test_ply_agrees_with_gsplat(tmp_path):
    gaussians = random_gaussians()
    save_ply(gaussians, tmp_path / "ours.ply")
    export_splats(**dict(gaussians.items()), save_to=str(tmp_path / "theirs.ply"))
    ours, theirs = read_vertices(tmp_path / "ours.ply"), read_vertices(tmp_path / "theirs.ply")
    assert set(ours) == set(theirs) | {"nx", "ny", "nz"}
    for name in theirs:
        np.testing.assert_array_equal(ours[name], theirs[name])


@pytest.mark.parametrize(
    ("center", "scale", "position_type"), [((0.1, -0.2, 3.0), 6.0, "<f4"), ((5e5, -4e6, 120.0), 80.0, "<f8")]
)
def test_exports_return_to_the_capture_frame(tmp_path, center, scale, position_type):
    """Positions within 1e-6 of the extent (plus a float's own rounding near the origin), scales times the unit."""
    gaussians, frame = random_gaussians(), Frame(np.array(center), scale)
    save_ply(gaussians, tmp_path / "model.ply", frame)
    vertices = read_vertices(tmp_path / "model.ply")
    assert vertices["x"].dtype == position_type and vertices["opacity"].dtype == "<f4"
    positions = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
    expected = gaussians.means.double().numpy() * scale + np.array(center)
    assert np.abs(positions - expected).max() < 1e-6 * scale
    scales = np.stack([vertices[f"scale_{i}"] for i in range(3)], axis=1)
    np.testing.assert_allclose(np.exp(scales), gaussians.scales.exp() * scale, rtol=2e-6)
    back = load_ply(tmp_path / "model.ply", frame)
    assert (back.means - gaussians.means).abs().max() < 1e-6
    assert (back.scales - gaussians.scales).abs().max() < 2e-6
    assert torch.equal(back.quats, gaussians.quats) and torch.equal(back.shN, gaussians.shN)


def test_gaussians_that_are_not_finite_are_not_written_and_a_failure_writes_nothing(tmp_path):
    gaussians, path = random_gaussians(), tmp_path / "model.ply"
    gaussians.means[3, 0], gaussians.shN[5, 2, 1], gaussians.opacities[7] = torch.nan, torch.inf, torch.nan
    with pytest.warns(UserWarning, match="3 of 40 Gaussians are not finite"):
        save_ply(gaussians, path)
    keep = [i for i in range(40) if i not in (3, 5, 7)]
    assert torch.equal(load_ply(path).means, gaussians.means[keep])
    before = path.read_bytes()
    assert_refused("none of its 0 Gaussians", save_ply, random_gaussians(0), path)
    assert path.read_bytes() == before and [*tmp_path.iterdir()] == [path]


def test_load_leaves_out_rows_that_are_not_finite_and_refuses_a_model_without_another(tmp_path, columns):
    columns["rot_3"][1:3] = np.nan, np.inf
    with pytest.warns(UserWarning, match=r"a\.ply: 2 of 20 Gaussians are not finite and left out"):
        assert len(load_ply(written(tmp_path / "a.ply", columns))) == 18
    activated = {name: np.linspace(0.1, 0.9, 100) for name in columns}
    logits = np.linspace(-6.0, 9.0, 100)
    columns["rot_3"][:] = np.nan
    sizes = activated | {f"scale_{axis}": np.geomspace(1e-4, 2.0, 100) for axis in range(3)} | {"opacity": logits}
    for case, words in ((columns, "none of its 20 Gaussians is finite"), (activated, "logits"), (sizes, "logarithms")):
        assert_refused(words, load_ply, written(tmp_path / "a.ply", case))
    assert_refused(r"cannot read .*absent\.ply", load_ply, tmp_path / "absent.ply")


def written(path: Path, columns: dict[str, np.ndarray], comment: str = "") -> Path:
    """A .ply of float properties, with Windows' line ends and another element behind, as SHARP has."""
    head = ["ply", "format binary_little_endian 1.0", *([comment] if comment else [])]
    head += [f"element vertex {len(columns['x'])}", *(f"property float {name}" for name in columns)]
    head += ["element extrinsic 2", "property float extrinsic", "end_header", ""]
    path.write_bytes("\r\n".join(head).encode() + np.transpose([*columns.values()]).astype("<f4").tobytes() + bytes(8))
    return path


@pytest.fixture
def columns(tmp_path) -> dict[str, np.ndarray]:
    save_ply(random_gaussians(20), tmp_path / "own.ply")
    return {name: values.copy() for name, values in read_vertices(tmp_path / "own.ply").items()}


def test_infinite_opacities_and_flat_gaussians_stay(tmp_path, columns):
    columns["opacity"][:2], columns["scale_1"][2] = (np.inf, -np.inf), -np.inf
    with pytest.warns(UserWarning, match="1 Gaussians are flat"):
        read = load_ply(written(tmp_path / "a.ply", columns))
    shares = torch.sigmoid(read.opacities)
    assert len(read) == 20 and float(shares[0]) == 1.0 and float(shares[1]) < 1e-8 and float(read.scales[2, 1]) < -15


def test_a_3d_filter_is_fused(tmp_path, columns):
    """Against covariances and integrals by hand."""
    before = load_ply(tmp_path / "own.ply")
    read = load_ply(written(tmp_path / "b.ply", columns | {"filter_3D": np.full(20, 0.5)}))
    variances = (2 * before.scales).exp()
    torch.testing.assert_close((2 * read.scales).exp(), variances + 0.25)
    shares = torch.sigmoid(before.opacities) * (variances.prod(dim=1) / (variances + 0.25).prod(dim=1)).sqrt()
    torch.testing.assert_close(torch.sigmoid(read.opacities), shares)


@pytest.mark.parametrize(
    ("comment", "antialiased"),
    [
        ("comment SplatRenderMode: mip", True),
        ("comment splatrendermode:mip", True),
        ("comment antialiased 1", True),
        ("comment antialiased 0", False),
        ("comment SplatRenderMode: default", False),
        ("", False),
    ],
)
def test_a_comment_says_that_a_model_is_antialiased(tmp_path, columns, comment, antialiased):
    assert read_ply(written(tmp_path / "a.ply", columns, comment))[1] is antialiased


def test_a_model_of_2dgs_and_a_mesh_are_named(tmp_path, columns):
    del columns["scale_2"]
    with pytest.raises(InputError, match="lacks scale_2: it is a model of 2D Gaussian Splatting"):
        load_ply(written(tmp_path / "a.ply", columns))
    lines = ["ply", "format ascii 1.0", "element vertex 3", *(f"property float {axis}" for axis in "xyz")]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    (tmp_path / "mesh.ply").write_text("\n".join([*lines, "0 0 0", "1 0 0", "0 1 0", "3 0 1 2", ""]))
    assert_refused(r"mesh\.ply is not a 3DGS model: .*f_dc_0.* give the \.ply", load_ply, tmp_path / "mesh.ply")
