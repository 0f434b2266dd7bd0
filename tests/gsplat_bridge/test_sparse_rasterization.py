"""Sparse pixels behind gsplat's rasterization: values, gradients, `info`, and refusals."""

import gc
import weakref

import numpy as np
import pytest
import torch
from helpers.bridge_host import HEIGHT, WIDTH, arguments, make_cameras, make_splats
from helpers.gsplat_torch import gsplat_torch_render
from helpers.refusals import assert_refused

from turbogs_plugin.engine.render import dense_samples
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.gsplat_bridge import gather_pixels, sparse_loss, sparse_rasterization
from turbogs_plugin.gsplat_bridge.gaussian_errors import iteration_stats, screen_statistics
from turbogs_plugin.strategies.losses import CharbonnierLoss, CharbonnierNccLoss
from turbogs_plugin.strategies.pixel_sampling import ErrorGuidedPixelSampler, RandomPixelSampler
from turbogs_plugin.types import PARAMETER_NAMES, Gaussians, Step

GSPLAT_KEYS = {
    *("batch_ids", "camera_ids", "gaussian_ids", "radii", "means2d", "depths", "conics", "opacities", "tile_width"),
    *("tile_height", "tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets", "width", "height", "tile_size"),
    *("n_batches", "n_cameras"),
}


@pytest.fixture
def scene():
    cameras = make_cameras(2)
    samples = RandomPixelSampler().sample(ErrorMaps(cameras.sizes, "cpu"), (0, 1), 0.2, Step(3, 10, 10))
    return make_splats(), cameras, samples


@pytest.mark.parametrize("render_mode", ["ED", "RGB+ED"])
def test_values_and_gradients_are_those_of_gsplats_torch_code(scene, render_mode):
    """Expected z along the camera's axis, as Ks has it; a background has no depth."""
    splats, cameras, samples = scene
    given = {**arguments(splats, cameras), "samples": samples, "sh_degree": 1, "backgrounds": torch.full((2, 3), 0.5)}
    shown, seen, info = sparse_rasterization(**given, render_mode=render_mode)
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
    torch.testing.assert_close(seen[:, 0], alphas, atol=1e-5, rtol=1e-4)
    assert info["means2d"].grad.any() and (info["means2d"].absgrad >= info["means2d"].grad.abs() - 1e-6).all()
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
    assert_refused("sum the losses first", alphas.sum().backward)


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
    grey, _, _ = sparse_rasterization(**{**given, "colors": torch.full((40, 3), 0.3)}, samples=samples)
    torch.testing.assert_close(grey, 0.3 * alphas.expand(-1, 3))


def test_planes_and_blur_reach_the_renderer(scene):
    splats, cameras, samples = scene
    given = {**arguments(splats, cameras), "samples": samples, "sh_degree": 1}
    _, _, everything = sparse_rasterization(**given)
    depths = splats["means"][:, 2] + 3.0
    near, far = depths.quantile(0.3).item(), depths.quantile(0.7).item()
    _, _, cut = sparse_rasterization(**given, near_plane=near, far_plane=far)
    between, drawn = (depths > near) & (depths < far), (everything["radii"] > 0).all(dim=-1)
    assert (drawn & ~between).any() and torch.equal((cut["radii"] > 0).all(dim=-1), drawn & between)
    _, _, blurred = sparse_rasterization(**given, eps2d=1.0)
    a, b, c = torch.stack([info["conics"][drawn] for info in (everything, blurred)]).unbind(dim=-1)
    variances = c / (a * c - b * b)
    torch.testing.assert_close(variances[1] - variances[0], torch.full_like(a[0], 0.7), atol=5e-3, rtol=0)  # 1 for 0.3


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


def test_a_splat_without_an_area_is_not_drawn():
    """Its determinant is 0 in single precision, where nothing widens it: no gradient is NaN, as in the kernels. A
    host's autocast changes nothing."""
    splats, cameras = make_splats(), make_cameras(1)
    splats["scales"].data[:5] = -45.0
    options, found = {"samples": dense_samples(cameras), "sh_degree": 1, "eps2d": 0.0}, []
    for cast in (False, True):
        with torch.autocast("cpu", enabled=cast):
            colors, _, info = sparse_rasterization(**arguments(splats, cameras), **options)
            found.append([colors, *torch.autograd.grad(colors.square().sum(), list(splats.values()))])
    assert not info["radii"][0, :5].any() and all(value.isfinite().all() for value in found[0])
    assert all(torch.equal(*pair) for pair in zip(*found, strict=True))


