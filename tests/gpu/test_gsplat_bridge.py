"""The swaps in front of gsplat's own kernels, and our rasterizer in the place of gsplat's."""

import pytest
import torch
from gsplat import MCMCStrategy, rasterization
from helpers.bridge_host import HEIGHT, WIDTH, arguments, make_cameras, make_splats, optimizers_of
from helpers.raster_cases import GPU_ONLY

from turbogs_plugin.engine.render import dense_samples
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.gsplat_bridge import (
    SharedOptimizer,
    TurboDensityStrategy,
    TurboStep,
    sparse_loss,
    sparse_rasterization,
)
from turbogs_plugin.gsplat_bridge.gaussian_errors import iteration_stats
from turbogs_plugin.strategies.losses import CharbonnierNccLoss
from turbogs_plugin.strategies.optimizers.moment_lm import MomentLMOptimizer
from turbogs_plugin.strategies.optimizers.sparse_adam import SparseAdam
from turbogs_plugin.strategies.pixel_sampling import ErrorGuidedPixelSampler
from turbogs_plugin.types import PARAMETER_NAMES, GaussianStats, Step

pytestmark = GPU_ONLY

COUNT = 400


def splats_on_gpu(seed: int = 0) -> torch.nn.ParameterDict:
    return make_splats(COUNT, seed, device="cuda")


def relative(actual: torch.Tensor, expected: torch.Tensor) -> float:
    return float((actual - expected).norm() / expected.norm())


def truth(cameras) -> torch.Tensor:
    """[C, H, W, 3] what other Gaussians look like, by gsplat."""
    with torch.no_grad():
        return rasterization(**arguments(splats_on_gpu(1), cameras), sh_degree=1, packed=False)[0]


def by_gsplat(splats, cameras, packed: bool = False):
    """Images, and `info` with the errors in it, after a backward pass of gsplat's rasterizer."""
    pixels = truth(cameras)
    colors, _, info = rasterization(**arguments(splats, cameras), sh_degree=1, packed=packed, absgrad=True)
    info["means2d"].retain_grad()
    info.update(prediction=colors, ground_truth=pixels)
    (colors - pixels).square().mean().backward()
    return colors, info


def by_ours(splats, cameras):
    """The same by our rasterizer, dense."""
    pixels, samples = truth(cameras), dense_samples(cameras)
    colors, _, info = sparse_rasterization(**arguments(splats, cameras), samples=samples, sh_degree=1)
    places = samples.view_of_slot() * WIDTH * HEIGHT + samples.pixel_ids.long()
    images = torch.zeros_like(colors).index_copy(0, places, colors).reshape(-1, HEIGHT, WIDTH, 3)
    info.update(prediction=images, ground_truth=pixels)
    (images - pixels).square().mean().backward()
    return images, info


def test_images_gradients_and_info_are_gsplats():
    cameras = make_cameras(2, "cuda")
    theirs, ours = splats_on_gpu(), splats_on_gpu()
    their_images, their_info = by_gsplat(theirs, cameras)
    our_images, our_info = by_ours(ours, cameras)
    assert relative(our_images, their_images) < 1e-4
    for name in PARAMETER_NAMES:
        assert relative(ours[name].grad, theirs[name].grad) < 2e-3, name
    visible = (their_info["radii"] > 0).all(dim=-1)
    assert ((our_info["radii"] > 0).all(dim=-1) == visible).float().mean() > 0.99
    assert relative(our_info["means2d"].grad, their_info["means2d"].grad) < 2e-3
    assert relative(our_info["means2d"].absgrad, their_info["means2d"].absgrad) < 2e-3
    for name in ("depths", "conics"):
        assert relative(our_info[name][visible], their_info[name][visible]) < 1e-4


def test_one_launch_computes_the_loss_and_updates_the_maps():
    """Large views: a sum of errors is of many tiles."""
    generator = torch.Generator().manual_seed(0)
    sampler, now = ErrorGuidedPixelSampler(), Step(7, 10, 10)
    found, expected = (
        ErrorMaps.from_images(torch.rand(2, 300, 400, generator=torch.Generator().manual_seed(1)).cuda())
        for _ in range(2)
    )
    samples = sampler.sample(expected, (1, 0), 0.25, now)
    colors, truth = (torch.rand(len(samples), 3, generator=generator).cuda() for _ in range(2))
    value = sparse_loss(CharbonnierNccLoss(), colors.requires_grad_(), truth, samples, found, now)
    torch.testing.assert_close(value, sparse_loss(CharbonnierNccLoss(), colors, truth, samples))
    expected.update(samples, (colors.detach() - truth).abs().sum(dim=-1), now)
    assert torch.equal(found.stamps, expected.stamps)
    torch.testing.assert_close(found.errors, expected.errors)
    torch.testing.assert_close(found.view_sums, expected.view_sums, rtol=1e-5, atol=0)


