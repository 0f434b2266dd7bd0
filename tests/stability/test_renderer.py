"""The reference renderer in float32 against itself in float64, on its worst inputs. What it does on each of them is in
test_rendering_extremes.py; here it is how exact that is."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from rendering_scenes import make_cameras, make_gaussians
from tolerances import TOLERANCES

from turbogs_plugin.rendering import dense_samples, rasterize
from turbogs_plugin.types import Cameras, GaussianGradients, Gaussians, GaussianStats

SINGLE = TOLERANCES[torch.float32]
NAMES = ("means", "quats", "scales", "opacities", "sh0", "shN")


def lens(degrees: float, size: tuple[int, int], center: float | None = None) -> Cameras:
    """One camera with this horizontal angle of view, and its principal point at this x."""
    cameras = make_cameras([size], torch.float32)
    cameras.Ks[0, 0, 0] = cameras.Ks[0, 1, 1] = 0.5 * size[0] / np.tan(np.radians(degrees) / 2)
    if center is not None:
        cameras.Ks[0, 0, 2] = center
    return cameras


def off_axis(center: float) -> tuple[Gaussians, Cameras]:
    """A lens whose principal point is outside its 32 pixels, and Gaussians moved to where it looks."""
    gaussians, cameras = random_scene(), lens(60, (32, 32), center)
    gaussians.means += 4 * (16 - center) / cameras.Ks[0, 0, 0] * cameras.viewmats[0, 0, :3]
    return gaussians, cameras


def random_scene(count: int = 20, **values) -> Gaussians:
    gaussians = make_gaussians(count, dtype=torch.float32)
    for name, value in values.items():
        getattr(gaussians, name)[:] = torch.as_tensor(value)
    return gaussians


def scaled_scene(name: str, factor: float) -> Gaussians:
    gaussians = random_scene()
    getattr(gaussians, name).mul_(factor)
    return gaussians


def at_a_pixel_centre() -> tuple[Gaussians, Cameras]:
    gaussians, cameras = random_scene(1, means=[0.0, 0.0, 3.0], opacities=1.0), make_cameras([(9, 9)], torch.float32)
    cameras.viewmats[0] = torch.eye(4)
    cameras.Ks[0, :2, 2] = 4.5
    return gaussians, cameras


TWO_VIEWS = make_cameras([(37, 29), (20, 50)], torch.float32)
CASES = {
    "ordinary": (random_scene(), TWO_VIEWS),
    "needles of aspect 1e6": (random_scene(scales=[3.0, -10.8, -10.8]), TWO_VIEWS),
    "discs of aspect 1e6": (random_scene(scales=[1.0, 1.0, -12.8]), TWO_VIEWS),
    "scales of exp(-20)": (random_scene(scales=[-20.0, -20.0, -20.0]), TWO_VIEWS),
    "scales of exp(9)": (random_scene(scales=[9.0, 9.0, 9.0], opacities=-3.0), TWO_VIEWS),
    "quaternions of norm 0": (random_scene(quats=0.0), TWO_VIEWS),
    "quaternions of norm 1e-20": (scaled_scene("quats", 1e-20), TWO_VIEWS),
    "quaternions of norm 1e20": (scaled_scene("quats", 1e20), TWO_VIEWS),
    "opacity logits of 50": (random_scene(opacities=50.0), TWO_VIEWS),
    "colours of 1e6": (scaled_scene("sh0", 1e6), TWO_VIEWS),
    "extents of 1e6": (scaled_scene("means", 1e6), TWO_VIEWS),
    "a Gaussian in a pixel centre": at_a_pixel_centre(),
    "lens of 5 degrees": (random_scene(), lens(5, (32, 32))),
    "lens of 170 degrees": (random_scene(), lens(170, (32, 32))),
    "principal point 500 px left of the image": off_axis(-500.0),
    "principal point 60 px right of the image": off_axis(92.0),
    "8192 pixels wide": (random_scene(60), lens(60, (8192, 3))),
    "image of one pixel": (random_scene(), make_cameras([(1, 1)], torch.float32)),
    "50000 Gaussians on one pixel": (
        random_scene(50_000, means=[0.0, 0.0, 0.0], opacities=-5.0), make_cameras([(1, 1)], torch.float32)
    ),
}  # fmt: skip
DRAWN_AS_NEEDLES = ("needles of aspect 1e6", "discs of aspect 1e6", "scales of exp(9)", "8192 pixels wide")
WITHOUT_DIRECTION = ("scales of exp(-20)", "scales of exp(9)", "quaternions of norm 0")
"""Spheres and quaternions without a direction: the quaternions' exact gradient is zero, so it has no relative error."""


