"""Masks and backgrounds on the kernels: the draws, renders and losses of their torch twins."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.framework_runs import assert_iterations_wait_for_nothing, tiny_capture, tiny_config
from helpers.raster_cases import (
    GPU_ONLY,
    assert_forward_close,
    assert_records_close,
    make_case,
    on_gpu,
    samples_to,
    upstream,
)
from PIL import Image

from turbogs_plugin.captures import load_scene
from turbogs_plugin.engine.cuda import raster as cuda
from turbogs_plugin.engine.cuda import training as training_kernels
from turbogs_plugin.engine.protocol import MapUpdate
from turbogs_plugin.engine.reference.draws import draw_pixels
from turbogs_plugin.engine.reference.losses import sparse_loss
from turbogs_plugin.engine.reference.raster import rasterize_reference
from turbogs_plugin.engine.render_pass import RenderOptions
from turbogs_plugin.engine.rules import DrawRule
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.masks import PixelMasks
from turbogs_plugin.scene.photos import Photos
from turbogs_plugin.strategies.losses import CharbonnierNccLoss, SparseSsimLoss
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import Step

pytestmark = GPU_ONLY

DEVICE = torch.device("cuda")
SIZES = np.array([(40, 33), (16, 16), (7, 50), (128, 64), (21, 35)])
NOTHING = 4
COLOR = (0.9, 0.25, 0.5)


def masks(seed=0):
    """Noise, whole tiles and empty ones; one pixel; no mask; a half; nothing at all."""
    random = np.random.default_rng(seed)
    keep = [np.ones((height, width), dtype=bool) for width, height in SIZES]
    keep[0] = random.random(keep[0].shape) < 0.2
    keep[0][16:, 16:32], keep[0][:16, :16] = True, False
    keep[1][:] = False
    keep[1][7, 9] = True
    keep[3][:, :77] = False
    keep[NOTHING][:] = False
    return [torch.from_numpy(mask) for mask in keep]


def masked_maps(device, seed=0):
    generator = torch.Generator().manual_seed(seed)
    maps = ErrorMaps(SIZES, device, masks=PixelMasks.from_images(masks()))
    pixels = int(SIZES.prod(axis=1).sum())
    errors = 3 * torch.rand(pixels, generator=generator) ** 3
    errors[torch.rand(pixels, generator=generator) < 0.3] = 0
    maps.errors.copy_(errors.half())  # of masked pixels too, which have no part in a draw
    maps.stamps.copy_(torch.randint(-3, 6, (pixels,), generator=generator))
    return maps


@pytest.mark.parametrize("unit", ["pixel", "tile"])
@pytest.mark.parametrize("rate", [0.004, 0.1, 0.33, 1.0])
@pytest.mark.parametrize(
    ("hard", "stable", "uniform", "importance"),
    [(0.4, 0.3, False, 0.0), (0.0, 0.0, True, 0.0), (0.4, 0.3, False, 1.0), (0.0, 1.0, False, 0.0)],
)
@pytest.mark.parametrize("views", [(0,), (1,), (3, NOTHING, 1, 0, 2)])
def test_equal_sets(unit, rate, hard, stable, uniform, importance, views):
    importance *= unit == "pixel"
    rule, step = DrawRule(unit, hard, stable, uniform, importance), Step(9, 20, 10, 2**40 + 5)
    found = training_kernels.sample_pixels(rule, masked_maps(DEVICE), views, rate, step)
    expected = draw_pixels(rule, masked_maps("cpu"), views, rate, step)
    for name in ("tile_ids", "tile_offsets", "pixel_ids"):
        assert torch.equal(getattr(found, name).cpu(), getattr(expected, name)), name
    assert found.host_ends == expected.host_ends  # what several processes share the samples out by
    for known, asked in zip(found.host_ends(), replace(found, host_ends=None).ends(), strict=True):
        np.testing.assert_array_equal(known, asked)
    if importance:
        torch.testing.assert_close(found.weights.cpu(), expected.weights, rtol=2e-5, atol=0)


@pytest.mark.parametrize("unit", ["pixel", "tile"])
def test_a_view_masked_whole_gives_no_sample(unit):
    """And renders, learns and counts nothing, with and without a workspace."""
    maps = masked_maps(DEVICE)
    samples = training_kernels.sample_pixels(DrawRule(unit, 0.4, 0.3, False, 0.0), maps, (NOTHING,), 0.3, Step(0, 9, 5))
    assert len(samples) == len(samples.tile_ids) == 0 and samples.tile_offsets.tolist() == [0]
    case = make_case([tuple(SIZES[NOTHING])], count=50)
    rendered = cuda.rasterize_cuda(case.gpu_gaussians, case.gpu_cameras, samples)
    loss = training_kernels.sparse_loss(CharbonnierNccLoss().terms, rendered.colors, rendered.colors, samples)
    assert float(loss.loss) == 0.0
    gradients = rendered.backward(loss.color_gradients, loss.pixel_errors).parameter_gradients(rows=True)
    assert not gradients.means.any() and not gradients.touched.any()


@pytest.mark.parametrize("with_depth", [False, True])
@pytest.mark.parametrize("workspace", [False, True])
def test_a_background(with_depth, workspace):
    case = make_case([(130, 90), (65, 97)], count=300, rate=0.3, seed=4, empty_slots=3)
    options = RenderOptions(with_depth=with_depth, background=COLOR)
    memory = cuda.Workspace(DEVICE) if workspace else None
    found = cuda.rasterize_cuda(case.gpu_gaussians, case.gpu_cameras, case.gpu_samples, options, memory)
    expected = rasterize_reference(case.gaussians, case.cameras, case.samples, options)
    assert_forward_close(found.colors, expected.colors, "colors")
    values = upstream(case, with_depth)
    ours = found.backward(**on_gpu(values), with_statistics=True).full_records()
    theirs = expected.backward(**values, with_statistics=True).full_records()
    assert_records_close(ours, theirs)


@pytest.mark.parametrize(
    ("unit", "loss"), [("pixel", CharbonnierNccLoss()), ("tile", CharbonnierNccLoss()), ("tile", SparseSsimLoss())]
)
def test_the_loss_composites_transparent_photos(unit, loss):
    """The kernel gathers them as torch does, and learns the same errors.

    It composites by one fused multiply-add, torch by two roundings: a colour differs by 6e-8, and the Charbonnier
    term's gradient, steepest within its epsilon of 1e-3, by up to 6e-5 of its largest value.
    """
    generator = torch.Generator().manual_seed(1)
    pixels = int(SIZES.prod(axis=1).sum())
    colors = torch.randint(0, 256, (pixels, 4), generator=generator, dtype=torch.uint8)
    photos = Photos(torch.minimum(colors, colors[:, 3:]), SIZES)
    maps, step = masked_maps(DEVICE), Step(9, 20, 10)
    samples = training_kernels.sample_pixels(DrawRule(unit, 0.4, 0.3, False, 0.0), maps, (3, 0, 2), 0.4, step)
    truth = photos.to(DEVICE).at(samples, COLOR).colors()
    rendered = torch.rand(truth.shape, generator=generator).to(DEVICE)
    terms = loss.terms
    expected = training_kernels.sparse_loss(terms, rendered, truth, samples)
    given = {"update": MapUpdate(maps, step), "background": COLOR}
    found = training_kernels.sparse_loss(terms, rendered, photos.colors.to(DEVICE), samples, **given)
    largest = float(expected.color_gradients.abs().max())
    torch.testing.assert_close(found.color_gradients, expected.color_gradients, rtol=1e-5, atol=1e-4 * largest)
    torch.testing.assert_close(found.pixel_errors, expected.pixel_errors, rtol=1e-6, atol=5e-7)
    moved = samples_to(samples, "cpu")
    twin = sparse_loss(terms, rendered.cpu().double(), photos.at(moved, COLOR).colors().double(), moved)
    assert float(found.loss) == pytest.approx(float(twin.loss), rel=1e-5)
    masked = torch.cat([~mask.reshape(-1) for mask in masks()])
    assert torch.equal(maps.errors.cpu()[masked], masked_maps("cpu").errors[masked])


@pytest.fixture(scope="module")
def masked_capture(tmp_path_factory):
    capture = tiny_capture(tmp_path_factory.mktemp("gpu-masks"))
    (capture / "masks").mkdir()
    for photo in (capture / "images").iterdir():
        half = Image.new("L", (40, 24))
        half.paste(255, (0, 0, 20, 24))
        half.save(capture / "masks" / f"{photo.stem}.png")
    return load_scene(capture)


WEIGHTED = ("pixel_sampler.importance=0.5", "train.background=random")


@pytest.mark.parametrize("overrides", [(), ("pixel_sampler.unit=tile",), ("train.pixels_place=host",), WEIGHTED])
def test_training_with_masks_waits_for_nothing_and_learns_no_masked_pixel(masked_capture, overrides):
    config = tiny_config("capture", "train.device=cuda", "density.refine_from=1000", *overrides).without_plan()
    trainer = Trainer(config, masked_capture, DEVICE)
    assert_iterations_wait_for_nothing(trainer)
    assert_unmasked_alone_is_learnt(trainer)


def assert_unmasked_alone_is_learnt(trainer):
    errors, stamps = (trainer.state_dict()["maps"][name].cpu().view(7, 24, 40) for name in ("errors", "stamps"))
    assert not errors[:, :, 20:].any() and (stamps[:, :, 20:] == -1).all() and (stamps[:, :, :20] >= 0).any()
    assert all(value.isfinite().all() for _, value in trainer.gaussians.items())