@pytest.mark.parametrize("packed", [False, True])
def test_the_zero_channel_gives_our_error_sums(packed):
    cameras = make_cameras(2, "cuda")
    _, our_info = by_ours(splats_on_gpu(), cameras)
    splats = splats_on_gpu()
    _, their_info = by_gsplat(splats, cameras, packed)
    gradient = splats["means"].grad.clone()
    (expected, _), (actual, has_errors) = (iteration_stats(info, COUNT) for info in (our_info, their_info))
    assert has_errors
    for name in GaussianStats.__dataclass_fields__:
        if name not in ("distance_sums", "square_sums"):
            assert relative(getattr(actual, name), getattr(expected, name)) < 5e-3, name
    assert torch.equal(splats["means"].grad, gradient)


def train(strategy, optimizer_class, packed: bool, tells_errors: bool, steps: int = 12) -> tuple[list[float], dict]:
    """gsplat's loop over its own rasterizer; gives the losses and the parameters. Rows must match after every step."""
    cameras, splats = make_cameras(2, "cuda"), splats_on_gpu()
    pixels = truth(cameras)
    optimizers = optimizers_of(splats, optimizer_class)
    strategy.check_sanity(splats, optimizers)
    state = strategy.initialize_state()
    extra = {"lr": 1e-5} if isinstance(strategy, MCMCStrategy) else {"packed": packed}
    losses = []
    for step in range(steps):
        absgrad = getattr(strategy, "absgrad", False)
        colors, _, info = rasterization(**arguments(splats, cameras), sh_degree=1, packed=packed, absgrad=absgrad)
        strategy.step_pre_backward(params=splats, optimizers=optimizers, state=state, step=step, info=info)
        if tells_errors:
            info.update(prediction=colors, ground_truth=pixels)
        loss = torch.nn.functional.l1_loss(colors, pixels)
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        strategy.step_post_backward(params=splats, optimizers=optimizers, state=state, step=step, info=info, **extra)
        losses.append(float(loss.detach()))
        count = len(splats["means"])
        for name, parameter in splats.items():
            values = optimizers[name].state[parameter].items()
            assert len(parameter) == count and all(len(value) == count for key, value in values if key != "step")
    return losses, splats


SOON = {"refine_start_iter": 2, "refine_every": 3, "refine_stop_iter": 5}


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("tells_errors", [False, True])
@pytest.mark.parametrize("optimizer_class", ["torch", "adam", "lm"])
def test_swaps_train_over_gsplats_rasterizer(packed, tells_errors, optimizer_class):
    made = {
        "torch": lambda: torch.optim.Adam,
        "adam": lambda: SharedOptimizer(SparseAdam()),
        "lm": lambda: SharedOptimizer(MomentLMOptimizer()),
    }[optimizer_class]()
    strategy = TurboDensityStrategy(**SOON, grow_grad2d=1e-6, grow_absgrad2d=1e-6)
    losses, splats = train(strategy, made, packed, tells_errors, steps=20)
    assert losses[-1] < losses[0] and len(splats["means"]) > COUNT


@pytest.mark.parametrize("rule", [SparseAdam, MomentLMOptimizer])
def test_relocation_works_on_shared_optimizers(rule):
    strategy = MCMCStrategy(**{**SOON, "refine_stop_iter": 100}, cap_max=COUNT + 30, min_opacity=0.3)
    losses, splats = train(strategy, SharedOptimizer(rule()), packed=False, tells_errors=False)
    assert len(splats["means"]) == COUNT + 30
    assert all(value.isfinite().all() for value in splats.values())
    assert all(loss == loss for loss in losses)


def test_a_whole_step_whose_loss_is_read_waits_for_nothing():
    """A trainer shows the loss at every step: by then it lies on the host."""
    cameras, photos = make_cameras(3), 255 * truth(make_cameras(3, "cuda")).cpu()
    poses = torch.linalg.inv(cameras.viewmats)
    views = [{"image": photos[i], "K": cameras.Ks[i], "camtoworld": poses[i]} for i in range(3)]
    options = ("train.backdrop=false", "density.refine_from=4000")
    turbo = TurboStep(splats_on_gpu(), views, max_steps=200, overrides=options)
    seen = [float(turbo.step(step).loss) for step in range(40)]
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        seen += [float(turbo.step(step).loss) for step in range(40, 44)]
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert 0 < seen[-1] < seen[0]
