"""The CUDA loss equals its torch twins, updates the maps as `ErrorMaps.update` does, and keeps bad colours out."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.raster_cases import GPU_ONLY, on_side_stream, samples_to

from turbogs_plugin.engine.cuda import training as training_kernels
from turbogs_plugin.engine.protocol import MapUpdate
from turbogs_plugin.engine.reference.draws import draw_pixels
from turbogs_plugin.engine.reference.losses import sparse_loss
from turbogs_plugin.engine.rules import DrawRule
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.scene.depths import CELL, DepthPair, InverseDepths
from turbogs_plugin.strategies.losses import CharbonnierLoss, CharbonnierNccLoss, SparseSsimLoss
from turbogs_plugin.types import Step

pytestmark = GPU_ONLY

DEVICE = "cuda"
SIZES = np.array([(40, 33), (20, 17), (64, 48)], dtype=np.int64)
STEP = Step(iteration=12, total=100, refine_until=70, seed=3)

DRAWS = [(0.1, "pixel", 0.5), (0.3, "pixel", 0.0), (1.0, "pixel", 1.0), (1.0, "tile", 0.0), (1.0, "emptied", 0.0)]
CASES = {
    "l1": CharbonnierLoss(),
    "ncc": CharbonnierNccLoss(),
    "ssim": SparseSsimLoss(),
    "printed": CharbonnierNccLoss(structure="printed_ncc", variance_constant=1e-6),
}


def make_maps(device, seed=0):
    generator = torch.Generator().manual_seed(seed)
    images = [3 * torch.rand(int(h), int(w), generator=generator) ** 2 for w, h in SIZES]
    return ErrorMaps.from_images([image.to(device) for image in images])


def make_samples(rate, unit="pixel", importance=0.0):
    """`unit`: "emptied" for whole tiles of which the first has no sample and the second one."""
    rule = DrawRule("pixel" if unit == "pixel" else "tile", 0.4, 0.3, False, importance)
    samples = draw_pixels(rule, make_maps("cpu"), (2, 0), rate, Step(3, 4, 4))
    if unit == "emptied":
        samples.pixel_ids[: samples.tile_offsets[1]] = -1
        samples.pixel_ids[samples.tile_offsets[1] + 1 : samples.tile_offsets[2]] = -1
    return samples


def make_colors(samples, seed=0):
    """Predictions and uint8 photos; some tiles constant in one or both, where NCC has no information."""
    generator = torch.Generator().manual_seed(seed)
    photos = torch.randint(0, 256, (int(SIZES.prod(axis=1).sum()), 3), generator=generator, dtype=torch.uint8)
    photos[: 40 * 16] = 200
    offsets = np.concatenate([[0], np.cumsum(SIZES.prod(axis=1))])
    starts = torch.as_tensor(offsets[list(samples.view_ids)])
    flat = starts[samples.view_of_slot()] + samples.pixel_ids.long().clamp(min=0)
    targets = photos[flat].float().div(255.0) * samples.filled[:, None]
    colors = targets + 0.1 * torch.randn(targets.shape, generator=generator)
    colors[:40] = targets[:40]
    colors = colors * samples.filled[:, None]
    return colors, targets, photos


def on_kernels(terms, colors, truth, samples, **extra):
    """The kernels' loss."""
    return training_kernels.sparse_loss(
        terms, colors.to(DEVICE), truth.to(DEVICE), samples_to(samples, DEVICE), **extra
    )


def relative(found, expected):
    return float((found.double().cpu() - expected.double()).norm() / expected.double().norm().clamp(min=1e-30))


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize(("rate", "unit", "importance"), DRAWS)
def test_equals_the_twin(name, rate, unit, importance):
    terms = CASES[name].terms
    samples = make_samples(rate, unit, importance)
    colors, targets, photos = make_colors(samples)
    expected = sparse_loss(terms, colors.double(), targets.double(), samples)
    for truth, extra in ((targets, {}), (photos, {"update": MapUpdate(make_maps(DEVICE), STEP)})):
        found = on_kernels(terms, colors, truth, samples, **extra)
        assert float(found.loss) == pytest.approx(float(expected.loss), rel=1e-5)
        assert relative(found.color_gradients, expected.color_gradients) < 1e-5
        assert not found.color_gradients.cpu()[~samples.filled].any()
        torch.testing.assert_close(found.pixel_errors.cpu(), expected.pixel_errors, rtol=1e-5, atol=2e-7)


@pytest.mark.parametrize("level", [1.0, 1e4, 1e6, 1e8])
def test_windows_stay_bounded_where_their_variance_is_lost(level):
    """As the twin's (`strategies/test_losses.py`): flat windows of tiles that elsewhere have a contrast of `level`."""
    samples = make_samples(1.0, "tile")
    x, y = samples.coordinates().float().unbind(dim=1)
    targets = torch.where((x % 16 < 8)[:, None], level, 0.1).repeat(1, 3) * samples.filled[:, None]
    terms = SparseSsimLoss(ssim_weight=1.0).terms
    tiles, tile_of_slot = len(samples.tile_ids), samples.tile_of_slot()
    filled = torch.bincount(tile_of_slot, weights=samples.filled.double(), minlength=tiles)  # [T]
    bounds = (8 * 2 / 0.03 + 1 / 0.01) / (3 * tiles * filled.clamp(min=1))[tile_of_slot]  # `SSIM_SLOPE` of the twin's
    for colors in (targets + 0.01 * torch.sin(9.0 * x + 5.0 * y)[:, None], targets.roll(1, dims=0)):
        colors = colors * samples.filled[:, None]
        found = on_kernels(terms, colors, targets, samples)
        assert 0 <= float(found.loss) <= 2
        assert (found.color_gradients.abs().amax(dim=1).cpu() <= bounds).all()
        assert torch.isfinite(found.color_gradients).all()


