"""Sparse pixels behind gsplat's rasterization: values, gradients, `info`, and refusals."""

import gc
import weakref

import numpy as np
import pytest
import torch
from helpers.bridge_host import HEIGHT, WIDTH, arguments, make_cameras, make_splats
from helpers.gsplat_torch import gsplat_torch_render

from turbogs_plugin.engine.render import dense_samples
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.errors import InputError
from turbogs_plugin.gsplat_bridge import gather_pixels, sparse_loss, sparse_rasterization
from turbogs_plugin.gsplat_bridge.autograd import rasterize_differentiable
from turbogs_plugin.gsplat_bridge.gaussian_errors import iteration_stats, screen_statistics
from turbogs_plugin.strategies.losses import CharbonnierLoss, CharbonnierNccLoss
from turbogs_plugin.strategies.pixel_sampling import RandomPixelSampler
from turbogs_plugin.types import PARAMETER_NAMES, Gaussians, Step

GSPLAT_KEYS = {
    *("batch_ids", "camera_ids", "gaussian_ids", "radii", "means2d", "depths", "conics", "opacities", "tile_width"),
    *("tile_height", "tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets", "width", "height", "tile_size"),
    *("n_batches", "n_cameras"),
}


def sparse_samples(cameras, rate=0.2):
    maps = ErrorMaps(cameras.sizes, "cpu")
    return RandomPixelSampler().sample(maps, tuple(range(len(cameras))), rate, Step(3, 10, 10))


@pytest.fixture
def scene():
    cameras = make_cameras(2)
    return make_splats(), cameras, sparse_samples(cameras)


