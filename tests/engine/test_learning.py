"""What the error maps learn of an iteration, and of which samples they learn nothing."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from turbogs_plugin.engine import engine_of
from turbogs_plugin.engine.protocol import MapUpdate
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.scene.photos import Photos
from turbogs_plugin.strategies.losses import CharbonnierLoss, CharbonnierNccLoss, SparseSsimLoss
from turbogs_plugin.tiles import dense_pixels
from turbogs_plugin.types import LossOutput, Step

SIZES = np.array([[21, 17], [16, 16]])
STEP = Step(7, 100, 70)
MAPS = ("errors", "stamps", "view_sums")


@pytest.fixture
def case():
    """(maps of two views, the photo samples of all of the second)."""
    generator = torch.Generator().manual_seed(3)
    maps = ErrorMaps.from_images([torch.rand(17, 21, generator=generator), torch.rand(16, 16, generator=generator)])
    colors = torch.randint(0, 256, (21 * 17 + 16 * 16, 3), generator=generator, dtype=torch.uint8)
    return maps, Photos(colors, SIZES).at(dense_pixels((1,), SIZES[1:], "cpu"))


@pytest.mark.parametrize("overflow", [None, 0, 1])
@pytest.mark.parametrize("factor", [1.0, torch.inf])
def test_a_pass_that_drew_nothing_teaches_nothing(case, monkeypatch, factor, overflow):
    """Neither does its loss count as lost, finite or not."""
    maps, truth = case
    before, count = maps.state_dict(), torch.zeros((), dtype=torch.int64)
    flag = None if overflow is None else torch.full((1,), overflow, dtype=torch.int32)
    colors = torch.zeros(256, 3)
    output = CharbonnierLoss()(colors, truth.colors(), truth.samples)
    output = LossOutput(output.loss * factor, output.color_gradients, output.pixel_errors)
    engine = engine_of(colors.device)
    monkeypatch.setattr(type(engine), "overflow", flag)
    engine.learn(truth.samples, colors, output, MapUpdate(maps, STEP, count))
    after = maps.state_dict()
    same = {name: torch.equal(before[name], after[name]) for name in MAPS}
    assert set(same.values()) == {overflow == 1}
    assert count == (0 if overflow == 1 or factor == 1.0 else 1)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
@pytest.mark.parametrize("loss", [CharbonnierLoss(), CharbonnierNccLoss(), SparseSsimLoss()])
def test_a_colour_that_is_not_finite_leaves_its_pixel_alone(case, loss, bad):
    """Neither its error nor its age changes, as in the kernels; all other pixels learn as if it were not there; loss
    and gradients stay finite."""
    maps, truth = case
    before = maps.state_dict()
    slots = torch.tensor([0, 5, 100])
    colors = torch.full((256, 3), 0.5)
    colors[slots, 1] = bad
    output = engine_of(colors.device).supervise(loss.terms, colors, truth, MapUpdate(maps, STEP))
    assert output.loss.isfinite() and output.color_gradients.isfinite().all()
    assert not output.pixel_errors[slots].any() and not output.color_gradients[slots].any()
    flat = truth.samples.flat_pixels(maps.offsets)
    kept = torch.zeros(len(maps.errors), dtype=torch.bool)
    kept[: 21 * 17] = True
    kept[flat[slots]] = True
    assert torch.equal(maps.errors[kept], before["errors"][kept])
    assert torch.equal(maps.stamps == STEP.iteration, ~kept)
    assert float(maps.view_sums[1]) == pytest.approx(float(maps.errors[21 * 17 :].double().sum()), rel=1e-12)
