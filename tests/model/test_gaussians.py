"""Gaussians from points, and to and from .ply."""

import math

import numpy as np
import pytest
import torch
from gsplat import export_splats

from turbogs_plugin.engine.rendering import render_images
from turbogs_plugin.errors import InputError
from turbogs_plugin.model.gaussians import (
    BACKDROP_RADIUS,
    DISTANT,
    SH_C0,
    backdrop_gaussians,
    gaussians_from_points,
    load_ply,
    restrain_distant,
    save_ply,
)
from turbogs_plugin.scene import Frame
from turbogs_plugin.scene.nearest import mean_neighbor_distances
from turbogs_plugin.scene.ply import read_vertices
from turbogs_plugin.types import Cameras, Gaussians


def random_gaussians(count: int = 40, sh_degree: int = 3) -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    bands = (sh_degree + 1) ** 2 - 1
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": (bands, 3)}
    return Gaussians(**{name: torch.randn((count, *shape), generator=generator) for name, shape in shapes.items()})


CLOUDS = {
    "uniform": lambda random: random.uniform(-1, 1, (1500, 3)),
    "heavy tails": lambda random: random.normal(size=(1500, 3)) ** 5,
    "a plane": lambda random: random.uniform(-1, 1, (1500, 3)) * [1, 1, 0],
    "clusters": lambda random: random.integers(0, 5, (1500, 1)) * 100 + random.normal(size=(1500, 3)) * 1e-2,
    "coincident": lambda random: np.repeat(random.normal(size=(300, 3)), 5, axis=0),
    "two": lambda random: random.normal(size=(2, 3)),
    "three": lambda random: random.normal(size=(3, 3)),
}


@pytest.mark.parametrize("cloud", CLOUDS)
def test_neighbor_distances_are_exact(cloud):
    points = CLOUDS[cloud](np.random.default_rng(0))
    distances = np.linalg.norm(points[:, None] - points[None], axis=-1)
    np.fill_diagonal(distances, np.inf)
    neighbors = min(3, len(points) - 1)
    expected = np.sort(distances, axis=1)[:, :neighbors].mean(axis=1)
    np.testing.assert_allclose(mean_neighbor_distances(torch.from_numpy(points), 3), expected, rtol=1e-12, atol=1e-14)


def test_initial_gaussians():
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
    colors = torch.tensor([[255, 0, 51]] * 4, dtype=torch.uint8)
    gaussians = gaussians_from_points(points, colors, sh_degree=2, extent=1.0)
    assert torch.equal(gaussians.means, points)
    assert gaussians.scales[0].exp().tolist() == pytest.approx([2.0] * 3)
    assert gaussians.scales[1].exp().tolist() == pytest.approx([(1 + 5**0.5 + 10**0.5) / 3] * 3)
    assert gaussians.opacities.sigmoid().tolist() == pytest.approx([0.1] * 4)
    assert gaussians.quats.tolist() == [[1, 0, 0, 0]] * 4
    color = gaussians.sh0[0, 0] * 0.5 / math.sqrt(math.pi) + 0.5
    assert color.tolist() == pytest.approx([1, 0.5 / 255, 0.2], abs=1e-6)
    assert gaussians.shN.shape == (4, 8, 3) and not gaussians.shN.any()
    assert all(value.dtype == torch.float32 for _, value in gaussians.items())


def test_other_starts():
    """gsplat's MCMC preset begins with opacities of 0.5 and a tenth of the scales."""
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(1))
    colors = torch.zeros(50, 3, dtype=torch.uint8)
    plain = gaussians_from_points(points, colors, 1, 1.0)
    small = gaussians_from_points(points, colors, 1, 1.0, opacity=0.5, size=0.1)
    torch.testing.assert_close(small.scales, plain.scales - math.log(10))
    torch.testing.assert_close(torch.sigmoid(small.opacities), torch.full((50,), 0.5))


