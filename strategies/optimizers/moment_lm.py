"""Moment-damped Levenberg-Marquardt on two small blocks per Gaussian (paper section 3.9 and appendix)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from turbogs_plugin.engine.rules import MomentLMParams
from turbogs_plugin.strategies.optimizers.sparse_adam import SparseAdam


@dataclass
class MomentLMOptimizer(SparseAdam):
    """Moment-damped LM on a geometry block (mean 3, scale 3, quaternion 4) and an appearance block (band 0, opacity);
    Adam on the higher bands.

    With g_k a Gaussian's gradient in view k, L_k its share of the loss there, m and v Adam's bias-corrected moments of
    the summed gradient and eta the learning rates, `units: balanced` solves

        (sum_k curvature * g_k g_k^T / L_k + diag((sqrt(v) + eps) / eta)) delta = -m.

    A loss c times as large (c L_k, c g_k) gives the same delta. Without rows delta is exactly Adam's step. Where the
    views' gradients agree that Adam's step would take off more loss than there is, delta is shorter.

    The system needs shares and gradients of one loss. The renderers give as L_k (`GaussianGradients.view_losses`) the
    share of the L1 error, summed over the three channels and averaged over the samples, whatever the loss. Two things
    follow. Our losses are means over channels too, so L_k is 3 times their share, and `curvature` acts as a third of
    itself. If only the loss is multiplied by c (a sum instead of a mean, loss scaling), the rows' term grows by c
    relative to Adam's, which shortens the steps where c > 1.

    `units: paper` is the printed equation, (J^T J + diag(sqrt(v) + eps)) delta = -m, with m and v uncorrected and the
    g_k as rows of J. The printed equation has no learning rate and depends on the unit of the loss; `paper` is there
    for comparison.

    Args:
        eps: added to sqrt(v); no setting. A loss scaled by 1e-6 then gives equal steps down to gradients of 1e-12. The
            value is not below what v can hold: where g^2 underflows in float32 (|g| < 1.2e-21), m / eps is still less
            than one.
        units: the system that is solved, `balanced` or the printed one, `paper`.
        rows: rows of J: one per view, or one, their sum (rank 1).
        curvature: weight of the rows' term. If L_k were true shares, 1/2 would be Gauss-Newton for a loss r^2 / 2, and
            1 Gauss-Newton for |r| (iteratively reweighted). With the L_k above and a mean over channels, 0.5 acts as
            1/6. `balanced` only.
        max_step: largest entry of delta in learning rates, or Adam's own entry where that is longer. Coupling can move
            a parameter whose own gradient is near zero so far that the linear model no longer holds. 1 is the length of
            Adam's step for gradients that always agree; 0 turns the bound off. `balanced` only, as the printed equation
            has no learning rates.
    """

    eps: float = field(default=1e-20, metadata={"setting": False})
    units: Literal["balanced", "paper"] = "balanced"
    rows: Literal["views", "summed"] = "views"
    curvature: float = 0.5
    max_step: float = 1.0

    @property
    def per_view(self) -> bool:
        return self.rows == "views"

    @property
    def lm(self) -> MomentLMParams:
        return MomentLMParams(self.units, self.rows, self.curvature, self.max_step)