@pytest.mark.parametrize("name", ["l1", "ssim"])
@pytest.mark.parametrize(("rate", "unit", "importance"), [(0.1, "pixel", 0.5), (1.0, "tile", 0.0)])
def test_the_depth_term_equals_the_twin(name, rate, unit, importance):
    """Also where a depth is none, tiny or huge; the rest of the loss is to the bit as without the term."""
    samples, generator = make_samples(rate, unit, importance), torch.Generator().manual_seed(4)
    colors, targets, _ = make_colors(samples)
    counts = (-(-SIZES // CELL)).prod(axis=1)
    cells = (torch.rand(int(counts.sum()), generator=generator) - 0.3).clamp(min=0)
    cells[::11], cells[1::29], cells[2::37] = torch.inf, 1e-30, torch.nan
    known = InverseDepths(cells, torch.from_numpy(np.cumsum(counts) - counts), 0.4)
    depths = torch.rand(len(samples), generator=generator) * 5 + 0.01
    depths[::13], depths[1::17], depths[2::19], depths[3::23] = 0.0, 1e-30, 1e30, torch.inf
    terms = replace(CASES[name].terms, depth_weight=0.7)
    expected = sparse_loss(terms, colors.double(), targets.double(), samples, DepthPair(depths.double(), known))
    pair = DepthPair(depths.to(DEVICE), known.to(DEVICE))
    found = on_kernels(terms, colors, targets, samples, depths=pair)
    assert float(found.loss) == pytest.approx(float(expected.loss), rel=1e-5)
    gradients = found.depth_gradients.cpu()
    assert gradients.isfinite().all() and torch.equal(gradients == 0, expected.depth_gradients.float() == 0)
    assert relative(gradients, expected.depth_gradients) < 1e-5 and gradients.any()
    without = on_kernels(terms, colors, targets, samples)
    assert without.depth_gradients is None and torch.equal(without.color_gradients, found.color_gradients)


@pytest.mark.parametrize("rate", [0.1, 1.0])
def test_maps_follow(rate):
    """Bit for bit: sums of three absolute values in one order, then single-precision products rounded one by one."""
    samples = make_samples(rate)
    colors, targets, _ = make_colors(samples)
    maps, twin = make_maps(DEVICE), make_maps("cpu")
    found = on_kernels(CASES["ncc"].terms, colors, targets, samples, update=MapUpdate(maps, STEP))
    twin.update(samples, found.pixel_errors.cpu(), STEP)
    assert torch.equal(maps.errors.cpu(), twin.errors)
    assert torch.equal(maps.stamps.cpu(), twin.stamps)
    assert torch.equal(maps.view_sums.cpu(), twin.view_sums)
    assert not torch.equal(maps.errors.cpu(), make_maps("cpu").errors)


@pytest.mark.parametrize("name", ["ncc", "ssim"])
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_bad_colors_stay_out(bad, name):
    samples = make_samples(0.3, "pixel")
    colors, targets, _ = make_colors(samples)
    slots = torch.tensor([0, 5, 300])
    colors[slots, 1] = bad
    maps = make_maps(DEVICE)
    found = on_kernels(CASES[name].terms, colors, targets, samples, update=MapUpdate(maps, STEP))
    assert torch.isfinite(found.loss)
    gradients = found.color_gradients.cpu()
    assert torch.isfinite(gradients).all() and not gradients[slots].any()
    assert gradients[torch.arange(len(samples)) != 5].abs().sum() > 0
    before = make_maps("cpu")
    flat = samples.flat_pixels(before.offsets)
    assert torch.equal(maps.errors.cpu()[flat[slots]], before.errors[flat[slots]])
    assert (maps.stamps.cpu()[flat[slots]] == -1).all()
    assert (maps.stamps.cpu()[flat] == STEP.iteration).sum() == len(samples) - 3
    assert float(maps.view_sums.sum()) == pytest.approx(float(maps.errors.double().sum()), rel=1e-12)


def test_side_stream_and_half_colors():
    samples = make_samples(0.3)
    colors, targets, _ = make_colors(samples)
    colors, targets, samples = colors.half().to(DEVICE), targets.to(DEVICE), samples_to(samples, DEVICE)
    expected = training_kernels.sparse_loss(CASES["ncc"].terms, colors, targets, samples)
    found = on_side_stream(lambda: training_kernels.sparse_loss(CASES["ncc"].terms, colors + 0, targets + 0, samples))
    assert torch.equal(found.color_gradients, expected.color_gradients)
    assert torch.equal(found.pixel_errors, expected.pixel_errors)
    assert expected.color_gradients.any()


@pytest.mark.parametrize("name", ["l1", "ssim"])
def test_lost_losses_are_counted_once(name):
    """A finite colour whose square is not: the loss overflows in many tiles, and counts as one lost."""
    samples = make_samples(0.3, "pixel")
    colors, targets, _ = make_colors(samples)
    counter = torch.zeros((), dtype=torch.int64, device=DEVICE)
    update = MapUpdate(make_maps(DEVICE), STEP, counter)
    for value, expected in ((0.5, 0), (1e38, 1), (0.5, 1), (1e38, 2)):
        colors[::7] = value
        found = on_kernels(CASES[name].terms, colors, targets, samples, update=update)
        assert int(counter) == expected and bool(torch.isfinite(found.loss)) == (value == 0.5)
