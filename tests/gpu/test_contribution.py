"""Contributions of Gaussians by the kernels, against those of the reference."""

import torch
from helpers.raster_cases import GPU_ONLY
from helpers.rendering_scenes import make_cameras, make_gaussians

from turbogs_plugin.engine.render_pass import DEFAULT_SETTINGS
from turbogs_plugin.export.model_export import contributions, pruned

pytestmark = GPU_ONLY


def test_contributions_are_those_of_the_reference():
    gaussians = make_gaussians(400, seed=2, dtype=torch.float32)
    cameras = make_cameras([(96, 64), (50, 70), (33, 47)], dtype=torch.float32)
    wanted = contributions(gaussians, cameras, DEFAULT_SETTINGS)
    on_gpu = gaussians.map(lambda value: value.cuda())
    found = contributions(on_gpu, cameras, DEFAULT_SETTINGS)
    assert found.is_cuda and float(wanted.max()) > 10
    assert float((found.cpu() - wanted).abs().max()) < 1e-3 * float(wanted.max())
    assert len(pruned(on_gpu, found, 50)) == 50
