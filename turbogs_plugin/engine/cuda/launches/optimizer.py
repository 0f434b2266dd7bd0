"""Launches from the screen to the parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from .base import Launch, fields_of
from .common import ScreenBackward

if TYPE_CHECKING:
    from torch import Tensor


@dataclass
class ProjectionBackward(Launch):
    """Gradients of the parameters: a row for each view, or their sum. Every entry is written."""

    screen: ScreenBackward
    rows: Tensor  # [K or 1, N, 14] float32, layout.ParameterRow
    shN_gradients: Tensor  # [N, B, 3] float32
    touched: Tensor  # [N] bool
    view_losses: Tensor  # [K or 1, N] float32


Moments = fields_of("Tensor", "exp_avg exp_avg_sq exp_avg_shN exp_avg_sq_shN steps skipped")
"""`GaussianMoments`, float32 but for `steps`, int32, and `skipped`, int64."""


Rates = fields_of("float", "means quats scales opacities sh0 shN")
"""`ParameterRates`."""


@dataclass
class Copies:
    """How many bytes behind each parameter a copy of it lies, maybe in another GPU's memory; 0: no copy."""

    copy_0: int
    copy_1: int
    copy_2: int
    copy_3: int
    copy_4: int
    copy_5: int
    copy_6: int


NO_COPIES = Copies(*(0,) * 7)


@dataclass
class FusedStep(Launch):
    """Projection backward and one step of the optimizer, in place on Gaussians and moments, and on copies of the
    Gaussians."""

    screen: ScreenBackward
    copies: Copies
    moments: Moments
    kind: int  # of layout.UPDATE_KINDS
    rows_per_view: bool
    rates: Rates
    beta1: float
    beta2: float
    eps: float
    curvature: float
    max_step: float
