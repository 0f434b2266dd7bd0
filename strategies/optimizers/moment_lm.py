"""Moment-damped Levenberg-Marquardt on two small blocks per Gaussian (paper section 3.9 and appendix)."""

from __future__ import annotations

from dataclasses import dataclass, field

from turbogs_plugin.strategies.optimizers.sparse_adam import SparseAdam


@dataclass
class MomentLMOptimizer(SparseAdam):
    """Moment-damped LM on a geometry block (mean 3, scale 3, quaternion 4) and an appearance block (band 0, opacity);
    Adam on the higher bands.

    With g_k a Gaussian's gradient in view k, J the matrix whose rows are the g_k, m and v the moments of the summed
    gradient without bias correction, and eta the learning rates, a step is ``eta * delta`` with the printed equation::

        (J^T J + diag(sqrt(v) + eps)) delta = -m

    The printed equation has no learning rate: where gradients are small, delta is about -m / sqrt(v), a step of about
    1 in every parameter. `J^T J` has the unit of a gradient squared and `sqrt(v)` of a gradient, so the step depends on
    the unit of the loss: of a loss c times as large, `J^T J` counts c times as much beside the damping.

    Args:
        eps: added to sqrt(v); no setting. The value is not below what v can hold: where g^2 underflows in float32
            (|g| < 1.2e-21), m / eps is still less than one.
        scaled: multiply delta by the learning rates. False is the equation as printed, for comparison.
    """

    eps: float = field(default=1e-20, metadata={"setting": False})
    scaled: bool = True

    @property
    def kind(self) -> str:
        return "moment_lm" if self.scaled else "unscaled_lm"
