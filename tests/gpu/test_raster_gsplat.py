"""The CUDA rasterizer against gsplat's own dense kernels, at the same pixels."""

import gsplat
import pytest
import torch
from helpers.raster_cases import GPU_ONLY, assert_gradients_close, make_case
from helpers.rendering_scenes import thin_out

from turbogs_plugin.engine.cuda import raster as cuda
from turbogs_plugin.engine.render import dense_samples
from turbogs_plugin.engine.render_pass import RenderOptions
from turbogs_plugin.gsplat_bridge.autograd import rasterize_differentiable

pytestmark = GPU_ONLY
SIZE = (250, 170)


def render_gsplat(gaussians, cameras, **options):
    width, height = SIZE
    return gsplat.rasterization(
        gaussians.means,
        gaussians.quats,
        gaussians.scales.exp(),
        torch.sigmoid(gaussians.opacities),
        torch.cat([gaussians.sh0, gaussians.shN], dim=1),
        cameras.viewmats,
        cameras.Ks,
        width,
        height,
        sh_degree=3,
        packed=False,
        **options,
    )


@pytest.fixture(params=[1, 3], ids=["one view", "three views"])
def case(request):
    return make_case([SIZE] * request.param, count=3000, seed=21, log_scale=-0.8)


def pixel_rows(samples):
    """Place of each sample in gsplat's flattened [K, H, W]."""
    return (samples.view_of_slot() * (SIZE[0] * SIZE[1]) + samples.pixel_ids.long()).cuda()


@pytest.mark.parametrize("rate", [0.1, 0.33, 1.0])
def test_forward(case, rate):
    samples = case.samples if rate == 1 else thin_out(dense_samples(case.cameras), rate, seed=5)
    images, alphas, _ = render_gsplat(case.gpu_gaussians, case.gpu_cameras, render_mode="RGB+ED")
    device_samples = type(samples)(
        samples.view_ids, samples.sizes, samples.pixel_ids.cuda(), samples.tile_ids.cuda(), samples.tile_offsets.cuda()
    )
    got = cuda.rasterize_cuda(case.gpu_gaussians, case.gpu_cameras, device_samples, RenderOptions(with_depth=True))
    rows = pixel_rows(samples)
    ours = torch.cat([got.colors, got.depths[:, None], got.alphas[:, None]], dim=1)
    theirs = torch.cat([images.reshape(-1, 4)[rows], alphas.reshape(-1, 1)[rows]], dim=1)
    flips = (ours - theirs).abs() > 1e-4 * theirs.abs().clamp(min=1)
    assert flips.any(dim=1).double().mean() <= 2e-3
    assert (ours - theirs)[:, [0, 1, 2, 4]].abs().max() <= 0.05


def test_gradients(case):
    width, height = SIZE
    ours = case.gpu_gaussians.map(lambda value: value.clone().requires_grad_())
    theirs = case.gpu_gaussians.map(lambda value: value.clone().requires_grad_())
    weights = torch.randn(len(case.cameras) * height * width, 4, device="cuda")

    render = rasterize_differentiable(ours, case.gpu_cameras, case.gpu_samples)
    images, alphas, info = render_gsplat(theirs, case.gpu_cameras, absgrad=True)
    info["means2d"].retain_grad()
    rows = pixel_rows(case.samples)
    (torch.cat([render.colors, render.alphas[:, None]], dim=1) * weights[rows]).sum().backward()
    (torch.cat([images.reshape(-1, 3), alphas.reshape(-1, 1)], dim=1) * weights).sum().backward()

    assert_gradients_close(render.means2d.grad, info["means2d"].grad.cpu(), "means2d")
    assert_gradients_close(render.means2d.absgrad, info["means2d"].absgrad.cpu(), "absgrad")
    for name, value in theirs.items():
        got = getattr(ours, name).grad
        assert_gradients_close(got.reshape(len(got), -1), value.grad.cpu().reshape(len(got), -1), name)
    assert (render.projected.radii == info["radii"]).all(dim=-1).double().mean() >= 0.999
