"""Stiff and extreme Gaussians, cameras and images: finite outputs and gradients, and the stated behaviour."""

import pytest
import torch
from helpers.rendering_scenes import make_cameras, make_gaussians

from turbogs_plugin.engine.render import dense_samples, rasterize
from turbogs_plugin.types import Gaussians, GaussianStats

NAN, INFINITY = float("nan"), float("inf")


def render_and_check(gaussians: Gaussians, cameras):
    """Render and go back with every gradient and statistic; all finite."""
    samples = dense_samples(cameras)
    rendered = rasterize(gaussians, cameras, samples, with_depth=True)
    stats = GaussianStats.zeros(len(gaussians), "cpu")
    ones = torch.ones_like(rendered.alphas)
    screen = rendered.backward(
        torch.ones_like(rendered.colors), ones, with_statistics=True, alpha_gradients=ones, depth_gradients=ones
    )
    gradients = screen.parameter_gradients(rows=True, stats=stats)
    for value in (rendered.colors, rendered.alphas, rendered.depths, *vars(gradients).values(), *vars(stats).values()):
        assert value.isfinite().all()
    assert (rendered.alphas >= 0).all() and (rendered.alphas <= 1 + 1e-6).all()
    return rendered, gradients


def scene(count: int = 20, dtype=torch.float32) -> Gaussians:
    return make_gaussians(count, dtype=dtype)


HUGE, TINY = 20.0, -20.0  # logarithms of scales
CHANGES = {  # parameter -> values that replace the scene's, or a factor of them
    "needles": {"scales": torch.tensor([3.0, -10.8, -10.8])},
    "huge": {"scales": torch.tensor(HUGE)},
    "tiny": {"scales": torch.tensor(TINY)},
    "mixed scales": {"scales": torch.tensor([HUGE, TINY, 0.0])},
    "overflowing scales": {"scales": torch.tensor([[200.0], [-200.0]]).repeat(10, 1)},
    "zero quaternions": {"quats": 0.0},
    "tiny quaternions": {"quats": 1e-20},
    "huge quaternions": {"quats": 1e20},
    "opaque": {"opacities": torch.tensor(50.0)},
    "transparent": {"opacities": torch.tensor(-50.0)},
    "far away": {"means": 1e6},
    "far colors": {"sh0": 1e6, "shN": 1e6},
}
NOTHING_DRAWN = ("transparent", "huge", "mixed scales")  # too faint, or beyond SPAN_MAX
DRAWN = ("needles", "tiny", "opaque", "zero quaternions", "tiny quaternions", "huge quaternions")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("case", CHANGES)
def test_extreme_parameters_stay_finite(case, dtype):
    gaussians = scene(dtype=dtype)
    for name, change in CHANGES[case].items():
        value = getattr(gaussians, name)
        value[:] = change if isinstance(change, torch.Tensor) else value * change
    rendered, gradients = render_and_check(gaussians, make_cameras([(37, 29), (20, 50)], dtype))
    if case in NOTHING_DRAWN:
        assert float(rendered.alphas.max()) == 0 and not gradients.touched.any()
    if case in DRAWN:
        assert gradients.touched.any()


@pytest.mark.parametrize("offset", [0.0, -1.0, 1e-3, 0.0100001, 1e-30], ids=lambda value: f"z={value}")
def test_gaussians_at_and_behind_the_camera(offset):
    gaussians, cameras = scene(), make_cameras([(32, 32)], torch.float32)
    direction = cameras.directions[0]
    gaussians.means[::2] = cameras.centers[0] + offset * direction
    _, gradients = render_and_check(gaussians, cameras)
    if offset < 0.01:
        assert not gradients.touched[::2].any()


@pytest.mark.parametrize(
    ("name", "value"),
    [(name, value) for name in ("means", "quats", "scales", "sh0", "shN") for value in (NAN, INFINITY, -INFINITY)]
    + [("opacities", NAN), ("opacities", -INFINITY)],
)
def test_one_broken_gaussian_leaves_the_others_untouched(name, value):
    gaussians, cameras = scene(), make_cameras([(32, 32)], torch.float32)
    expected = rasterize(gaussians.map(lambda tensor: tensor[1:]), cameras, dense_samples(cameras))
    getattr(gaussians, name)[0].fill_(value)
    rendered, gradients = render_and_check(gaussians, cameras)
    torch.testing.assert_close(rendered.colors, expected.colors)
    assert not gradients.touched[0]


@pytest.mark.parametrize("count", [0, 1])
@pytest.mark.parametrize("size", [(1, 1), (3, 2), (17, 33), (2000, 1)])
def test_few_gaussians_and_odd_images(count, size):
    gaussians, cameras = scene(count), make_cameras([size], torch.float32)
    gaussians.means[:] = 0.0
    gaussians.opacities[:] = 2.0
    rendered, gradients = render_and_check(gaussians, cameras)
    assert len(rendered.colors) == size[0] * size[1]
    assert bool((rendered.alphas > 0).any()) == (count == 1)
    assert gradients.means.shape == (1, count, 3)


def test_equal_depths_render_the_same_every_time_and_in_order():
    """All at one place: the first listed is in front."""
    cameras = make_cameras([(16, 16)], torch.float32)
    gaussians = scene(30)
    for name in ("means", "quats", "scales", "opacities"):
        getattr(gaussians, name)[:] = getattr(gaussians, name)[:1].clone()
    gaussians.means[:], gaussians.opacities[:], gaussians.shN[:] = 0.0, 3.0, 0.0
    gaussians.sh0[:] = -10.0
    gaussians.sh0[0] = 5.0
    samples = dense_samples(cameras)
    first = rasterize(gaussians, cameras, samples)
    again = rasterize(gaussians, cameras, samples)
    assert torch.equal(first.colors, again.colors)
    assert float(first.colors.max()) > 0.8
    behind = gaussians.map(lambda value: value.flip(0))
    assert float(rasterize(behind, cameras, samples).colors.max()) < 0.1
