"""Losses against independent computations in numpy and finite differences, the sign, the bounds, and the extremes."""

import itertools

import numpy as np
import pytest
import torch
from helpers.refusals import assert_refused

from turbogs_plugin.engine.reference.losses import Problem, window_similarity
from turbogs_plugin.strategies.losses import EPSILON, CharbonnierLoss, CharbonnierNccLoss, SparseSsimLoss
from turbogs_plugin.tiles import pixel_table
from turbogs_plugin.types import PixelSamples

EVERY = [
    CharbonnierLoss(),
    CharbonnierNccLoss(),
    CharbonnierNccLoss(variance_constant=1e-6),
    CharbonnierNccLoss(ncc_weight=0.5, variance_constant=1e-4),
    SparseSsimLoss(),
    SparseSsimLoss(ssim_weight=1.0),
]
SSIM_SLOPE = 8 * 2 / 0.03 + 1 / 0.01
"""The most that h of `window_similarity` can be in exact arithmetic. A window gives a pixel at most 2 sqrt(share / c2)
of its contrast-structure term, and the sum of the roots of a pixel's shares in all whole windows is 7.5; the luminance
term's slope is at most 1 / sqrt(c1)."""


def make_samples(counts, empty=(), weights=None):
    """Tiles of a 16-pixel-high strip with `counts` slots; the last `empty[tile]` of a tile are empty."""
    counts = np.asarray(counts)
    places = pixel_table(np.array([[16 * len(counts), 16]]), "cpu").numpy()
    ids = np.concatenate([places[tile, :count] for tile, count in enumerate(counts)])
    offsets = np.concatenate([[0], np.cumsum(counts)])
    for tile, number in enumerate(empty):
        ids[offsets[tile + 1] - number : offsets[tile + 1]] = -1
    lists = (torch.as_tensor(values, dtype=torch.int32) for values in (ids, range(len(counts)), offsets))
    return PixelSamples((0,), np.array([[16 * len(counts), 16]]), *lists, weights)