def test_coincident_and_lonely_points_get_a_scale():
    colors = torch.zeros(5, 3, dtype=torch.uint8)
    same = gaussians_from_points(torch.ones(5, 3), colors, sh_degree=0, extent=2.0)
    assert same.scales.exp().flatten().tolist() == pytest.approx([2e-4] * 15)
    one = gaussians_from_points(torch.ones(1, 3), colors[:1], sh_degree=0, extent=2.0)
    assert one.scales.exp().flatten().tolist() == pytest.approx([0.02] * 3)
    assert one.shN.shape == (1, 0, 3)


def test_points_that_are_not_finite_are_left_out_and_counted():
    points = torch.rand(6, 3)
    points[1, 2], points[4, 0] = torch.nan, torch.inf
    colors = torch.arange(18, dtype=torch.uint8).view(6, 3)
    with pytest.warns(UserWarning, match="2 of 6 points are not finite"):
        gaussians = gaussians_from_points(points, colors, sh_degree=0, extent=1.0)
    assert torch.equal(gaussians.means, points[[0, 2, 3, 5]])
    expected = gaussians_from_points(points[[0, 2, 3, 5]], colors[[0, 2, 3, 5]], sh_degree=0, extent=1.0)
    assert torch.equal(gaussians.sh0, expected.sh0) and torch.equal(gaussians.scales, expected.scales)


@pytest.mark.parametrize(
    ("points", "sh_degree", "extent", "words"),
    [
        (torch.zeros(0, 3), 3, 1.0, "no points"),
        (torch.zeros(2, 3), 5, 1.0, "sh_degree is 5"),
        (torch.zeros(2, 3), 3, 0.0, "extent is 0"),
        (torch.zeros(2, 3), 3, math.nan, "extent is nan"),
    ],
)
def test_bad_arguments(points, sh_degree, extent, words):
    with pytest.raises(InputError, match=words):
        gaussians_from_points(points, torch.zeros_like(points, dtype=torch.uint8), sh_degree, extent)


@pytest.mark.parametrize("sh_degree", [0, 1, 3])
def test_ply_round_trip_is_exact(tmp_path, sh_degree):
    gaussians = random_gaussians(sh_degree=sh_degree)
    save_ply(gaussians, tmp_path / "model.ply")
    loaded = load_ply(tmp_path / "model.ply")
    assert loaded.sh_degree == sh_degree
    for (name, value), (_, back) in zip(gaussians.items(), loaded.items(), strict=True):
        assert torch.equal(value, back), name
    assert [path.name for path in tmp_path.iterdir()] == ["model.ply"]


def test_ply_has_the_properties_of_3dgs_in_its_order(tmp_path):
    save_ply(random_gaussians(), tmp_path / "model.ply")
    header = (tmp_path / "model.ply").read_bytes().split(b"end_header\n")[0].decode().splitlines()
    assert header[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 40"]
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45))]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    assert header[3:] == [f"property float {name}" for name in names]


def test_ply_agrees_with_gsplat(tmp_path):
    gaussians = random_gaussians()
    save_ply(gaussians, tmp_path / "ours.ply")
    export_splats(**dict(gaussians.items()), save_to=str(tmp_path / "theirs.ply"))
    ours, theirs = read_vertices(tmp_path / "ours.ply"), read_vertices(tmp_path / "theirs.ply")
    assert set(ours.dtype.names) == set(theirs.dtype.names) | {"nx", "ny", "nz"}
    for name in theirs.dtype.names:
        np.testing.assert_array_equal(ours[name], theirs[name])
    for (_, value), (_, back) in zip(gaussians.items(), load_ply(tmp_path / "theirs.ply").items(), strict=True):
        assert torch.equal(value, back)


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


def test_gaussians_that_are_not_finite_are_not_written(tmp_path):
    gaussians = random_gaussians()
    gaussians.means[3, 0], gaussians.shN[5, 2, 1], gaussians.opacities[7] = torch.nan, torch.inf, torch.nan
    with pytest.warns(UserWarning, match="3 of 40 Gaussians are not finite"):
        save_ply(gaussians, tmp_path / "model.ply")
    keep = [i for i in range(40) if i not in (3, 5, 7)]
    assert torch.equal(load_ply(tmp_path / "model.ply").means, gaussians.means[keep])