def render(gaussians: Gaussians, cameras: Cameras, dtype: torch.dtype) -> tuple[torch.Tensor, GaussianGradients]:
    """([P, 3] colours, gradients of a fixed random linear loss), all in float64."""
    gaussians, cameras = gaussians.map(lambda value: value.to(dtype)), cameras.to(dtype=dtype)
    samples = dense_samples(cameras)
    rendered = rasterize(gaussians, cameras, samples)
    upstream = torch.randn(len(samples), 3, generator=torch.Generator().manual_seed(0)).to(dtype) / len(samples)
    return rendered.colors.double(), rendered.backward(upstream).parameter_gradients(rows=False)


@pytest.mark.parametrize("case", CASES)
def test_float32_is_close_to_float64(case, record_property):
    gaussians, cameras = CASES[case]
    colors, gradients = render(gaussians, cameras, torch.float32)
    expected, expected_gradients = render(gaussians, cameras, torch.float64)
    assert case == "image of one pixel" or expected.max() > 0.02
    error = float((colors - expected).abs().max() / expected.abs().max().clamp(min=1.0))
    record_property("pixel error", f"{error:.1e}")
    needle = case in DRAWN_AS_NEEDLES
    assert error <= (SINGLE.needle_pixel if needle else SINGLE.pixel)

    errors = {}
    for name in NAMES:
        got, wanted = getattr(gradients, name).double(), getattr(expected_gradients, name)
        assert got.isfinite().all()
        if name == "quats" and case in WITHOUT_DIRECTION:
            assert got.norm() <= 1e-3 * gradients.scales.double().norm().clamp(min=1e-3)
        elif wanted.norm() > 0:
            errors[name] = float((got - wanted).norm() / wanted.norm())
    worst = max(errors, key=errors.get)
    record_property("gradient error", f"{errors[worst]:.1e} ({worst})")
    assert errors[worst] <= (SINGLE.needle_gradient if needle else SINGLE.gradient), errors


def test_equal_depths_render_the_same_bits_every_time():
    gaussians = random_scene(300)
    gaussians.means[:] = gaussians.means[:1].clone()
    gaussians.opacities[:], gaussians.scales[:] = 1.0, -1.0
    first, first_gradients = render(gaussians, TWO_VIEWS, torch.float32)
    again, again_gradients = render(gaussians, TWO_VIEWS, torch.float32)
    assert torch.equal(first, again)
    for name in NAMES:
        assert torch.equal(getattr(first_gradients, name), getattr(again_gradients, name))


SIZES = st.sampled_from([-200.0, -20.0, -10.0, -2.0, 0.0, 3.0, 9.0, 14.0, 20.0, 88.0, 200.0])
PLACES = st.sampled_from([0.0, 1e-30, 1e-3, 1.0, -1.0, 4.0, -4.0, 1e3, 1e6, -1e6, 1e18, -1e18, 1e30, 3e38])
NORMS = st.sampled_from([0.0, 1e-38, 1e-20, 1e-3, 1.0, 1e20, 1e37])
LOGITS = st.sampled_from([-50.0, -5.0, 0.0, 5.0, 50.0, 1e30, -1e30])
COLORS = st.sampled_from([0.0, 1.0, -1e4, 1e6])


@settings(max_examples=500, deadline=None, derandomize=True)
@given(
    sizes=st.lists(SIZES, min_size=3, max_size=3),
    place=st.lists(PLACES, min_size=3, max_size=3),
    norm=NORMS,
    logit=LOGITS,
    color=COLORS,
    degrees=st.sampled_from([5.0, 60.0, 170.0]),
    center=st.sampled_from([-500.0, 10.0, 5000.0]),
    size=st.sampled_from([(1, 1), (3, 40), (20, 17)]),
)
@example([-200.0] * 3, [0.0, 3e38, -4.0], 0.0, -5.0, 0.0, 5.0, -500.0, (1, 1))  # near, and endlessly far to the side
def test_any_gaussian_among_ordinary_ones_stays_finite(sizes, place, norm, logit, color, degrees, center, size):
    """Colours, gradients and statistics of everybody; a Gaussian that is not drawn has no gradient."""
    gaussians = random_scene(8)
    gaussians.scales[3], gaussians.means[3] = torch.tensor(sizes), torch.tensor(place)
    gaussians.quats[3] *= norm
    gaussians.opacities[3], gaussians.sh0[3] = logit, color
    cameras = lens(degrees, size, center)
    samples = dense_samples(cameras)
    rendered = rasterize(gaussians, cameras, samples, with_depth=True)
    ones, stats = torch.ones_like(rendered.alphas), GaussianStats.zeros(len(gaussians), "cpu")
    screen = rendered.backward(torch.ones_like(rendered.colors), ones, stats, ones, ones)
    gradients = screen.parameter_gradients(rows=True)
    assert all(value.isfinite().all() for value in (rendered.colors, rendered.alphas, rendered.depths))
    assert all(value.isfinite().all() for value in (*vars(gradients).values(), *vars(stats).values()))
    for name in NAMES[:-1]:
        value = getattr(gradients, name)[:, ~gradients.touched]
        assert (value == 0).all(), name