def random_case(seed=0, counts=(5, 9, 1, 12, 3), empty=(1, 0, 0, 4, 2), weighted=False, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    slots = sum(counts)
    weights = torch.rand(slots, generator=generator) + 0.2 if weighted else None
    samples = make_samples(counts, empty, weights)
    if weighted:
        samples.weights /= samples.weights[samples.filled].mean()
    colors, targets = torch.rand(2, slots, 3, generator=generator, dtype=torch.float64).to(dtype)
    return colors, 0.5 * colors + 0.5 * targets, samples


def tiles_of(samples):
    """Filled slots of each tile."""
    offsets, ids = samples.tile_offsets.tolist(), samples.pixel_ids.tolist()
    return [[p for p in range(a, b) if ids[p] >= 0] for a, b in itertools.pairwise(offsets)]


def weighted_moments(x, y, w):
    omega = w / w.sum()
    mean_x, mean_y = omega @ x, omega @ y
    return mean_x, mean_y, omega @ (x - mean_x) ** 2, omega @ (y - mean_y) ** 2, omega @ ((x - mean_x) * (y - mean_y))


def expected_ssim(x, y, w, coordinates):
    """The mean of the SSIM of each sample's own Gaussian window, one window after the other."""
    values = []
    for center in coordinates:
        apart = coordinates - center
        window = np.exp(-((apart / 1.5) ** 2).sum(axis=1) / 2) * (np.abs(apart).max(axis=1) <= 5)
        mean_x, mean_y, var_x, var_y, cov = weighted_moments(x, y, w * window)
        c1, c2 = 0.01**2, 0.03**2
        luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
        values.append(luminance * (2 * cov + c2) / (var_x + var_y + c2))
    return np.average(values, weights=w)


def expected_similarity(loss, x, y, w, coordinates):
    """S of one tile and channel, from numpy's weighted moments."""
    if isinstance(loss, SparseSsimLoss):
        return expected_ssim(x, y, w, coordinates)
    _, _, var_x, var_y, cov = weighted_moments(x, y, w)
    c = loss.variance_constant
    return (cov + c / 2) / np.sqrt((var_x + c / 2) * (var_y + c / 2))


def expected_balance(loss, colors, targets, samples):
    """lambda of each tile, with the gradient of S by central differences of `expected_similarity`."""
    if isinstance(loss, SparseSsimLoss):
        return [1.0] * len(samples.tile_ids)
    w = np.ones(len(samples)) if samples.weights is None else samples.weights.double().numpy()
    factors = []
    for slots in tiles_of(samples):
        omega = w[slots] / w[slots].sum()
        norm_l1 = norm_structure = 0.0
        for channel in range(3):
            x, y = colors[slots, channel], targets[slots, channel]
            norm_l1 += omega @ (np.abs(x - y) / np.sqrt((x - y) ** 2 + EPSILON**2))
            for i in range(len(slots)):
                step = np.zeros(len(slots))
                step[i] = 1e-6
                up, down = (expected_similarity(loss, x + s, y, w[slots], None) for s in (step, -step))
                norm_structure += abs(up - down) / 2e-6  # = omega_i |g_i|
        factors.append(min(1.0, norm_l1 / (norm_structure + 1e-8)))
    return factors


def expected_loss(loss, colors, targets, samples, balance):
    """The loss by the equations, tile by tile, with the balance given."""
    w = np.ones(len(samples)) if samples.weights is None else samples.weights.double().numpy()
    filled = [slot for slots in tiles_of(samples) for slot in slots]
    d = colors[filled] - targets[filled]
    l1 = (w[filled, None] * (np.sqrt(d**2 + EPSILON**2) - EPSILON)).mean()
    if isinstance(loss, CharbonnierLoss):
        return l1
    ssim = isinstance(loss, SparseSsimLoss)
    weight, base = (loss.ssim_weight, 1 - loss.ssim_weight) if ssim else (loss.ncc_weight, 1)
    structure, coordinates = 0.0, samples.coordinates().numpy()
    for slots, factor in zip(tiles_of(samples), balance, strict=True):
        for channel in range(3):
            x, y = colors[slots, channel], targets[slots, channel]
            similarity = expected_similarity(loss, x, y, w[slots], coordinates[slots])
            structure += factor * (1 - similarity) / 3
    return base * l1 + weight * structure / len(samples.tile_ids)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("loss", EVERY, ids=repr)
def test_value_and_gradient_are_the_equations(loss, weighted):
    """Value in closed form; gradient by central differences with the balance frozen; errors of pixels are L1 norms."""
    colors, targets, samples = random_case(weighted=weighted)
    result = loss(colors, targets, samples)
    x, y = colors.numpy(), targets.numpy()
    balance = [1.0] * 5 if isinstance(loss, CharbonnierLoss) else expected_balance(loss, x, y, samples)
    assert result.loss.item() == pytest.approx(expected_loss(loss, x, y, samples, balance), rel=1e-6)
    assert result.color_gradients.dtype == torch.float64
    numeric = np.zeros_like(x)
    for place in np.ndindex(x.shape):
        moved = [x.copy(), x.copy()]
        moved[0][place] += 1e-6
        moved[1][place] -= 1e-6
        up, down = (expected_loss(loss, value, y, samples, balance) for value in moved)
        numeric[place] = (up - down) / 2e-6
    assert result.color_gradients.numpy() == pytest.approx(numeric, rel=1e-4, abs=1e-8)
    assert np.abs(numeric).max() > 1e-3
    errors = torch.where(samples.filled, (colors - targets).abs().sum(dim=1), 0.0)
    assert result.pixel_errors.dtype == torch.float32 and torch.allclose(result.pixel_errors, errors.float(), rtol=1e-6)


@pytest.mark.parametrize("level", [1.0, 1e4, 1e6, 1e8])
def test_windows_stay_bounded_where_their_variance_is_lost(level):
    """In single precision, flat windows of a tile that elsewhere has a contrast of `level`."""
    samples = make_samples([256])
    x, y = samples.coordinates().float().unbind(dim=1)
    targets = torch.where(x < 8, level, 0.1)[:, None].repeat(1, 3)
    for colors in (targets + 0.01 * torch.sin(9.0 * x + 5.0 * y)[:, None], targets.flip(0)):
        similarity, slopes = window_similarity(Problem(colors, targets, samples, 1e-3))
        _, exact_slopes = window_similarity(Problem(colors.double(), targets.double(), samples, 1e-3))
        assert similarity.abs().max() <= 1 + 1e-6
        assert slopes.abs().max() <= min(SSIM_SLOPE, 1.01 * exact_slopes.abs().max())


@pytest.mark.parametrize("loss", EVERY, ids=repr)
def test_empty_slots_have_no_part(loss):
    colors, targets, samples = random_case(weighted=True)
    result = loss(colors, targets, samples)
    empty = ~samples.filled
    assert (result.color_gradients[empty] == 0).all() and (result.pixel_errors[empty] == 0).all()
    colors[empty], targets[empty] = torch.nan, torch.inf
    again = loss(colors, targets, samples)
    assert torch.equal(result.color_gradients, again.color_gradients) and result.loss == again.loss


def test_printed_ncc_is_the_appendix():
    """S and its gradient, written out; far above epsilon they are numpy's correlation and its derivative."""
    colors, targets, samples = random_case(counts=(9, 16), empty=(1, 0))
    x, y = 0.05 * colors.numpy(), 0.05 * targets.numpy()  # variances of 1e-4, where epsilon counts
    for epsilon, far_above in ((1e-6, False), (1e-14, True)):
        loss = CharbonnierNccLoss(structure="printed_ncc", variance_constant=epsilon)
        result = loss(torch.as_tensor(x), torch.as_tensor(y), samples)
        plain = CharbonnierLoss()(torch.as_tensor(x), torch.as_tensor(y), samples)
        value, gradient = 0.0, np.zeros_like(x)
        for slots in tiles_of(samples):
            scores, slopes = np.zeros(3), np.zeros((len(slots), 3))
            for c in range(3):
                a, b = x[slots, c], y[slots, c]
                da, db = a - a.mean(), b - b.mean()
                root = np.sqrt(a.var() * b.var() + epsilon)
                scores[c] = (da * db).mean() / root
                slopes[:, c] = db / root - scores[c] * da / (a.var() + epsilon)
                if far_above:
                    assert scores[c] == pytest.approx(np.corrcoef(a, b)[0, 1], rel=1e-5)
            d = x[slots] - y[slots]
            norm_l1 = np.abs(d / np.sqrt(d**2 + EPSILON**2)).sum(axis=1).mean()
            factor = min(1.0, norm_l1 / (np.abs(slopes).sum(axis=1).mean() + 1e-8))
            value += factor * (1 - scores).mean() / 2
            gradient[slots] = -factor * slopes / len(slots) / 3 / 2
        assert (result.loss - plain.loss).item() == pytest.approx(value, rel=1e-6)
        assert np.allclose((result.color_gradients - plain.color_gradients).numpy(), gradient, rtol=1e-6, atol=1e-12)


def test_a_flat_tile_scores_zero_as_printed_and_one_with_the_floor():
    colors, targets = torch.rand(30, 3, generator=torch.Generator().manual_seed(6)), torch.full((30, 3), 0.3)
    plain = CharbonnierLoss()(colors, targets, make_samples([30]))
    printed = CharbonnierNccLoss(structure="printed_ncc")(colors, targets, make_samples([30]))
    assert torch.equal(printed.color_gradients, plain.color_gradients)  # no information, no gradient
    flat = torch.full((30, 3), 0.3)
    for structure, score in (("printed_ncc", 0.0), ("ncc", 1.0)):
        loss = CharbonnierNccLoss(structure=structure)(flat + 0.2, flat, make_samples([30])).loss
        l1 = CharbonnierLoss()(flat + 0.2, flat, make_samples([30])).loss
        assert (loss - l1).item() == pytest.approx(1.0 - score, abs=1e-6)


@pytest.mark.parametrize("loss", EVERY, ids=repr)
@pytest.mark.parametrize("scale", [1.0, 1e4])
def test_truth_has_no_loss_and_no_gradient(loss, scale):
    _, targets, samples = random_case(dtype=torch.float32)
    result = loss(scale * targets, scale * targets, samples)
    assert abs(result.loss.item()) < 1e-6
    limit = 1e-6 if isinstance(loss, SparseSsimLoss) else 0.0
    assert result.color_gradients.abs().max() <= limit
    assert (result.pixel_errors == 0).all()


@pytest.mark.parametrize("loss", EVERY, ids=repr)
def test_half_precision_input_is_computed_in_single(loss):
    colors, targets, samples = random_case(dtype=torch.float16)
    result = loss(colors, targets, samples)
    expected = loss(colors.float(), targets.float(), samples)
    assert result.color_gradients.dtype == torch.float32
    assert torch.equal(result.color_gradients, expected.color_gradients)
    reference = loss(colors.double(), targets.double(), samples).color_gradients.float()
    assert torch.allclose(result.color_gradients, reference, rtol=1e-3, atol=1e-7)


@pytest.mark.parametrize("loss", EVERY, ids=repr)
def test_what_does_not_fit_is_named(loss):
    colors, targets, samples = random_case()
    refused = {
        r"^colors is ndarray: expected a tensor, floating point \(30, 3\)": (colors.numpy(), targets, samples),
        r"^targets is torch.uint8 \(30, 3\): expected a tensor": (colors, targets.byte(), samples),
        r"^targets is torch.float64 \(29, 3\): expected a tensor": (colors, targets[:29], samples),
        "^samples is a NoneType: expected the PixelSamples": (colors, targets, None),
    }
    for words, given in refused.items():
        assert_refused(words, loss, *given)
