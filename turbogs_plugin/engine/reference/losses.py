"""Losses on sampled pixels in torch, each with its own gradient: the definition of `LossTerms` (paper section 3.7 and
appendix).

Every loss is a mean over all filled samples of the K views together, or over the listed tiles, so its gradients are as
large as the gradients of a dense mean loss. Half-precision colours are converted to single precision, and so are their
gradients. A sample whose colour is not finite adds no loss and no gradient, and its error is 0; it still counts in the
mean. With autograd upstream: ``colors.backward(out.color_gradients)``.

Notation, per tile and channel: n samples x (prediction) and y (truth) with importance weights w; their shares
``omega = w / sum(w)`` (1 / n without weights) define means, variances s_x^2, s_y^2 and covariance s_xy, all biased.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from turbogs_plugin.engine.layout import WINDOW_RADIUS
from turbogs_plugin.engine.rules import LUMINANCE_CONSTANT, STRUCTURE_CONSTANT, WINDOW_SIGMA, LossTerms
from turbogs_plugin.scene.depths import DepthPair
from turbogs_plugin.types import TILE_SIZE, LossOutput, PixelSamples

BALANCE_EPSILON = 1e-8
"""Keeps the paper's lambda, the gradient-balanced weight, defined where the structure term has no gradient."""

INVERSE_DEPTH_MAX = 1000.0
"""Largest inverse depth in a loss, of a tenth of the near plane's depth: its square, in the gradient, stays bounded."""


def sparse_loss(
    terms: LossTerms, colors: Tensor, targets: Tensor, samples: PixelSamples, depths: DepthPair | None = None
) -> LossOutput:
    """The loss of some samples and its gradient, to which `depth_loss` adds with `depths`::

        L = l1_weight * l1 + structure_weight * mean over tiles of f * mean over channels of (1 - S)
        f = lambda where `LossTerms.balance`, else 1
        lambda = clip(mean |grad l1| / (mean |grad S| + 1e-8), 0, 1)

    l1 is the Charbonnier term of `Problem`, S the similarity named by `structure`. ``grad l1`` is
    ``d / sqrt(d^2 + eps^2)`` and ``grad S`` is g, the gradients that the appendix prints. lambda takes their L1 norms
    over channels, and means over the tile's samples (by their shares). Both gradients lack 1 / n, so the two terms
    compare as they enter L. lambda is constant in the backward pass.

    Args:
        terms: which loss.
        colors, targets: [P, 3].
        samples: the P slots.
    """
    problem = Problem(colors, targets, samples, terms.epsilon)
    loss, gradients, depth_gradients = terms.l1_weight * problem.loss, terms.l1_weight * problem.gradients, None
    if depths is not None:
        of_depth, depth_gradients = depth_loss(terms, depths, samples)
        loss = loss + of_depth
    if terms.structure == "none":
        return LossOutput(loss, gradients, problem.pixel_errors, depth_gradients)
    groups = problem.groups
    similarity, slopes = SIMILARITIES[terms.structure](problem, terms.variance_constant)
    factors = torch.ones_like(similarity[:, :1])  # [T, 1]
    if terms.balance:
        norms = torch.stack([problem.slopes.abs().sum(dim=1), slopes.abs().sum(dim=1)], dim=1)
        norm_l1, norm_structure = groups.mean(norms).unbind(dim=1)
        factors = (norm_l1 / (norm_structure + BALANCE_EPSILON)).clamp(max=1.0)[:, None]
    factors = factors * (terms.structure_weight / (3 * max(1, groups.tiles)))
    loss = loss + (factors * (1.0 - similarity)).sum()
    gradients = gradients - groups.spread(factors.expand_as(similarity)) * groups.shares * slopes
    return LossOutput(loss, gradients, problem.pixel_errors, depth_gradients)


