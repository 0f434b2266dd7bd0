"""The zero channel's arithmetic, over a compositor in plain torch that stands for gsplat's, which needs a GPU."""

import gsplat
import pytest
import torch
from helpers.bridge_host import HEIGHT, WIDTH, arguments, make_cameras, make_splats
from turbogs_plugin.strategies.optimizers.moment_lm import MomentLMOptimizer

from turbogs_plugin.engine.rendering import dense_samples
from turbogs_plugin.errors import InputError
from turbogs_plugin.gsplat_bridge import SharedOptimizer, TurboDensityStrategy, sparse_rasterization
from turbogs_plugin.gsplat_bridge.gaussian_errors import iteration_stats, loss_shares

COUNT, CAMERAS = 40, 2


def composite(means2d, conics, colors, opacities, order):
    """[H, W, D] one image: splats [S, ...] drawn in this order, as gsplat defines it."""
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    image = torch.zeros(HEIGHT, WIDTH, colors.shape[-1])
    through = torch.ones(HEIGHT, WIDTH)
    ended = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    for splat in order.tolist():
        dx, dy = means2d[splat, 0] - x, means2d[splat, 1] - y
        a, b, c = conics[splat]
        alpha = (opacities[splat] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)).clamp(max=0.999)
        alpha = torch.where(alpha < 1 / 255, 0.0, alpha)
        ended = ended | (through * (1 - alpha) <= 1e-4)
        alpha = torch.where(ended, 0.0, alpha)
        image = image + (through * alpha)[..., None] * colors[splat]
        through = through * (1 - alpha)
    return image


def stand_in(camera_of):
    """`gsplat.rasterize_to_pixels`; `camera_of`: [entries] camera of each row of the flattened arrays."""

    def rasterize_to_pixels(
        means2d, conics, colors, opacities, width, height, tile_size, isect_offsets, flatten_ids, packed
    ):
        assert (width, height, tile_size) == (WIDTH, HEIGHT, 16) and packed == (means2d.dim() == 2)
        flat = [value.reshape(-1, *value.shape[value.dim() - tail :]) for value, tail in ((means2d, 1), (conics, 1))]
        flat += [colors.reshape(-1, colors.shape[-1]), opacities.reshape(-1)]
        images = [composite(*flat, flatten_ids[camera_of[flatten_ids] == camera]) for camera in range(CAMERAS)]
        return torch.stack(images), None

    return rasterize_to_pixels


def stock_info(info, packed: bool):
    """What gsplat's rasterization would have left in `info`, from ours: the order of drawing, and packed on wish."""
    visible = (info["radii"] > 0).all(dim=-1)
    cameras, gaussians = torch.where(visible)
    by_depth = torch.argsort(info["depths"][visible])
    if packed:
        stock = {key: info[key].detach()[visible] for key in ("means2d", "radii", "conics", "opacities")}
        stock |= {"gaussian_ids": gaussians, "flatten_ids": by_depth}
        stock["means2d"].grad = info["means2d"].grad[visible]
        stock["means2d"].absgrad = info["means2d"].absgrad[visible]
        camera_of = cameras
    else:
        stock = {"flatten_ids": (cameras * COUNT + gaussians)[by_depth]}
        camera_of = torch.arange(CAMERAS).repeat_interleave(COUNT)
    stock = {**info, **stock, "isect_offsets": torch.zeros(CAMERAS, 2, 3)}
    for ours in ("gaussian_stats", "loss_shares"):
        del stock[ours]
    return stock, camera_of


@pytest.fixture
def rendered():
    splats, cameras = make_splats(COUNT), make_cameras(CAMERAS)
    samples = dense_samples(cameras)
    colors, _, info = sparse_rasterization(**arguments(splats, cameras), samples=samples, sh_degree=1)
    places = samples.view_of_slot() * WIDTH * HEIGHT + samples.pixel_ids.long()
    images = torch.zeros_like(colors).index_copy(0, places, colors).reshape(-1, HEIGHT, WIDTH, 3)
    truth = torch.rand(images.shape, generator=torch.Generator().manual_seed(0))
    info.update(prediction=images, ground_truth=truth)
    (images - truth).abs().mean().backward()
    return info


@pytest.mark.parametrize("packed", [False, True])
def test_it_gives_the_sums_that_our_rasterizer_gives(rendered, packed, monkeypatch):
    info, camera_of = stock_info(rendered, packed)
    monkeypatch.setattr(gsplat, "rasterize_to_pixels", stand_in(camera_of))
    (expected, _), (actual, has_errors) = iteration_stats(rendered, COUNT), iteration_stats(info, COUNT)
    assert has_errors and expected.error_sums.sum() > 1
    for name in ("error_sums", "weight_sums", "grad_sums", "absgrad_sums", "view_counts", "max_radii"):
        torch.testing.assert_close(getattr(actual, name), getattr(expected, name), rtol=2e-3, atol=2e-3)
    assert not actual.distance_sums.any()
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
