"""The zero channel's arithmetic, over a compositor in plain torch that stands for gsplat's, which needs a GPU; and
options of gsplat's trainer that change a render or its errors."""

import gsplat
import pytest
import torch
from helpers.bridge_host import WIDTH, Host
from helpers.gsplat_stand_ins import CAMERAS, COUNT, rendered_info, stand_in, stock_info
from helpers.refusals import assert_refused

from turbogs_plugin.gsplat_bridge import TurboDensityStrategy
from turbogs_plugin.gsplat_bridge.gaussian_errors import iteration_stats


@pytest.mark.parametrize("packed", [False, True])
def test_it_gives_the_sums_that_our_rasterizer_gives(packed, monkeypatch):
    rendered = rendered_info()
    info, camera_of = stock_info(rendered, packed)
    monkeypatch.setattr(gsplat, "rasterize_to_pixels", stand_in(camera_of))
    (expected, _), (actual, has_errors) = iteration_stats(rendered, COUNT), iteration_stats(info, COUNT)
    assert has_errors and expected.error_sums.sum() > 1
    for name in ("error_sums", "weight_sums", "grad_sums", "absgrad_sums", "view_counts", "max_radii"):
        torch.testing.assert_close(getattr(actual, name), getattr(expected, name), rtol=2e-3, atol=2e-3)
    assert not actual.distance_sums.any()
    half = 0.5 * rendered["n_cameras"] * torch.tensor([rendered["width"], rendered["height"]])
    squares = (rendered["means2d"].absgrad * half).square().sum(dim=(0, -1))  # of each view, summed over views
    torch.testing.assert_close(actual.square_sums, squares, rtol=2e-3, atol=1e-7)


def stock(monkeypatch) -> dict:
    """`info` of gsplat's own rasterizer with errors in it, after backward; its compositor is a stand-in."""
    info, camera_of = stock_info(rendered_info(), packed=False)
    monkeypatch.setattr(gsplat, "rasterize_to_pixels", stand_in(camera_of))
    return info


def densified(info: dict) -> None:
    """A refinement by this `info`, which changes the Gaussians."""
    host = Host(TurboDensityStrategy(refine_start_iter=0, refine_every=1, grow_grad2d=1e-6))
    host.strategy.step_post_backward(host.splats, host.optimizers, host.state, 1, info)
    assert host.state["driven_by"] == "error" and len(host.splats["means"]) > 40


def test_weights_are_of_the_compensated_opacities_of_an_antialiased_render(monkeypatch):
    plain, faint = stock(monkeypatch), stock(monkeypatch)
    faint["opacities"] = 0.25 * faint["opacities"].detach()
    plain_sum, faint_sum = (iteration_stats(info, COUNT)[0].weight_sums.sum() for info in (plain, faint))
    assert 0 < faint_sum < 0.6 * plain_sum
    densified(faint)


def test_a_prediction_that_the_host_changed_still_drives_density(monkeypatch):
    """By a bilateral grid, or a random background; a depth beside the colours is refused."""
    info = stock(monkeypatch)
    seen = info["prediction"]
    deeper = {**info, "prediction": torch.cat([seen, seen[..., :1]], dim=-1)}
    assert_refused(r"expected both \[C, H, W, 3\]", densified, deeper)
    densified({**info, "prediction": seen @ torch.diag(torch.tensor([1.1, 0.9, 1.0]))})


def test_errors_of_masked_pixels_count_unless_the_photo_is_black_there_too(monkeypatch):
    """gsplat's trainer leaves the render black where it is masked."""
    counts = (torch.arange(WIDTH) < WIDTH // 3)[:, None]  # [W, 1] True where a pixel counts
    whole, black, expected = (stock(monkeypatch) for _ in range(3))
    for info in (whole, black):
        info["prediction"] = info["prediction"] * counts
    black["ground_truth"] = black["ground_truth"] * counts
    errors = counts * (expected["prediction"] - expected["ground_truth"])
    expected |= {"prediction": errors, "ground_truth": torch.zeros_like(errors)}
    sums = [iteration_stats(info, COUNT)[0].error_sums for info in (whole, black, expected)]
    torch.testing.assert_close(sums[1], sums[2])
    assert sums[0].sum() > 1.5 * sums[1].sum() > 0
    densified(black)


def test_info_that_does_not_fit_is_refused(monkeypatch):
    """A render with the unscented transform leaves no gradient on the screen; its weights are not splats'."""
    pre, flat = TurboDensityStrategy().step_pre_backward, {"means2d": torch.zeros(1, 40, 2)}
    assert_refused("takes no gradient, as from a render with with_ut", pre, {}, {}, {}, 0, flat)
    small = dict.fromkeys(("prediction", "ground_truth"), torch.zeros(CAMERAS, 5, 5, 3))
    words = r"of shape \(\d, 5, 5, 3\): expected \(\d, 24, 40, 3\), what gsplat"
    assert_refused(words, iteration_stats, stock(monkeypatch) | small, COUNT)
    late = {key: value for key, value in rendered_info().items() if key != "gaussian_stats"}
    assert_refused("put them in before loss.backward", iteration_stats, late, COUNT)