def depth_loss(terms: LossTerms, depths: DepthPair, samples: PixelSamples) -> tuple[Tensor, Tensor]:
    """The depth term of Algorithm 1, and its gradient by each rendered depth [P]::

        depth_weight / share * mean over filled samples of w * (sqrt(r^2 + eps^2) - eps),  r = 1 / d - 1 / d*

    r is 0 where no d* is known or nothing was rendered (d = 0), and where an inverse depth exceeds `INVERSE_DEPTH_MAX`
    or is not finite. By `InverseDepths.share` it is a mean over the samples that can be expected to have a d*.
    """
    rendered = depths.rendered.detach()
    truth = depths.known.at(samples).to(rendered.dtype)
    inverse = 1.0 / rendered
    used = samples.filled & (rendered > 0) & (inverse <= INVERSE_DEPTH_MAX)
    used = used & (truth > 0) & (truth <= INVERSE_DEPTH_MAX)
    inverse, difference = torch.where(used, inverse, 0.0), torch.where(used, inverse - truth, 0.0)
    weights = terms.depth_weight / (depths.known.share * samples.filled.sum().clamp(min=1))
    weights = weights if samples.weights is None else weights * samples.weights
    roots = torch.sqrt(difference * difference + terms.epsilon**2)
    slopes = difference / roots
    loss = (weights * difference * slopes * (roots / (roots + terms.epsilon))).sum()
    return loss, -weights * slopes * inverse * inverse


