"""Projection and spherical harmonics against gsplat's own torch references."""

import math

import numpy as np
import pytest
import torch
from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci
from helpers.rendering_scenes import make_cameras, make_gaussians

from turbogs_plugin.engine.reference.projection import drawable_rows, project_rows, rotation_matrices
from turbogs_plugin.engine.reference.spherical_harmonics import unit_directions
from turbogs_plugin.engine.render_pass import RasterSettings
from turbogs_plugin.types import Gaussians

SETTINGS = RasterSettings()


def project(gaussians: Gaussians, cameras, degree: int = 3, settings: RasterSettings = SETTINGS):
    rows = drawable_rows(gaussians, cameras, settings)
    return rows, project_rows(rows, rows.take(gaussians), cameras, degree, settings)


def test_direction_of_no_offset_is_zero_with_no_gradient():
    offsets = torch.zeros(2, 3, dtype=torch.float64)
    offsets[1, 0] = 2.0
    offsets.requires_grad_()
    directions = unit_directions(offsets)
    directions.sum().backward()
    assert directions[0].tolist() == [0, 0, 0]
    assert offsets.grad[0].tolist() == [0, 0, 0]
    np.testing.assert_allclose(offsets.grad[1], [0, 0.5, 0.5])


@pytest.mark.parametrize("spread", [1.0, 6.0], ids=["inside", "mostly outside the image"])
def test_projection_and_its_gradients_are_gsplats(spread):
    """Wide spread puts most means where the Jacobian's clamp acts."""
    gaussians = make_gaussians(200, spread=spread).map(lambda value: value.clone().requires_grad_())
    cameras = make_cameras([(48, 32), (48, 32)])
    rows, splats = project(gaussians, cameras)

    covariances, _ = _quat_scale_to_covar_preci(gaussians.quats, gaussians.scales.exp(), compute_preci=False)
    theirs = _fully_fused_projection(
        gaussians.means, covariances, cameras.viewmats, cameras.Ks, 48, 32, calc_compensations=True
    )
    means2d, depths, conics, shares = (value.flatten(0, 1)[rows.flat] for value in theirs[1:5])
    torch.testing.assert_close(splats.shares, shares.detach(), rtol=1e-6, atol=1e-6)
    for ours, theirs in ((splats.means2d, means2d), (splats.depths, depths), (splats.conics, conics)):
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-11)

    generator = torch.Generator().manual_seed(5)
    upstream = [torch.randn(value.shape, generator=generator, dtype=torch.float64) for value in (means2d, conics)]
    leaves = (gaussians.means, gaussians.quats, gaussians.scales)
    ours = torch.autograd.grad((splats.means2d, splats.conics), leaves, upstream)
    theirs = torch.autograd.grad((means2d, conics), leaves, upstream)
    for our, their in zip(ours, theirs, strict=True):
        torch.testing.assert_close(our, their, rtol=1e-8, atol=1e-8 * float(their.abs().max()))


def test_radii_follow_the_opacity_and_the_image():
    """The rules of gsplat's fused kernel, one row at a time."""
    gaussians, cameras = make_gaussians(300, spread=3.0), make_cameras([(48, 32), (20, 70)])
    rows, splats = project(gaussians, cameras)
    shown = 0
    for row, (view, index) in enumerate(zip(rows.views.tolist(), rows.gaussians.tolist(), strict=True)):
        opacity = 1 / (1 + math.exp(-float(gaussians.opacities[index])))
        a, b, c = splats.conics[row].tolist()
        covariance = np.linalg.inv(np.array([[a, b], [b, c]]))
        extent = min(3.33, math.sqrt(2 * math.log(255 * opacity)))
        expected = np.ceil(extent * np.sqrt(np.diag(covariance)))
        mean, size = splats.means2d[row].numpy(), cameras.sizes[view]
        if np.any(mean + expected <= 0) or np.any(mean - expected >= size):
            expected[:] = 0
        assert splats.radii[row].tolist() == expected.tolist()
        shown += expected.any()
    assert 50 < shown < len(rows.views) - 50


def test_rows_are_those_that_can_be_drawn():
    gaussians, cameras = make_gaussians(100, spread=4.0), make_cameras([(48, 32), (20, 70)])
    settings = RasterSettings(near_plane=2.0, far_plane=6.0)
    rows = drawable_rows(gaussians, cameras, settings)
    drawn = torch.zeros(rows.shape, dtype=torch.bool)
    drawn[rows.views, rows.gaussians] = True
    points = (
        torch.einsum("kij,nj->kni", cameras.viewmats[:, :3, :3], gaussians.means) + cameras.viewmats[:, None, :3, 3]
    )
    expected = (points[..., 2] >= 2) & (points[..., 2] <= 6) & (gaussians.opacities.sigmoid() >= 1 / 255)
    assert torch.equal(drawn, expected)
    assert torch.equal(rows.flat, rows.flat.sort().values)


def test_rotation_matrices_of_any_norm():
    generator = torch.Generator().manual_seed(0)
    quats = torch.randn(20, 4, generator=generator)
    expected = rotation_matrices(quats)
    torch.testing.assert_close(expected @ expected.transpose(1, 2), torch.eye(3).expand(20, 3, 3), rtol=0, atol=1e-6)
    for scale in (1e-20, 1e20):
        torch.testing.assert_close(rotation_matrices(scale * quats), expected, rtol=0, atol=1e-6)
    zero = torch.zeros(1, 4, requires_grad=True)
    assert torch.equal(rotation_matrices(zero)[0], torch.eye(3))
    rotation_matrices(zero).sum().backward()
    assert zero.grad.isfinite().all()
