"""The protocol of gsplat's main branch (1.6): hosts pass a `Scene`, whose rows follow the parameters' rows."""

import functools

import pytest
import torch
from helpers.bridge_host import Host
from helpers.gsplat_stand_ins import Scene

from turbogs_plugin.gsplat_bridge import TurboDensityStrategy

SOON = {"refine_start_iter": 2, "refine_every": 3, "refine_stop_iter": 8, "grow_absgrad2d": 1e-6, "prune_opa": 0.2}


@pytest.mark.parametrize("tells_errors", [False, True])
def test_a_scenes_rows_follow(tells_errors):
    """Every row has a number as parameter, as signal and, modulo 3, as component."""
    host, tags = Host(TurboDensityStrategy(**SOON, max_gaussians=60), tells_errors=tells_errors), torch.arange(40.0)
    host.splats["tag"] = torch.nn.Parameter(tags.clone(), requires_grad=False)
    scene = Scene(host.splats, {"tag": tags, "feature": tags[:, None].repeat(1, 5)}, torch.arange(40) % 3)
    host.strategy.step_post_backward = functools.partial(host.strategy.step_post_backward, scene=scene)
    host.train(9)
    scene.validate()
    tags = scene.splats["tag"]
    assert len(tags) > 40 and len(tags.unique()) < 40  # some were copied, some are gone
    assert (tags.diff() < 0).any()  # and all are in another order
    assert torch.equal(scene.signal["tag"], tags) and torch.equal(scene.signal["feature"], tags[:, None].repeat(1, 5))
    assert torch.equal(scene.component_index, tags.long() % 3)