def tile_moments(problem: Problem) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Second moments of prediction (x) and truth (y) of each tile and channel.

    Two passes, relative to the tile's first sample, so a constant tile has variance 0 exactly.

    Returns:
        Variance of x, variance of y and covariance, [T, C]; and the samples x and y minus their tile's mean, [P, C].
    """
    groups, colors, targets = problem.groups, problem.colors, problem.targets
    first_x, first_y = colors[groups.first_slots], targets[groups.first_slots]
    relative_x, relative_y = colors - groups.spread(first_x), targets - groups.spread(first_y)
    mean_x, mean_y = groups.mean(torch.cat([relative_x, relative_y], dim=1)).chunk(2, dim=1)
    offset_x, offset_y = relative_x - groups.spread(mean_x), relative_y - groups.spread(mean_y)
    products = torch.cat([offset_x * offset_x, offset_y * offset_y, offset_x * offset_y], dim=1)
    variance_x, variance_y, covariance = groups.mean(products).chunk(3, dim=1)
    return variance_x, variance_y, covariance, offset_x, offset_y


Similarity = tuple[Tensor, Tensor]
"""Similarity S of each tile and channel, [T, C], at most 1; and g, [P, C], with d S / d x = omega * g."""


def correlation(problem: Problem, constant: float) -> Similarity:
    """NCC with a variance floor f = constant / 2, the structure term of SSIM::

        S = (s_xy + f) / sqrt((s_x^2 + f) (s_y^2 + f))
        g = (y - mean_y) / sqrt((s_x^2 + f) (s_y^2 + f)) - S (x - mean_x) / (s_x^2 + f)

    Where variances exceed f this is the paper's NCC. As the floor is in numerator and denominator, S = 1 and g = 0
    where x = y, in tiles of one sample, and in tiles constant in both x and y. ``|omega g| <= 1.5 sqrt(omega / f)``.
    """
    variance_x, variance_y, covariance, offset_x, offset_y = tile_moments(problem)
    spread, floor = problem.groups.spread, 0.5 * constant
    scale_x, scale_y = (variance_x + floor).sqrt(), (variance_y + floor).sqrt()
    similarity = (covariance + floor) / scale_x / scale_y
    slope_y, slope_x = 1.0 / scale_x / scale_y, similarity / scale_x / scale_x
    return similarity, offset_y * spread(slope_y) - offset_x * spread(slope_x)


def printed_correlation(problem: Problem, constant: float) -> Similarity:
    """NCC and its gradient as the appendix prints them, with epsilon = constant::

        S = s_xy / sqrt(s_x^2 s_y^2 + epsilon)
        g = (y - mean_y) / sqrt(s_x^2 s_y^2 + epsilon) - S (x - mean_x) / (s_x^2 + epsilon)

    A flat tile scores 0, and a faint texture scores near 0, as epsilon is added to a product of two variances. There g
    is not quite the derivative of S, which has s_y^2 / (s_x^2 s_y^2 + epsilon) in the place of 1 / (s_x^2 + epsilon).
    """
    variance_x, variance_y, covariance, offset_x, offset_y = tile_moments(problem)
    spread, scale = problem.groups.spread, (variance_x * variance_y + constant).sqrt()
    similarity = covariance / scale
    slope_x = similarity / (variance_x + constant)
    return similarity, offset_y * spread(1.0 / scale) - offset_x * spread(slope_x)


def ssim(problem: Problem, constant: float) -> Similarity:
    """The mean SSIM of the samples of a tile, in windows, with SSIM's own constants, whatever `constant` is; see
    `window_similarity`."""
    similarity, slopes = window_similarity(problem)
    return 1.0 - problem.groups.mean(1.0 - similarity), slopes


SIMILARITIES: dict[str, Callable[[Problem, float], Similarity]] = {
    "ncc": correlation,
    "ssim": ssim,
    "printed_ncc": printed_correlation,
}
"""Name of a structure term -> its definition. `strategies.losses` uses the same names."""


class Problem:
    """Start of every loss: inputs in the precision of the computation, and the Charbonnier term.

    The term is ``mean over filled samples of w * mean over channels of (sqrt(d^2 + eps^2) - eps)``, d = x - y. It is
    the paper's minus a constant, so that it is 0 at d = 0. `slopes` [P, 3] is ``d / sqrt(d^2 + eps^2)``.
    """

    def __init__(self, colors: Tensor, targets: Tensor, samples: PixelSamples, epsilon: float) -> None:
        dtype = torch.promote_types(torch.promote_types(colors.dtype, targets.dtype), torch.float32)
        self.samples = samples
        used = samples.filled & torch.isfinite(colors).all(dim=1)
        self.colors = torch.where(used[:, None], colors.detach().to(dtype), 0.0)
        self.targets = torch.where(used[:, None], targets.detach().to(dtype), 0.0)
        self.groups = groups = TileGroups(samples, used.to(dtype))
        differences = self.colors - self.targets
        self.pixel_errors = differences.abs().sum(dim=1).float()
        roots = torch.sqrt(differences * differences + epsilon * epsilon)
        self.slopes = differences / roots
        values = differences * self.slopes * (roots / (roots + epsilon))  # d^2 / (root + eps) = root - eps
        self.loss = (groups.weights * values).sum() / (3.0 * groups.filled)
        self.gradients = self.slopes * (groups.weights / (3.0 * groups.filled))


class TileGroups:
    """The samples of each tile, with their weights.

    Attributes:
        weights: [P, 1], 0 in unused slots.
        shares: [P, 1], omega: the weights over their sum in the tile.
        tiles: T.
        filled: scalar tensor, the number of filled slots, at least 1.
    """

    def __init__(self, samples: PixelSamples, used: Tensor) -> None:
        """`used`: [P], 1 for the slots that count, 0 for the others, in the dtype of the computation."""
        self.tile_of_slot = samples.tile_of_slot()
        self.tiles = len(samples.tile_ids)
        self.first_slots = samples.tile_offsets[:-1].long().clamp(max=max(0, len(samples) - 1))  # [T]
        self.filled = samples.filled.sum().clamp(min=1).to(used.dtype)
        self.weights = (used if samples.weights is None else used * samples.weights)[:, None]
        totals = self.sum(self.weights)
        self.shares = self.weights / torch.where(totals > 0, totals, 1.0)[self.tile_of_slot]

    def sum(self, values: Tensor) -> Tensor:
        """[P, C] -> [T, C]: sums over the slots of each tile."""
        return values.new_zeros(self.tiles, values.shape[1]).index_add_(0, self.tile_of_slot, values)

    def mean(self, values: Tensor) -> Tensor:
        """[P, C] -> [T, C]: means weighted by the shares."""
        return self.sum(self.shares * values)

    def spread(self, values: Tensor) -> Tensor:
        """[T, C] -> [P, C]: each slot gets its tile's value."""
        return values[self.tile_of_slot]