def test_gather_pixels(scene):
    sampler = ErrorGuidedPixelSampler(unit="tile")  # leaves slots empty
    samples = sampler.sample(ErrorMaps(scene[1].sizes, "cpu"), (0, 1), 0.5, Step(3, 10, 10))
    images = torch.arange(2 * HEIGHT * WIDTH * 3, dtype=torch.float32).reshape(2, HEIGHT, WIDTH, 3)
    images[:, 0, 0] = torch.nan
    gathered = gather_pixels(images, samples).numpy()
    views, places = samples.view_of_slot().numpy(), samples.pixel_ids.numpy()
    for slot in range(0, len(samples), 7):
        wanted = images[views[slot], places[slot] // WIDTH, places[slot] % WIDTH].numpy() if places[slot] >= 0 else 0.0
        np.testing.assert_array_equal(gathered[slot], np.broadcast_to(wanted, 3))


REFUSED = [
    ({"packed": True}, r"packed=True is not supported, only False"),
    ({"render_mode": "D"}, r"render_mode='D' is not supported, only \('RGB', 'ED', 'RGB\+ED'\)"),
    ({"pack": False}, r"no option 'pack': did you mean 'packed'"),
    ({"global_z_order": False}, r"global_z_order=False is not supported, only True"),
    ({"tile_size": 8}, r"tile_size=8 is not supported, only 16"),
    ({"scales": torch.ones(3, 3)}, r"scales has shape \(3, 3\): expected \[40, 3\]"),
    ({"colors": torch.ones(40, 3, 3)}, r"sh_degree 1 needs 4 bands: colors have 3"),
    ({"sh_degree": 0.5}, r"sh_degree is 0.5: expected a whole number"),
    ({"colors": torch.rand(2, 40, 3), "sh_degree": None}, r"expected \[N, 3\] without sh_degree"),
    ({"backgrounds": torch.ones(3)}, r"backgrounds has shape \(3,\): expected \[2, 3\]"),
    ({"means": torch.ones(40, 3).double()}, r"quats is of torch.float32 .*: expected torch.float64 on cpu"),
    ({"means": torch.ones(40, 3).half()}, r"means is of torch.float16: expected torch.float32 or torch.float64"),
    ({"viewmats": np.zeros((2, 4, 4), np.float32)}, r"viewmats is ndarray: expected a tensor, by torch.from_numpy"),
    ({"colors": [[0.5] * 3] * 40}, r"colors is list: expected a tensor"),
    ({"covars": torch.ones(40, 3, 3)}, r"covars=a tensor of shape \(40, 3, 3\) is not supported, only None"),
    ({"samples": None}, r"samples is a NoneType: expected the PixelSamples"),
    ({"width": 41}, r"samples are of 2 views .*expected 2, one for each of viewmats, all of \(41, 24\)"),
]


@pytest.mark.parametrize(("changed", "words"), REFUSED)
def test_what_does_not_fit_is_refused_by_name(scene, changed, words):
    splats, cameras, samples = scene
    given = {**arguments(splats, cameras), "samples": samples, "sh_degree": 1, **changed}
    assert_refused(words, sparse_rasterization, **given)


def test_what_gsplat_and_its_main_branch_do_by_default_is_taken(scene):
    splats, cameras, samples = scene
    asked = {"tile_size": None, "channel_chunk": 32, "global_z_order": True, "return_normals": False, "rays": None}
    asked |= {"extra_signals": None, "renderer_config": None, "ut_params": None, "radius_clip": 0}
    given = {**arguments(splats, cameras), "samples": samples, "sh_degree": 1}
    assert torch.equal(sparse_rasterization(**given, **asked)[0], sparse_rasterization(**given)[0])


@pytest.mark.parametrize("name", ["viewmats", "Ks"])
def test_cameras_that_want_a_gradient_are_refused(scene, name):
    """A trainer's pose optimisation would train on without ever moving a camera."""
    splats, cameras, samples = scene
    given = {**arguments(splats, cameras), "samples": samples, "sh_degree": 1}
    given[name] = given[name].clone().requires_grad_() * 1.0
    assert_refused(rf"{name} requires a gradient, .* pass {name}\.detach\(\)", sparse_rasterization, **given)
    with torch.no_grad():
        sparse_rasterization(**given)


def test_what_does_not_fit_the_samples_is_refused_by_name(scene):
    splats, cameras, samples = scene
    colors, count = torch.rand(len(samples), 3), len(samples)
    loss, maps, now = CharbonnierNccLoss(), ErrorMaps(cameras.sizes), Step(0, 10, 10)
    images = torch.zeros(2, HEIGHT, WIDTH, 3)
    refused = {
        "samples is a NoneType: expected the PixelSamples": (loss, colors, colors, None),
        rf"targets is torch.uint8 .*: .* floating point \({count}, 3\)": (loss, colors, colors.byte(), samples),
        r"loss is the class CharbonnierLoss: expected an instance": (CharbonnierLoss, colors, colors, samples),
        r"loss takes no \(colors, targets, samples\)": (torch.nn.L1Loss(), colors, colors, samples),
        r"maps and step are ErrorMaps and NoneType: .* both or neither": (loss, colors, colors, samples, maps),
        r"maps are on meta: expected cpu": (loss, colors, colors, samples, ErrorMaps(cameras.sizes, "meta"), now),
    }
    for words, given in refused.items():
        assert_refused(f"^{words}", sparse_loss, *given)
    for wrong in (images.numpy(), images[:, :5]):
        assert_refused(r"expected a tensor \[C, H, W, D\]", gather_pixels, wrong, samples)
    few = {"prediction": colors[:4], "ground_truth": colors[:4]}
    for words, given in {"no 'ground_truth'": {"prediction": colors}, "as there are samples": few}.items():
        shown, _, info = sparse_rasterization(**arguments(splats, cameras), samples=samples, sh_degree=1)
        info.update(given)
        assert_refused(words, shown.sum().backward)
