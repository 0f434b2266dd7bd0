"""Options of gsplat's trainer that change a render or its errors work beside the swaps."""

import gsplat
import pytest
import torch
from helpers.bridge_host import HEIGHT, WIDTH, Host, arguments, make_cameras, make_splats
from helpers.gsplat_stand_ins import CAMERAS, COUNT, rendered_info, stand_in, stock_info

from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.errors import InputError
from turbogs_plugin.gsplat_bridge import (
    TurboDensityStrategy,
    gather_pixels,
    sparse_loss,
    sparse_rasterization,
)
from turbogs_plugin.gsplat_bridge.gaussian_errors import iteration_stats
from turbogs_plugin.strategies.losses import CharbonnierNccLoss
from turbogs_plugin.strategies.pixel_sampling import RandomPixelSampler
from turbogs_plugin.types import Cameras, Step


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


@pytest.mark.parametrize("option", ["bilateral_grid", "random_bkgd", "RGB+D"])
def test_a_prediction_that_the_host_changed_still_drives_density(monkeypatch, option):
    info = stock(monkeypatch)
    seen = info["prediction"]
    with_depth = torch.cat([seen, seen[..., :1]], dim=-1)
    if option == "RGB+D":
        with pytest.raises(InputError, match=r"expected both \[C, H, W, 3\]"):
            densified({**info, "prediction": with_depth})
    changed = {
        "bilateral_grid": seen @ torch.diag(torch.tensor([1.1, 0.9, 1.0])),
        "random_bkgd": seen + torch.tensor([0.1, 0.2, 0.3]),
        "RGB+D": with_depth[..., :3],
    }
    densified({**info, "prediction": changed[option]})


def test_patches_of_another_image_at_each_step():
    host = Host(TurboDensityStrategy(refine_start_iter=1, refine_every=2, grow_grad2d=1e-6))
    for step in range(3):
        host.cameras = Cameras(host.cameras.viewmats, host.cameras.Ks.clone(), host.cameras.sizes)
        host.cameras.Ks[:, :2, 2] -= 3.0
        host.step(step)
    assert len(host.splats["means"]) != 40


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


def test_a_render_whose_screen_means_take_no_gradient_is_refused():
    host = Host(TurboDensityStrategy())
    with pytest.raises(InputError, match="takes no gradient, as from a render with with_ut"):
        host.strategy.step_pre_backward(host.splats, host.optimizers, host.state, 0, {"means2d": torch.zeros(1, 40, 2)})


@pytest.mark.parametrize("option", ["bilateral_grid", "random_bkgd"])
def test_sparse_pixels_train_with_what_the_host_adds_to_them(option):
    splats, cameras = make_splats(), make_cameras(CAMERAS)
    samples = RandomPixelSampler().sample(ErrorMaps(cameras.sizes), (0, 1), 0.3, Step(0, 9, 9))
    images = torch.rand(CAMERAS, HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(0))
    colors, alphas, _ = sparse_rasterization(**arguments(splats, cameras), samples=samples, sh_degree=1)
    grid = torch.ones(CAMERAS, 3, HEIGHT // 8, WIDTH // 8, requires_grad=True)  # a learnt gain for each view and place
    if option == "bilateral_grid":
        x, y = samples.coordinates().unbind(dim=-1)
        colors = colors * grid[samples.view_of_slot(), :, y // 8, x // 8]  # [P, 3]
    else:
        colors = colors + torch.rand(1, 3) * (1.0 - alphas)
    sparse_loss(CharbonnierNccLoss(), colors, gather_pixels(images, samples), samples).backward()
    assert all(value.grad.any() and value.grad.isfinite().all() for value in splats.values())
    assert option != "bilateral_grid" or grid.grad.any()
