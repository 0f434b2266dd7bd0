"""The zero channel's arithmetic, over a compositor in plain torch that stands for gsplat's, which needs a GPU."""

import gsplat
import pytest
import torch
from helpers.bridge_host import make_splats
from helpers.gsplat_stand_ins import CAMERAS, COUNT, rendered_info, stand_in, stock_info

from turbogs_plugin.errors import InputError
from turbogs_plugin.gsplat_bridge import SharedOptimizer, TurboDensityStrategy
from turbogs_plugin.gsplat_bridge.gaussian_errors import iteration_stats, loss_shares
from turbogs_plugin.strategies.optimizers.moment_lm import MomentLMOptimizer


@pytest.fixture
def rendered():
    return rendered_info()


@pytest.mark.parametrize("packed", [False, True])
def test_it_gives_the_sums_that_our_rasterizer_gives(rendered, packed, monkeypatch):
    info, camera_of = stock_info(rendered, packed)
    monkeypatch.setattr(gsplat, "rasterize_to_pixels", stand_in(camera_of))
    (expected, _), (actual, has_errors) = iteration_stats(rendered, COUNT), iteration_stats(info, COUNT)
    assert has_errors and expected.error_sums.sum() > 1
    for name in ("error_sums", "weight_sums", "grad_sums", "absgrad_sums", "view_counts", "max_radii"):
        torch.testing.assert_close(getattr(actual, name), getattr(expected, name), rtol=2e-3, atol=2e-3)
    assert not actual.distance_sums.any() and not actual.square_sums.any()
    torch.testing.assert_close(loss_shares(info, COUNT), rendered["loss_shares"], rtol=2e-3, atol=1e-6)


def test_optimizer_and_strategy_share_one_further_pass(rendered, monkeypatch):
    info, camera_of = stock_info(rendered, packed=False)
    calls = []

    def counted(*args, **kwargs):
        calls.append(1)
        return stand_in(camera_of)(*args, **kwargs)

    monkeypatch.setattr(gsplat, "rasterize_to_pixels", counted)
    splats = make_splats(COUNT)
    shared = SharedOptimizer(MomentLMOptimizer())
    optimizers = {name: shared([{"params": splats[name], "lr": 1e-3, "name": name}]) for name in splats}
    strategy = TurboDensityStrategy()
    state = strategy.initialize_state()
    optimizers["sh0"].observe(info)
    for name, value in splats.items():
        value.grad = torch.ones_like(value)
        optimizers[name].step()
    strategy.step_post_backward(splats, optimizers, state, 0, info)
    assert len(calls) == 1
    assert state["driven_by"] == "error"


def test_errors_that_come_too_late_for_our_rasterizer_are_refused(rendered):
    late = {key: value for key, value in rendered.items() if key not in ("gaussian_stats", "loss_shares")}
    with pytest.raises(InputError, match="put them in before backward"):
        iteration_stats(late, COUNT)


def test_errors_of_other_images_are_refused(rendered):
    info, _ = stock_info(rendered, packed=False)
    info.update(prediction=torch.zeros(CAMERAS, 5, 5, 3), ground_truth=torch.zeros(CAMERAS, 5, 5, 3))
    with pytest.raises(InputError, match=r"of shape \(\d, 5, 5, 3\): expected \(\d, 24, 40, 3\), what gsplat"):
        iteration_stats(info, COUNT)


def test_info_without_a_gradient_on_the_screen_is_refused(rendered):
    """A render with the unscented transform gives such `info`; its weights are not splats'."""
    info, _ = stock_info(rendered, packed=False)
    info["means2d"] = info["means2d"].detach()
    with pytest.raises(InputError, match=r"takes no gradient, as from a render with with_ut or with_eval3d"):
        loss_shares(info, COUNT)