def test_nothing_is_written_over_by_a_failure(tmp_path):
    path = tmp_path / "model.ply"
    save_ply(random_gaussians(), path)
    before = path.read_bytes()
    with pytest.raises(InputError, match="no Gaussians"):
        save_ply(random_gaussians(0), path)
    assert path.read_bytes() == before
    with pytest.raises(InputError, match=r"cannot write .*absent"):
        save_ply(random_gaussians(), tmp_path / "absent" / "model.ply")


def test_load_refuses_what_is_not_finite_or_not_there(tmp_path):
    save_ply(random_gaussians(), tmp_path / "model.ply")
    content = bytearray((tmp_path / "model.ply").read_bytes())
    content[-4:] = np.float32(np.nan).tobytes()
    (tmp_path / "model.ply").write_bytes(content)
    with pytest.raises(InputError, match="1 of 40 Gaussians are not finite"):
        load_ply(tmp_path / "model.ply")
    with pytest.raises(InputError, match=r"cannot read .*absent\.ply"):
        load_ply(tmp_path / "absent.ply")


def test_a_backdrop_surrounds_everything_in_its_colour():
    backdrop = backdrop_gaussians(torch.tensor([0.2, 0.4, 0.6]), sh_degree=2, extent=3.0)
    assert torch.allclose(backdrop.means.norm(dim=1), torch.tensor(BACKDROP_RADIUS * 3.0))
    colors = backdrop.sh0[:, 0] * SH_C0 + 0.5
    assert torch.allclose(colors, torch.tensor([51.0, 102.0, 153.0]) / 255.0, atol=1e-6)
    assert backdrop.shN.shape[1] == 8
    directions = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    # Whatever the direction, the nearest Gaussian's centre is within one standard deviation.
    nearest = torch.cdist(directions * BACKDROP_RADIUS * 3.0, backdrop.means).amin(dim=1)
    assert (nearest < backdrop.scales.exp().amin()).all()


def test_distant_gaussians_are_restrained_and_the_scene_is_not():
    gaussians = random_gaussians(60)
    gaussians.means *= torch.linspace(0.1, 30.0, 60)[:, None]
    gaussians.scales += 3.0
    before = gaussians.scales.clone()
    restrain_distant(gaussians, extent=2.0, size=0.3)
    distances = gaussians.means.norm(dim=1, keepdim=True)
    limits = torch.where(distances > DISTANT * 2.0, (0.3 * (distances - 2.0)).log(), torch.inf)
    assert torch.equal(gaussians.scales, torch.minimum(before, limits))
    assert 0 < (before > gaussians.scales).sum() < before.numel()
    assert (distances < DISTANT * 2.0).any()


@pytest.mark.parametrize("depth", [0.05, 0.6, 2.0])
def test_what_lies_beside_a_camera_covers_none_of_its_view(depth):
    """As it did on caliterra: deviations of 32 and 45 at a distance of 25, 0.6 in front of the camera's plane."""
    gaussians = random_gaussians(1, sh_degree=0)
    gaussians.means[0], gaussians.quats[0] = torch.tensor([25.0, 0.0, depth]), torch.tensor([1.0, 0.0, 0.0, 0.0])
    gaussians.scales[0], gaussians.opacities[0] = torch.tensor([45.0, 32.0, 0.4]).log(), 10.0
    camera = Cameras(torch.eye(4)[None], torch.tensor([[[80.0, 0, 48], [0, 80, 32], [0, 0, 1]]]), np.array([[96, 64]]))
    assert render_images(gaussians, camera)[0][1][32, 48] > 0.8
    restrain_distant(gaussians, extent=1.0, size=0.3)
    assert render_images(gaussians, camera)[0][1][32, 48] < 0.01
