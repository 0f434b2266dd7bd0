"""Losses on sampled pixels (paper section 3.7), as `LossTerms` that every engine can evaluate.

Every loss here is a mean over all filled samples of the K views together, or over the listed tiles, so its gradients
are as large as a dense mean loss has them. Formulas: `turbogs_plugin.engine.reference.losses`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from torch import Tensor

from turbogs_plugin.engine import engine_of
from turbogs_plugin.engine.rules import STRUCTURE_CONSTANT, LossTerms
from turbogs_plugin.strategies.checks import check_colors, require_each, require_positive, require_settings
from turbogs_plugin.strategies.protocols import SparseLoss
from turbogs_plugin.types import LossOutput, PixelSamples

EPSILON = 1e-3
"""eps of the Charbonnier term: residuals below it are treated quadratically."""


@dataclass
class RuleLoss(SparseLoss):
    """A loss described by its terms. When called, the engine of the colours' device evaluates it.

    Args:
        depth_weight: factor of the depth term (Algorithm 1's d and d*), which is added: the mean of ``|1/d - 1/d*|``
            in 1 / extents, rounded below `EPSILON`, over the pixels whose depth d* the capture knows. 0: none.
    """

    depth_weight: float = 0.0
    terms: LossTerms = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        self.terms = replace(self.rule(), depth_weight=self.depth_weight)
        require_settings(self)

    def rule(self) -> LossTerms:
        """The terms beside the depth's."""
        return LossTerms(EPSILON)

    def __call__(self, colors: Tensor, targets: Tensor, samples: PixelSamples) -> LossOutput:
        check_colors(colors, targets, samples)
        return engine_of(colors.device).evaluate(self.terms, colors, targets, samples)


@dataclass
class CharbonnierLoss(RuleLoss):
    """The Charbonnier l1 term alone: mean over filled samples and channels of ``w (sqrt(d^2 + eps^2) - eps)``.

    It has the size of a dense L1 loss in gsplat. Each entry of the gradient is at most ``w / (3 n)``, n the number of
    filled samples.
    """


@dataclass
class CharbonnierNccLoss(RuleLoss):
    """Charbonnier l1 plus a gradient-balanced structure term of each tile (equations of section 3.7)::

        L = l1 + ncc_weight * mean over tiles of lambda * mean over channels of (1 - S)
        lambda = clip(mean |grad l1| / (mean |grad S| + 1e-8), 0, 1)

    `engine.reference.losses.sparse_loss` defines it. The structure term's gradient is *added*: the appendix's minus
    would lower the correlation.

    Each entry of the gradient is at most ``w / (3 n) + ncc_weight / T`` (n filled samples, T tiles): lambda keeps the
    sum of the structure term's gradients in a tile below the sum of l1's. It is exactly 0 where x = y.

    Args:
        ncc_weight: factor of the structure term; 1 in the paper.
        structure: similarity S of a tile: `ncc`, by whose variance floor a flat tile scores 1; or the appendix's
            `printed_ncc`, by which it scores 0.
        variance_constant: c, variance below which a tile counts as flat; SSIM's by default. NCC's floor is c / 2. The
            printed NCC adds it as its epsilon to a product of two variances: 1e-6 there means two variances of 1e-3.
    """

    ncc_weight: float = 1.0
    structure: Literal["ncc", "printed_ncc"] = "ncc"
    variance_constant: float = STRUCTURE_CONSTANT

    def rule(self) -> LossTerms:
        require_positive(self, "variance_constant")
        return LossTerms(EPSILON, 1.0, self.structure, self.ncc_weight, self.variance_constant)


@dataclass
class SparseSsimLoss(RuleLoss):
    """``(1 - ssim_weight) * l1 + ssim_weight * mean over tiles and channels of (1 - SSIM)``, 3DGS' mixture.

    A tile's SSIM is the mean over its samples, each in a Gaussian window of 11x11 pixels (Wang et al. 2004) that ends
    at the tile's edge. The loss is of use where whole tiles are sampled.

    Args:
        ssim_weight: weight of the structure term, 0 .. 1; 0.2 in 3DGS.
    """

    ssim_weight: float = 0.2

    def rule(self) -> LossTerms:
        require_each(self, lambda value: 0 <= value <= 1, "between 0 and 1", "ssim_weight")
        return LossTerms(EPSILON, 1.0 - self.ssim_weight, "ssim", self.ssim_weight)
