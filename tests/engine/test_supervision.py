"""Loss and error maps of an iteration, on the way without a kernel."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from turbogs_plugin.strategies.losses.losses import CharbonnierLoss

from turbogs_plugin.engine.supervision import supervise
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.scene.photos import Photos
from turbogs_plugin.tiles import dense_pixels
from turbogs_plugin.types import LossOutput, Step

SIZES = np.array([[21, 17], [16, 16]])
STEP = Step(7, 100, 70)


class LostLoss:
    """Its errors are finite, its sum is not."""

    def __call__(self, colors, targets, samples) -> LossOutput:
        output = CharbonnierLoss()(colors, targets, samples)
        return LossOutput(output.loss * torch.inf, output.color_gradients, output.pixel_errors)


@pytest.mark.parametrize("overflow", [None, 0, 1])
@pytest.mark.parametrize(("loss", "lost"), [(CharbonnierLoss(), 0), (LostLoss(), 1)])
def test_a_pass_that_drew_nothing_teaches_nothing(loss, lost, overflow):
    generator = torch.Generator().manual_seed(3)
    maps = ErrorMaps.from_images([torch.rand(17, 21, generator=generator), torch.rand(16, 16, generator=generator)])
    colors = torch.randint(0, 256, (21 * 17 + 16 * 16, 3), generator=generator, dtype=torch.uint8)
    truth = Photos(colors, SIZES).at(dense_pixels((1,), SIZES[1:], "cpu"))
    before, count = maps.state_dict(), torch.zeros((), dtype=torch.int64)
    flag = None if overflow is None else torch.full((1,), overflow, dtype=torch.int32)
    output = supervise(loss, torch.zeros(256, 3), truth, maps, STEP, overflow=flag, nonfinite_losses=count)
    after = maps.state_dict()
    same = {name: torch.equal(before[name], after[name]) for name in ("errors", "stamps", "view_sums")}
    assert set(same.values()) == {overflow == 1}
    assert count == (0 if overflow == 1 else lost)
    assert output.pixel_errors.isfinite().all()
