"""What gsplat's DefaultStrategy takes from our `info` is what gsplat's own formulas give it at the same Gaussians.

The other side is gsplat's torch code and compositing by autograd in float64 (`helpers.gsplat_torch`), and the rule for
radii of gsplat's kernels.
"""

from importlib import import_module

import pytest
import torch
from gsplat import DefaultStrategy
from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci
from helpers.bridge_host import HEIGHT, WIDTH, arguments, make_cameras, make_splats
from helpers.gsplat_torch import gsplat_torch_render

from turbogs_plugin.engine.render import dense_samples
from turbogs_plugin.gsplat_bridge import sparse_rasterization
from turbogs_plugin.gsplat_bridge.gaussian_errors import screen_statistics
from turbogs_plugin.types import PARAMETER_NAMES, Gaussians

sparse_rasterization_module = import_module("turbogs_plugin.gsplat_bridge.sparse_rasterization")
"""The package has the function under this name."""

ALPHA_MIN, EXTENT_MAX = 1 / 255, 3.33


def gsplat_radii(means2d, depths, conics, opacities):
    """[C, N, 2] as in gsplat's projection kernel: opacity-aware half-widths, 0 where nothing of it is on the image."""
    a, b, c = conics.unbind(-1)
    variances = torch.stack([c, a], -1) / (a * c - b * b)[..., None]
    extents = (2 * (opacities / ALPHA_MIN).clamp(min=1e-12).log()).clamp(min=0).sqrt().clamp(max=EXTENT_MAX)
    radii = (extents[..., None] * variances.sqrt()).ceil()
    size = means2d.new_tensor([WIDTH, HEIGHT])
    inside = ((means2d + radii > 0) & (means2d - radii < size)).all(-1)
    drawn = inside & (depths >= 0.01) & (opacities >= ALPHA_MIN)
    return torch.where(drawn[..., None], radii, 0).int()


def gsplat_info(splats, cameras, pixels):
    """`info` after the backward pass of a mean absolute difference from pixels [P, 3] of whole images."""
    gaussians = Gaussians(**{name: splats[name].detach().double() for name in PARAMETER_NAMES})
    cameras, drawn = cameras.to(dtype=torch.float64), []
    colors, _, _ = gsplat_torch_render(gaussians, cameras, dense_samples(cameras), sh_degree=1, drawn=drawn)
    torch.nn.functional.l1_loss(colors, pixels.double()).backward()
    covariances, _ = _quat_scale_to_covar_preci(gaussians.quats, gaussians.scales.exp(), compute_preci=False)
    seen = (gaussians.means, covariances, cameras.viewmats, cameras.Ks)
    _, means2d, depths, conics, _ = _fully_fused_projection(*seen, WIDTH, HEIGHT)
    radii = gsplat_radii(means2d, depths, conics, torch.sigmoid(gaussians.opacities).expand(depths.shape))
    means2d = means2d.float().requires_grad_()
    means2d.grad, means2d.absgrad = torch.zeros_like(means2d), torch.zeros_like(means2d)
    for view, one in enumerate(drawn):
        means2d.grad[view, one.order] = one.distances.grad.sum(dim=0).float()
        means2d.absgrad[view, one.order] = one.distances.grad.abs().sum(dim=0).float()
    sizes = {"width": WIDTH, "height": HEIGHT, "n_cameras": len(cameras)}
    return {"means2d": means2d, "radii": radii, "gaussian_ids": None, **sizes}


@pytest.mark.parametrize("absgrad", [False, True])
@pytest.mark.parametrize("views", [1, 3])
def test_default_strategys_statistics_are_gsplats(views, absgrad):
    splats, cameras = make_splats(60), make_cameras(views)
    with torch.no_grad():
        splats["opacities"][:4] = torch.tensor([-7.0, -5.6, -5.5, 8.0])  # below and at the threshold, and opaque
        splats["means"][4:8, 2] = torch.tensor([-2.998, -2.995, -2.9, -4.0])  # at and behind the near plane
        splats["means"][8:12, 0] = torch.tensor([2.0, -2.0, 2.4, 6.0])  # at the edge of the image and past it
    samples = dense_samples(cameras)
    pixels = torch.rand(len(samples), 3, generator=torch.Generator().manual_seed(2))
    colors, _, ours = sparse_rasterization(**arguments(splats, cameras), samples=samples, sh_degree=1, absgrad=absgrad)
    torch.nn.functional.l1_loss(colors, pixels).backward()
    theirs = gsplat_info(splats, cameras, pixels)

    assert torch.equal(ours["radii"], theirs["radii"])
    assert 0 < (ours["radii"] > 0).all(-1).sum() < views * 60
    strategy = DefaultStrategy(absgrad=absgrad, refine_scale2d_stop_iter=1)
    states = [strategy.initialize_state() for _ in range(2)]
    for state, info in zip(states, (ours, theirs), strict=True):
        strategy._update_state(splats, state, info)
    assert torch.equal(states[0]["count"], states[1]["count"])
    torch.testing.assert_close(states[0]["radii"], states[1]["radii"])
    expected = states[1]["grad2d"]
    assert expected.max() > 0
    torch.testing.assert_close(states[0]["grad2d"], expected, rtol=2e-4, atol=2e-5 * float(expected.max()))
    sums = screen_statistics(theirs, 60)
    torch.testing.assert_close(sums.absgrad_sums if absgrad else sums.grad_sums, expected)


def test_one_radius_of_each_gaussian_as_before_gsplat_1_5(monkeypatch):
    """gsplat 1.4's strategies expect radii [C, N]; ours take either shape from its rasterization."""
    splats, cameras = make_splats(60), make_cameras(2)
    samples = dense_samples(cameras)
    infos = []
    for one_radius in (False, True):
        monkeypatch.setattr(sparse_rasterization_module, "ONE_RADIUS", one_radius)
        colors, _, info = sparse_rasterization(**arguments(splats, cameras), samples=samples, sh_degree=1)
        colors.sum().backward()
        infos.append(info)
    assert torch.equal(infos[1]["radii"], infos[0]["radii"].amax(-1))
    assert torch.equal(infos[1]["radii"] > 0, (infos[0]["radii"] > 0).all(-1))
    first, second = (screen_statistics(info, 60) for info in infos)
    assert first.view_counts.sum() > 60
    for name, sums in vars(first).items():
        torch.testing.assert_close(vars(second)[name], sums)
