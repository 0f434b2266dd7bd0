"""Stiff and extreme Gaussians, cameras and images: finite outputs and gradients, and the stated behaviour."""

import pytest
import torch
from helpers.raster_extremes import render_and_check
from helpers.rendering_scenes import make_cameras, make_gaussians

from turbogs_plugin.engine.render import dense_samples, rasterize

NAN, INFINITY = float("nan"), float("inf")


@pytest.mark.parametrize("scales", [20.0, [20.0, -20.0, 0.0], None], ids=["huge", "mixed", "transparent"])
def test_what_is_too_faint_or_spans_too_much_is_not_drawn(scales):
    """What is drawn of extremes, and how exactly, is in tests/stability/test_renderer.py."""
    gaussians = make_gaussians(20, dtype=torch.float32)
    if scales is None:
        gaussians.opacities[:] = -50.0
    else:
        gaussians.scales[:] = torch.tensor(scales)
    rendered, gradients = render_and_check(gaussians, make_cameras([(37, 29), (20, 50)], torch.float32))
    assert float(rendered.alphas.max()) == 0 and not gradients.touched.any()


@pytest.mark.parametrize("offset", [0.0, -1.0, 1e-3, 0.0100001, 1e-30], ids=lambda value: f"z={value}")
def test_gaussians_at_and_behind_the_camera(offset):
    gaussians, cameras = make_gaussians(20, dtype=torch.float32), make_cameras([(32, 32)], torch.float32)
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
    gaussians, cameras = make_gaussians(20, dtype=torch.float32), make_cameras([(32, 32)], torch.float32)
    expected = rasterize(gaussians.map(lambda tensor: tensor[1:]), cameras, dense_samples(cameras))
    getattr(gaussians, name)[0].fill_(value)
    rendered, gradients = render_and_check(gaussians, cameras)
    torch.testing.assert_close(rendered.colors, expected.colors)
    assert not gradients.touched[0]


@pytest.mark.parametrize("count", [0, 1])
@pytest.mark.parametrize("size", [(1, 1), (3, 2), (17, 33), (2000, 1)])
def test_few_gaussians_and_odd_images(count, size):
    gaussians, cameras = make_gaussians(count, dtype=torch.float32), make_cameras([size], torch.float32)
    gaussians.means[:] = 0.0
    gaussians.opacities[:] = 2.0
    rendered, gradients = render_and_check(gaussians, cameras)
    assert len(rendered.colors) == size[0] * size[1]
    assert bool((rendered.alphas > 0).any()) == (count == 1)
    assert gradients.means.shape == (1, count, 3)


def test_equal_depths_render_the_same_every_time_and_in_order():
    """All at one place: the first listed is in front."""
    cameras = make_cameras([(16, 16)], torch.float32)
    gaussians = make_gaussians(30, dtype=torch.float32)
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