def test_values_and_gradients_are_those_of_the_rasterizer(scene):
    splats, cameras, samples = scene
    colors, alphas, info = sparse_rasterization(**arguments(splats, cameras), samples=samples, sh_degree=1)
    weights = torch.randn(colors.shape, generator=torch.Generator().manual_seed(0))
    ((colors * weights).sum() + (alphas[:, 0] * weights[:, 0]).sum()).backward()
    expected_splats = make_splats()
    raw = Gaussians(**{name: expected_splats[name] for name in PARAMETER_NAMES})
    expected = rasterize_differentiable(raw, cameras, samples, sh_degree=1)
    ((expected.colors * weights).sum() + (expected.alphas * weights[:, 0]).sum()).backward()
    torch.testing.assert_close(colors, expected.colors, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(alphas[:, 0], expected.alphas, atol=1e-5, rtol=1e-4)
    for name in PARAMETER_NAMES:
        assert splats[name].grad.norm() > 0
        torch.testing.assert_close(splats[name].grad, expected_splats[name].grad, atol=1e-4, rtol=1e-3)
    torch.testing.assert_close(info["means2d"].grad, expected.means2d.grad, atol=1e-4, rtol=1e-3)
    torch.testing.assert_close(info["means2d"].absgrad, expected.means2d.absgrad, atol=1e-4, rtol=1e-3)
    torch.testing.assert_close(info["radii"], expected.projected.radii)


@pytest.mark.parametrize("render_mode", ["ED", "RGB+ED"])
def test_depths_and_their_gradients_are_those_of_gsplats_torch_code(scene, render_mode):
    """Expected z along the camera's axis, as Ks has it; a background has no depth."""
    splats, cameras, samples = scene
    given = {**arguments(splats, cameras), "samples": samples, "sh_degree": 1, "backgrounds": torch.full((2, 3), 0.5)}
    shown, _, _ = sparse_rasterization(**given, render_mode=render_mode)
    weights = torch.randn(shown.shape, generator=torch.Generator().manual_seed(0))
    (shown * weights).sum().backward()
    expected_splats = make_splats()
    raw = Gaussians(**{name: expected_splats[name] for name in PARAMETER_NAMES})
    colors, alphas, depths = gsplat_torch_render(raw, cameras, samples, sh_degree=1)
    colors = (colors + 0.5 * (1 - alphas[:, None])) * samples.filled[:, None]
    expected = depths[:, None] if render_mode == "ED" else torch.cat([colors, depths[:, None]], dim=1)
    (expected * weights).sum().backward()
    assert shown.shape == (len(samples), 1 if render_mode == "ED" else 4) and depths.max() > 1.0
    torch.testing.assert_close(shown, expected, atol=1e-5, rtol=1e-4)
    for name in PARAMETER_NAMES:
        reference = expected_splats[name].grad
        if render_mode == "ED" and name in ("sh0", "shN"):
            assert not splats[name].grad.any() and (reference is None or not reference.any())
        else:
            assert reference.norm() > 0
            torch.testing.assert_close(splats[name].grad, reference, atol=2e-4, rtol=1e-3)


@pytest.mark.parametrize("retain_graph", [False, True])
def test_a_second_backward_is_refused(scene, retain_graph):
    splats, cameras, samples = scene
    colors, alphas, _ = sparse_rasterization(**arguments(splats, cameras), samples=samples, sh_degree=1)
    colors.sum().backward(retain_graph=retain_graph)
    with pytest.raises(InputError, match="sum the losses first"):
        alphas.sum().backward()


def test_info_has_gsplats_keys_and_shapes(scene):
    splats, cameras, samples = scene
    _, _, info = sparse_rasterization(**arguments(splats, cameras), samples=samples, sh_degree=1)
    count = len(splats["means"])
    assert set(info) == GSPLAT_KEYS
    shapes = {"means2d": (2, count, 2), "radii": (2, count, 2), "depths": (2, count), "conics": (2, count, 3)}
    assert {key: tuple(info[key].shape) for key in shapes} == shapes
    sizes = {"width": WIDTH, "height": HEIGHT, "tile_width": 3, "tile_height": 2, "n_cameras": 2, "n_batches": 1}
    assert {key: info[key] for key in sizes} == sizes
    assert info["gaussian_ids"] is None


def test_plain_colors_and_backgrounds(scene):
    splats, cameras, samples = scene
    given = {**arguments(splats, cameras), "colors": torch.sigmoid(splats["sh0"][:, 0])}
    black, alphas, _ = sparse_rasterization(**given, samples=samples)
    red = torch.tensor([[1.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    colors, _, _ = sparse_rasterization(**given, samples=samples, backgrounds=red)
    expected = black + (1 - alphas) * red[samples.view_of_slot()]
    filled = samples.filled
    torch.testing.assert_close(colors[filled], expected[filled])
    assert not colors[~filled].any()
    # One opaque Gaussian that covers everything has its own colour wherever it is seen.
    count = 1
    wall = {
        "means": torch.zeros(count, 3),
        "quats": torch.tensor([[1.0, 0, 0, 0]]),
        "scales": torch.full((count, 3), 5.0),
        "opacities": torch.ones(count),
        "colors": torch.tensor([[0.2, 0.4, 0.9]]),
    }
    colors, alphas, _ = sparse_rasterization(**{**given, **wall}, samples=samples)
    hit = alphas[:, 0] > 0.9
    assert hit.any()
    torch.testing.assert_close(colors[hit] / alphas[hit], wall["colors"].expand(int(hit.sum()), 3))


def test_planes_and_blur_reach_the_renderer(scene):
    splats, cameras, samples = scene
    given = {**arguments(splats, cameras), "samples": samples, "sh_degree": 1}
    _, _, everything = sparse_rasterization(**given)
    depths = splats["means"][:, 2] + 3.0
    near, far = depths.quantile(0.3).item(), depths.quantile(0.7).item()
    _, _, cut = sparse_rasterization(**given, near_plane=near, far_plane=far)
    between, drawn = (depths > near) & (depths < far), (everything["radii"] > 0).all(dim=-1)
    for side in (depths < near, depths > far, between):
        assert (drawn & side).any()
    assert torch.equal((cut["radii"] > 0).all(dim=-1), drawn & between)
    _, _, blurred = sparse_rasterization(**given, eps2d=1.0)
    covariances = []
    for info in (everything, blurred):
        a, b, c = info["conics"][drawn].unbind(dim=-1)
        covariances.append(torch.stack([c, -b, a], dim=-1) / (a * c - b * b)[:, None])
    expected = torch.tensor([0.7, 0.0, 0.7]).expand_as(covariances[0])  # 1 in the place of gsplat's 0.3
    torch.testing.assert_close(covariances[1] - covariances[0], expected, atol=5e-3, rtol=0)


def test_saturated_opacities_and_vanished_scales_have_finite_gradients(scene):
    splats, cameras, samples = scene
    with torch.no_grad():
        splats["opacities"][:5] = 100.0
        splats["scales"][5:8] = -200.0
    colors, _, _ = sparse_rasterization(**arguments(splats, cameras), samples=samples, sh_degree=1)
    colors.sum().backward()
    assert all(splats[name].grad.isfinite().all() for name in PARAMETER_NAMES)


@pytest.mark.parametrize("dense_images", [False, True])
def test_errors_in_info_become_statistics(scene, dense_images):
    splats, cameras, samples = scene
    colors, _, info = sparse_rasterization(**arguments(splats, cameras), samples=samples, sh_degree=1)
    images = torch.rand(2, HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(0))
    truth = gather_pixels(images, samples)
    if dense_images:
        prediction = torch.zeros_like(images)
        x, y = samples.coordinates().unbind(dim=-1)
        filled = samples.filled
        prediction[samples.view_of_slot()[filled], y[filled], x[filled]] = colors.detach()[filled]
        info.update(prediction=prediction, ground_truth=images)
    else:
        info.update(prediction=colors, ground_truth=truth)
    (colors - truth).abs().mean().backward()
    stats, has_errors = iteration_stats(info, len(splats["means"]))
    assert has_errors
    # Every pixel's weights sum to its alpha, so the sums over Gaussians are known from the pixels alone.
    _, alphas, _ = sparse_rasterization(**arguments(splats, cameras), samples=samples, sh_degree=1)
    alphas, errors = alphas.detach()[:, 0], (colors.detach() - truth).abs().sum(dim=-1)
    torch.testing.assert_close(stats.weight_sums.sum(), alphas.sum(), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(stats.error_sums.sum(), (alphas * errors).sum(), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(info["loss_shares"], stats.error_sums / samples.filled.sum())
    by_hand = screen_statistics(info, len(splats["means"]))
    for name in ("grad_sums", "absgrad_sums", "view_counts", "max_radii"):
        torch.testing.assert_close(getattr(stats, name), getattr(by_hand, name), rtol=1e-4, atol=1e-6)


def test_the_graph_does_not_keep_itself_alive(scene):
    splats, cameras, samples = scene
    gc.collect()
    gc.disable()
    try:
        colors, _, info = sparse_rasterization(**arguments(splats, cameras), samples=samples, sh_degree=1)
        info.update(prediction=colors, ground_truth=torch.zeros_like(colors))
        info_alive = weakref.ref(info)
        del colors, info
        assert info_alive() is None
    finally:
        gc.enable()


@pytest.mark.parametrize("loss", [CharbonnierLoss(), CharbonnierNccLoss()])
def test_sparse_loss_hands_its_own_gradient_to_autograd(scene, loss):
    _, _, samples = scene
    generator = torch.Generator().manual_seed(0)
    colors = torch.rand(len(samples), 3, generator=generator).requires_grad_()
    truth = torch.rand(len(samples), 3, generator=generator)
    value = sparse_loss(loss, colors, truth, samples)
    (3.0 * value).backward()
    expected = loss(colors.detach(), truth, samples)
    assert value.item() == pytest.approx(expected.loss.item())
    torch.testing.assert_close(colors.grad, 3.0 * expected.color_gradients)


class OwnLoss(torch.nn.Module):
    terms = None

    def forward(self, colors, targets, samples):
        return CharbonnierLoss()(colors, targets, samples)


@pytest.mark.parametrize("loss", [CharbonnierNccLoss(), OwnLoss()])
def test_sparse_loss_updates_the_maps_that_it_is_given(scene, loss):
    _, cameras, samples = scene
    generator = torch.Generator().manual_seed(0)
    colors, truth = (torch.rand(len(samples), 3, generator=generator) for _ in range(2))
    colors[5] = torch.nan
    given, expected = ErrorMaps(cameras.sizes), ErrorMaps(cameras.sizes)
    value = sparse_loss(loss, colors.requires_grad_(), truth, samples, given, Step(7, 10, 10))
    torch.testing.assert_close(value, sparse_loss(loss, colors, truth, samples), equal_nan=True)
    expected.update(samples, (colors.detach() - truth).abs().sum(dim=-1), Step(7, 10, 10))
    assert torch.equal(given.stamps, expected.stamps) and (given.stamps == 7).any()
    torch.testing.assert_close(given.errors, expected.errors)
    torch.testing.assert_close(given.view_sums, expected.view_sums)


def test_half_of_what_an_update_needs_is_refused(scene):
    _, cameras, samples = scene
    colors = torch.rand(len(samples), 3)
    maps, now = ErrorMaps(cameras.sizes), Step(0, 10, 10)
    with pytest.raises(InputError, match=r"^step is a NoneType: expected Step, as maps is given"):
        sparse_loss(CharbonnierLoss(), colors, colors, samples, maps)
    with pytest.raises(InputError, match=r"^maps is a Tensor: expected ErrorMaps, as step is given"):
        sparse_loss(CharbonnierLoss(), colors, colors, samples, maps.errors, now)
    elsewhere = ErrorMaps(cameras.sizes, "meta")
    with pytest.raises(InputError, match=r"^maps are on meta: expected cpu as colors"):
        sparse_loss(CharbonnierLoss(), colors, colors, samples, elsewhere, now)


def test_gather_pixels(scene):
    _, _, samples = scene
    images = torch.arange(2 * HEIGHT * WIDTH * 3, dtype=torch.float32).reshape(2, HEIGHT, WIDTH, 3)
    gathered = gather_pixels(images, samples).numpy()
    views, places = samples.view_of_slot().numpy(), samples.pixel_ids.numpy()
    for slot in range(0, len(samples), 7):
        wanted = images[views[slot], places[slot] // WIDTH, places[slot] % WIDTH].numpy() if places[slot] >= 0 else 0.0
        np.testing.assert_array_equal(gathered[slot], np.broadcast_to(wanted, 3))


REFUSED = [
    ({"packed": True}, r"packed=True is not supported, only False"),
    ({"rasterize_mode": "antialiased"}, r"rasterize_mode='antialiased' is not supported"),
    ({"sparse_grad": True}, r"sparse_grad=True is not supported"),
    ({"with_ut": True}, r"with_ut=True is not supported"),
    ({"camera_model": "fisheye"}, r"camera_model='fisheye' is not supported"),
    ({"render_mode": "D"}, r"render_mode='D' is not supported, only 'RGB', 'ED', 'RGB\+ED'"),
    ({"pack": False}, r"no option 'pack'"),
    ({"scales": torch.ones(3, 3)}, r"scales has shape \(3, 3\): expected \[40, 3\]"),
    ({"opacities": torch.ones(40, 1)}, r"opacities has shape \(40, 1\): expected \[40\]"),
    ({"colors": torch.ones(40, 3, 3)}, r"sh_degree 1 needs 4 bands: colors have 3"),
    ({"sh_degree": 0.5}, r"sh_degree is 0.5: expected a whole number"),
    ({"colors": torch.rand(2, 40, 3), "sh_degree": None}, r"expected \[N, 3\] without sh_degree"),
    ({"backgrounds": torch.ones(3)}, r"backgrounds has shape \(3,\): expected \[2, 3\]"),
    ({"means": torch.ones(40, 3).double()}, r"quats is of torch.float32 .*: expected torch.float64 on cpu"),
    ({"means": torch.ones(40, 3).half()}, r"means is of torch.float16: expected torch.float32 or torch.float64"),
    ({"quats": np.ones((40, 4))}, r"quats is a ndarray: expected a tensor"),
    ({"covars": torch.ones(40, 3, 3)}, r"covars=a tensor of shape \(40, 3, 3\) is not supported, only None"),
    ({"samples": None}, r"samples is a NoneType: expected the PixelSamples"),
    ({"width": 41}, r"samples are of 2 views .*expected 2, one for each of viewmats, all of \(41, 24\)"),
]


@pytest.mark.parametrize(("changed", "message"), REFUSED)
def test_what_does_not_fit_is_refused_by_name(scene, changed, message):
    splats, cameras, samples = scene
    with pytest.raises(InputError, match=message):
        sparse_rasterization(**{**arguments(splats, cameras), "samples": samples, "sh_degree": 1, **changed})


def test_a_degree_may_be_an_integer_of_numpy(scene):
    splats, cameras, samples = scene
    given = {**arguments(splats, cameras), "samples": samples}
    expected = sparse_rasterization(**given, sh_degree=1)[0]
    assert torch.equal(sparse_rasterization(**given, sh_degree=np.int64(1))[0], expected)


@pytest.mark.parametrize("name", ["viewmats", "Ks"])
def test_cameras_that_want_a_gradient_are_refused(scene, name):
    """A trainer's pose optimisation would train on without ever moving a camera."""
    splats, cameras, samples = scene
    given = arguments(splats, cameras)
    given[name] = given[name].clone().requires_grad_() * 1.0
    with pytest.raises(InputError, match=rf"{name} requires a gradient, .* pass {name}\.detach\(\)"):
        sparse_rasterization(**given, samples=samples, sh_degree=1)
    with torch.no_grad():
        sparse_rasterization(**given, samples=samples, sh_degree=1)


NO_LOSSES = {
    "the class CharbonnierNccLoss": CharbonnierNccLoss,
    "a function": lambda colors, targets, samples: (colors - targets).abs().mean(),
}


@pytest.mark.parametrize("name", NO_LOSSES)
def test_what_is_no_loss_on_samples_is_refused_by_name(scene, name):
    samples = scene[2]
    colors = torch.rand(len(samples), 3, requires_grad=True)
    with pytest.raises(InputError, match=rf"^loss is {name}: expected an instance .*CharbonnierNccLoss\(\)"):
        sparse_loss(NO_LOSSES[name], colors, torch.rand(len(samples), 3), samples)


def test_what_does_not_fit_the_samples_is_refused_by_name(scene):
    samples = scene[2]
    loss, count = CharbonnierNccLoss(), len(samples)
    colors = torch.rand(count, 3)
    with pytest.raises(InputError, match="samples is a NoneType: expected the PixelSamples"):
        sparse_loss(loss, colors, colors, None)
    with pytest.raises(InputError, match=r"images is a ndarray: expected a tensor \[C, H, W, D\]"):
        gather_pixels(np.zeros((2, HEIGHT, WIDTH, 3)), samples)
    images = torch.zeros(2, HEIGHT, WIDTH, 3)
    with pytest.raises(InputError, match=rf"targets is torch.uint8 .*: expected floating point \({count}, 3\)"):
        sparse_loss(loss, colors, colors.byte(), samples)
    with pytest.raises(InputError, match=r"colors is torch.float32 \(2, 24, 40, 3\): expected"):
        sparse_loss(loss, images, colors, samples)


def test_wrong_images_and_half_of_the_errors_are_refused(scene):
    splats, cameras, samples = scene
    with pytest.raises(InputError, match=r"images have shape \(2, 5, 5, 3\): expected"):
        gather_pixels(torch.zeros(2, 5, 5, 3), samples)
    colors, _, info = sparse_rasterization(**arguments(splats, cameras), samples=samples, sh_degree=1)
    info["prediction"] = colors
    with pytest.raises(InputError, match=r"info has no 'ground_truth'"):
        colors.sum().backward()
    info["ground_truth"] = torch.zeros(4, 3)
    colors, _, other = sparse_rasterization(**arguments(splats, cameras), samples=samples, sh_degree=1)
    other.update(prediction=colors[:4], ground_truth=torch.zeros(4, 3))
    with pytest.raises(InputError, match="as there are samples"):
        colors.sum().backward()


def test_without_gradients_nothing_is_recorded(scene):
    splats, cameras, samples = scene
    with torch.no_grad():
        colors, _, info = sparse_rasterization(**arguments(splats, cameras), samples=samples, sh_degree=1)
    assert not colors.requires_grad and not info["means2d"].requires_grad


def test_dense_samples_are_the_image(scene):
    splats, cameras, samples = scene
    with torch.no_grad():
        every, _, _ = sparse_rasterization(**arguments(splats, cameras), samples=dense_samples(cameras), sh_degree=1)
        some, _, _ = sparse_rasterization(**arguments(splats, cameras), samples=samples, sh_degree=1)
    order = dense_samples(cameras)
    places = order.view_of_slot() * WIDTH * HEIGHT + order.pixel_ids.long()
    images = torch.zeros_like(every).index_copy(0, places, every).reshape(2, HEIGHT, WIDTH, 3)
    torch.testing.assert_close(gather_pixels(images, samples), some, atol=1e-6, rtol=1e-5)
