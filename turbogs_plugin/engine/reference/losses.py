"""Losses on sampled pixels in torch, each with its own gradient: the definition of `LossTerms` (paper section 3.7 and
appendix).

Every loss is a mean over all filled samples of the K views together, or over the listed tiles, so its gradients are as
large as those of a dense mean loss. Half-precision colours are converted to single precision, and so are their
gradients. A sample whose colour is not finite adds no loss and no gradient, and its error is 0; it still counts in the
mean. With autograd upstream: ``colors.backward(out.color_gradients)``.

Notation, per tile and channel: n samples x (prediction) and y (truth) with importance weights w; their shares
``omega = w / sum(w)`` (1 / n without weights) define means, variances s_x^2, s_y^2 and covariance s_xy, all biased.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from turbogs_plugin.engine.reference.tile_groups import TileGroups
from turbogs_plugin.engine.reference.window_similarity import window_similarity
from turbogs_plugin.engine.rules import LossTerms
from turbogs_plugin.types import LossOutput, PixelSamples

BALANCE_EPSILON = 1e-8
"""Keeps the paper's lambda, the gradient-balanced weight, defined where the structure term has no gradient."""


def sparse_loss(terms: LossTerms, colors: Tensor, targets: Tensor, samples: PixelSamples) -> LossOutput:
    """The loss of some samples and its gradient::

        L = l1_weight * l1 + structure_weight * mean over tiles of f * mean over channels of (1 - S)
        f = lambda with `balance`, else 1
        lambda = clip(mean |grad l1| / (mean |grad S| + 1e-8), 0, 1)

    l1 is the Charbonnier term of `_Problem`, S the similarity named by `structure`. ``grad l1`` is
    ``d / sqrt(d^2 + eps^2)`` and ``grad S`` is g, the gradients that the appendix prints. lambda takes their L1 norms
    over channels, and means over the tile's samples (by their shares). Both gradients lack 1 / n, so the two terms
    compare as they enter L. lambda is constant in the backward pass.

    Args:
        terms: which loss.
        colors, targets: [P, 3].
        samples: the P slots.
    """
    problem = _Problem(colors, targets, samples, terms.epsilon)
    loss, gradients = terms.l1_weight * problem.loss, terms.l1_weight * problem.gradients
    if terms.structure == "none":
        return LossOutput(loss, gradients, problem.pixel_errors)
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
    return LossOutput(loss, gradients, problem.pixel_errors)


@dataclass
class TileMoments:
    """Second moments of prediction (x) and truth (y) of each tile and channel.

    Args:
        variance_x, variance_y, covariance: [T, C].
        offset_x, offset_y: [P, C], the samples minus their tile's mean.
    """

    variance_x: Tensor
    variance_y: Tensor
    covariance: Tensor
    offset_x: Tensor
    offset_y: Tensor

    @classmethod
    def of(cls, groups: TileGroups, colors: Tensor, targets: Tensor) -> TileMoments:
        """Two passes, relative to the tile's first sample, so a constant tile has variance 0 exactly."""
        first_x, first_y = colors[groups.first_slots], targets[groups.first_slots]
        relative_x, relative_y = colors - groups.spread(first_x), targets - groups.spread(first_y)
        mean_x, mean_y = groups.mean(torch.cat([relative_x, relative_y], dim=1)).chunk(2, dim=1)
        offset_x, offset_y = relative_x - groups.spread(mean_x), relative_y - groups.spread(mean_y)
        products = torch.cat([offset_x * offset_x, offset_y * offset_y, offset_x * offset_y], dim=1)
        variance_x, variance_y, covariance = groups.mean(products).chunk(3, dim=1)
        return cls(variance_x, variance_y, covariance, offset_x, offset_y)


Similarity = tuple[Tensor, Tensor]
"""Similarity S of each tile and channel, [T, C], at most 1; and g, [P, C], with d S / d x = omega * g."""


def correlation(problem: _Problem, constant: float) -> Similarity:
    """NCC with a variance floor f = constant / 2, the structure term of SSIM::

        S = (s_xy + f) / sqrt((s_x^2 + f) (s_y^2 + f))
        g = (y - mean_y) / sqrt((s_x^2 + f) (s_y^2 + f)) - S (x - mean_x) / (s_x^2 + f)

    Where variances exceed f this is the paper's NCC. As the floor is in numerator and denominator, S = 1 and g = 0
    where x = y, in tiles of one sample, and in tiles constant in both x and y. ``|omega g| <= 1.5 sqrt(omega / f)``.
    """
    moments, groups, floor = problem.moments, problem.groups, 0.5 * constant
    scale_x, scale_y = (moments.variance_x + floor).sqrt(), (moments.variance_y + floor).sqrt()
    similarity = (moments.covariance + floor) / scale_x / scale_y
    slope_y, slope_x = 1.0 / scale_x / scale_y, similarity / scale_x / scale_x
    return similarity, moments.offset_y * groups.spread(slope_y) - moments.offset_x * groups.spread(slope_x)


def printed_correlation(problem: _Problem, constant: float) -> Similarity:
    """NCC and its gradient as the appendix prints them, with epsilon = constant::

        S = s_xy / sqrt(s_x^2 s_y^2 + epsilon)
        g = (y - mean_y) / sqrt(s_x^2 s_y^2 + epsilon) - S (x - mean_x) / (s_x^2 + epsilon)

    A flat tile scores 0, and a faint texture scores near 0, as epsilon is added to a product of two variances. There g
    is not quite the derivative of S, which has s_y^2 / (s_x^2 s_y^2 + epsilon) in the place of 1 / (s_x^2 + epsilon).
    """
    moments, groups = problem.moments, problem.groups
    scale = (moments.variance_x * moments.variance_y + constant).sqrt()
    similarity = moments.covariance / scale
    slope_x = similarity / (moments.variance_x + constant)
    return similarity, moments.offset_y * groups.spread(1.0 / scale) - moments.offset_x * groups.spread(slope_x)


def ssim(problem: _Problem, constant: float) -> Similarity:
    """The mean SSIM of the samples of a tile, in windows, with SSIM's own constants, whatever `constant` is; see
    `window_similarity`."""
    groups = problem.groups
    similarity, slopes = window_similarity(problem.colors, problem.targets, problem.samples, groups)
    return 1.0 - groups.mean(1.0 - similarity), slopes


SIMILARITIES: dict[str, Callable[[_Problem, float], Similarity]] = {
    "ncc": correlation,
    "ssim": ssim,
    "printed_ncc": printed_correlation,
}
"""Name of a structure term -> its definition. `strategies.losses` uses the same names."""


class _Problem:
    """The start of every loss: inputs in the precision of the computation, and the Charbonnier term.

    The term is ``mean over filled samples of w * mean over channels of (sqrt(d^2 + eps^2) - eps)``, d = x - y. It is
    the paper's minus a constant, so that it is 0 at d = 0. `slopes` [P, 3] is ``d / sqrt(d^2 + eps^2)``.
    """

    def __init__(self, colors: Tensor, targets: Tensor, samples: PixelSamples, epsilon: float) -> None:
        expected = (len(samples), 3)
        if colors.shape != expected or targets.shape != expected:
            shapes = f"{tuple(colors.shape)} and {tuple(targets.shape)}"
            raise ValueError(f"colors and targets have shapes {shapes}, expected {expected} as there are slots")
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

    @cached_property
    def moments(self) -> TileMoments:
        return TileMoments.of(self.groups, self.colors, self.targets)
