"""The renderer's worst inputs, float32 on the CPU, and one way to render them in any dtype and on any device."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import torch
from helpers.rendering_scenes import make_cameras, make_gaussians
from helpers.tolerances import Tolerance

from turbogs_plugin.engine.render import dense_samples, rasterize
from turbogs_plugin.engine.render_pass import Rendered
from turbogs_plugin.types import PARAMETER_NAMES, Cameras, GaussianGradients, Gaussians, GaussianStats


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


def render(
    gaussians: Gaussians, cameras: Cameras, dtype: torch.dtype, device: str = "cpu"
) -> tuple[torch.Tensor, GaussianGradients]:
    """([P, 3] colours, gradients of a fixed random linear loss), computed as asked, returned in float64 on the CPU."""
    gaussians = gaussians.map(lambda value: value.to(device, dtype))
    cameras = cameras.to(device).to(dtype=dtype)
    samples = dense_samples(cameras)
    rendered = rasterize(gaussians, cameras, samples)
    upstream = torch.randn(len(samples), 3, generator=torch.Generator().manual_seed(0)).to(device, dtype) / len(samples)
    gradients = rendered.backward(upstream).parameter_gradients(rows=False)
    values = {field.name: getattr(gradients, field.name).double().cpu() for field in fields(gradients)}
    return rendered.colors.double().cpu(), GaussianGradients(**values)


def render_and_check(gaussians: Gaussians, cameras: Cameras) -> tuple[Rendered, GaussianGradients]:
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


def compare(case: str, dtype: torch.dtype, device: str) -> tuple[float, dict[str, float]]:
    """Errors of a case against float64 on the CPU: the largest of a sample's colour, over the largest colour, and of
    every parameter's gradient, L2 over L2. Fails where anything is not finite."""
    colors, gradients = render(*CASES[case], dtype, device)
    expected, expected_gradients = render(*CASES[case], torch.float64)
    assert case == "image of one pixel" or expected.max() > 0.02
    error = float((colors - expected).abs().max() / expected.abs().max().clamp(min=1.0))
    errors = {}
    for name in PARAMETER_NAMES:
        got, wanted = getattr(gradients, name), getattr(expected_gradients, name)
        assert got.isfinite().all()
        if name == "quats" and case in WITHOUT_DIRECTION:
            assert got.norm() <= 1e-3 * gradients.scales.norm().clamp(min=1e-3)
        elif wanted.norm() > 0:
            errors[name] = float((got - wanted).norm() / wanted.norm())
    return error, errors


def assert_within(case: str, error: float, errors: dict[str, float], tolerance: Tolerance) -> None:
    """What `compare` found lies within the bounds."""
    needle = case in DRAWN_AS_NEEDLES
    assert error <= (tolerance.needle_pixel if needle else tolerance.pixel)
    assert max(errors.values()) <= (tolerance.needle_gradient if needle else tolerance.gradient), errors