def window_similarity(problem: Problem) -> tuple[Tensor, Tensor]:
    """SSIM S of every sample, and h, what it gives to the gradient: [P, 3] each. In a tile, each pixel at most once.

    The window of sample i has the weights ``w_j g(i - j)`` over the samples j of its tile, over their sum n_i, with g a
    Gaussian of `WINDOW_SIGMA` pixels that ends after `WINDOW_RADIUS` pixels along each axis. Means, variances and
    covariance under the window give the luminance term times the contrast-structure term::

        S_i = (2 m_x m_y + c1) / (m_x^2 + m_y^2 + c1) * (2 s_xy + c) / (s_x^2 + s_y^2 + c)
        h_j = sum over i of w_i g(i - j) / n_i * (a_i (y_j - m_y,i) - b_i (x_j - m_x,i) + l_i)

    a, b and l belong to the sample's window: ``2 L / (s_x^2 + s_y^2 + c)``, ``S a / L`` and the slope of the
    luminance term L with m_x, times the other. With ``omega_j = w_j / sum(w)`` over the tile, the tile's similarity is
    ``sum of omega_i S_i`` and its derivative with x_j is ``omega_j h_j``.

    The moments are taken relative to the tile's first sample. They are differences of sums, so that of colours of
    thousands a flat window's variance is lost; the covariance is then held to what the variances allow, and S to 1.
    And c is SSIM's c2 plus the mean squares' rounding: where that is larger, a window that seems to have no variance
    would else have the slope of a flat one, times what rounding makes of colours of thousands. The gradient ignores
    both.
    """
    samples, groups, colors, targets = problem.samples, problem.groups, problem.colors, problem.targets
    inside = (samples.coordinates() + torch.tensor(samples.origin, device=samples.pixel_ids.device)) % TILE_SIZE
    # [P] the place of each slot among the pixels of all T tiles, row by row in a tile; in empty slots any
    places = (groups.tile_of_slot * TILE_SIZE + inside[:, 1]) * TILE_SIZE + inside[:, 0]
    first_x, first_y = groups.spread(colors[groups.first_slots]), groups.spread(targets[groups.first_slots])  # [P, 3]
    x, y = colors - first_x, targets - first_y

    def windows(values: Tensor) -> Tensor:
        """[P, C] -> [P, C]: sums of w times the values under each sample's window."""
        return _sum_windows(groups.weights * values, places, groups.tiles)

    totals = windows(torch.ones_like(groups.weights))  # n
    inverse_totals = 1.0 / torch.where(totals > 0, totals, 1.0)
    moments = windows(torch.cat([x, y, x * x, y * y, x * y], dim=1)) * inverse_totals
    mean_x, mean_y, xx, yy, xy = moments.chunk(5, dim=1)
    variance_x = (xx - mean_x * mean_x).clamp(min=0.0)
    variance_y = (yy - mean_y * mean_y).clamp(min=0.0)
    largest = variance_x.sqrt() * variance_y.sqrt()
    covariance = torch.minimum(torch.maximum(xy - mean_x * mean_y, -largest), largest)

    steady = STRUCTURE_CONSTANT + torch.finfo(xx.dtype).eps * (xx + yy)  # c
    spread = variance_x + variance_y + steady
    structure = (2.0 * covariance + steady) / spread
    true_x, true_y = mean_x + first_x, mean_y + first_y
    level = true_x * true_x + true_y * true_y + LUMINANCE_CONSTANT
    luminance = (2.0 * true_x * true_y + LUMINANCE_CONSTANT) / level
    at_y = 2.0 * luminance / spread
    at_x = at_y * structure
    constant = structure * 2.0 * (true_y - luminance * true_x) / level
    terms = torch.cat([at_y, at_x, constant - at_y * mean_y + at_x * mean_x], dim=1) * inverse_totals
    sum_y, sum_x, rest = windows(terms).chunk(3, dim=1)
    return structure * luminance, sum_y * y - sum_x * x + rest


def _sum_windows(values: Tensor, places: Tensor, tiles: int) -> Tensor:
    """[P, C] -> [P, C]: for each slot the sum of its tile's values times g of their distance from it."""
    planes = values.new_zeros(tiles * TILE_SIZE**2, values.shape[1]).index_add_(0, places, values)
    planes = planes.view(tiles, TILE_SIZE, TILE_SIZE, values.shape[1])  # [T, S, S, C]
    along = torch.arange(TILE_SIZE, device=values.device, dtype=values.dtype)
    distances = (along[:, None] - along).abs()
    gaussian = torch.exp(-0.5 * (distances / WINDOW_SIGMA) ** 2) * (distances <= WINDOW_RADIUS)  # [S, S]
    sums = torch.einsum("ij,tjkc->tikc", gaussian, planes)
    sums = torch.einsum("ij,tkjc->tkic", gaussian, sums)
    return sums.reshape(tiles * TILE_SIZE**2, values.shape[1])[places]
