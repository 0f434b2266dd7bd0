"""What every optimizer of Gaussians shares, whoever carries it out: the state, its layout, and the rule of a step.

A step is a function of (parameters, gradients, `GaussianMoments`, `UpdateRule`). The torch form of it is in `adam.py`
and `moment_lm.py`; a CUDA twin gets the same two objects (see `take_fused_step`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, Literal

import torch
from torch import Tensor

from turbogs_plugin.engine.rendered import ScreenGradients
from turbogs_plugin.errors import InputError, require
from turbogs_plugin.strategies.learning_rates import ParameterRates
from turbogs_plugin.types import GaussianGradients, Gaussians, RowUpdate

COLUMNS = {
    "means": slice(0, 3),
    "scales": slice(3, 6),
    "quats": slice(6, 10),
    "sh0": slice(10, 13),
    "opacities": slice(13, 14),
}
"""Where each parameter lies in a packed row of 14."""

GEOMETRY, APPEARANCE = slice(0, 10), slice(10, 14)
"""The two blocks of a packed row that moment-damped LM solves."""

GRADIENT_LIMIT = 1e17
"""Gradients are cut here, so that the square of a sum over up to 100 views stays finite in float32 (largest 3.4e38)."""


@dataclass(frozen=True)
class MomentLMParams:
    """What moment-damped LM needs beyond Adam; see `MomentLMOptimizer` for the meaning of each."""

    units: Literal["balanced", "paper"]
    rows: Literal["views", "summed"]
    solver: Literal["cholesky", "low_rank"]
    curvature: float
    max_step: float


@dataclass(frozen=True)
class UpdateRule:
    """One step's rule: Adam, or with `lm` moment-damped LM on the two blocks and Adam on the higher bands.

    Args:
        rates: learning rate of each parameter at this iteration.
        beta1, beta2: decay of the moments.
        eps: added to sqrt(v), after the bias correction of v.
        lm: None for Adam.
    """

    rates: ParameterRates
    beta1: float
    beta2: float
    eps: float
    lm: MomentLMParams | None = None

    def packed_rates(self, like: Tensor) -> Tensor:
        """[14] the rates in the order of a packed row, in the dtype and on the device of `like`."""
        rates = [getattr(self.rates, name) for name, s in COLUMNS.items() for _ in range(s.stop - s.start)]
        return torch.tensor(rates, dtype=like.dtype, device=like.device)


@dataclass
class GaussianMoments:
    """Adam's state of N Gaussians.

    Args:
        exp_avg, exp_avg_sq: [N, 14], the order of `COLUMNS`.
        exp_avg_shN, exp_avg_sq_shN: [N, B * 3].
        steps: [N] int32, updates that each Gaussian and the ones it was made of have had; its bias correction counts
            these. A new one has moments of zero and its source's count, as with torch's Adam and gsplat's surgery: as
            nothing corrects them, its first steps are 3 to 6 times the rate, by which it finds its place.
        skipped: [] int64, updates left out because of a non-finite gradient, since the start of the run. Stays on the
            device: reading it is a synchronisation.
    """

    exp_avg: Tensor
    exp_avg_sq: Tensor
    exp_avg_shN: Tensor
    exp_avg_sq_shN: Tensor
    steps: Tensor
    skipped: Tensor

    @classmethod
    def zeros(cls, gaussians: Gaussians) -> GaussianMoments:
        """State of Gaussians that were never updated, in their dtype and on their device."""
        count, bands = len(gaussians), gaussians.shN.shape[1] * 3
        return cls(
            *(gaussians.means.new_zeros(count, 14) for _ in range(2)),
            *(gaussians.means.new_zeros(count, bands) for _ in range(2)),
            torch.zeros(count, dtype=torch.int32, device=gaussians.device),
            torch.zeros((), dtype=torch.int64, device=gaussians.device),
        )

    def __len__(self) -> int:
        return self.steps.shape[0]

    def apply(self, update: RowUpdate) -> None:
        """Follow a change of the set of Gaussians."""
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "steps":
                self.steps = value[update.source]
            elif field.name != "skipped":
                setattr(self, field.name, update.apply_state(value))
        for name in update.reset:
            for moment in ("exp_avg", "exp_avg_sq"):
                if name == "shN":
                    getattr(self, f"{moment}_shN").zero_()
                else:
                    getattr(self, moment)[:, COLUMNS[name]] = 0

    def state_dict(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take a saved state. Raises `InputError` where it is not one of as many Gaussians and bands as this."""
        check_state(state, self.state_dict())
        for field in fields(self):
            present = getattr(self, field.name)
            setattr(self, field.name, state[field.name].to(device=present.device, dtype=present.dtype, copy=True))


def take_fused_step(
    gaussians: Gaussians, gradients: ScreenGradients, moments: GaussianMoments, rule: UpdateRule
) -> bool:
    """The one place where a kernel takes over: gradients that know the whole way to the parameters offer
    ``fused_step(gaussians, moments, rule)``, which changes the first two in place as the torch form would.

    Returns:
        Whether it was done.
    """
    fused_step = getattr(gradients, "fused_step", None)
    if fused_step is None:
        return False
    fused_step(gaussians, moments, rule)
    return True


def packed_rows(gradients: GaussianGradients, index: Tensor) -> Tensor:
    """[K, n, 14] gradients of the Gaussians `index` [n] in the order of `COLUMNS`, cut at `GRADIENT_LIMIT`."""
    columns = [getattr(gradients, name)[:, index].flatten(2) for name in ("means", "scales", "quats", "sh0")]
    columns.append(gradients.opacities[:, index].unsqueeze(-1))
    return clipped(torch.cat(columns, dim=-1))


def clipped(gradient: Tensor) -> Tensor:
    """The gradient cut at `GRADIENT_LIMIT`."""
    return gradient.clamp(-GRADIENT_LIMIT, GRADIENT_LIMIT)


def finite_gradients(gradients: GaussianGradients) -> Tensor:
    """[N] bool: every gradient of the Gaussian is finite, in every view."""
    finite = torch.isfinite(gradients.shN.flatten(1)).all(dim=-1)
    for name in COLUMNS:
        value = getattr(gradients, name)
        finite &= torch.isfinite(value).unsqueeze(-1).flatten(2).all(dim=-1).all(dim=0)
    return finite


def updatable(gradients: GaussianGradients, moments: GaussianMoments) -> Tensor:
    """[n] int64: the touched Gaussians whose every gradient is finite; the others are added to `moments.skipped`."""
    finite = finite_gradients(gradients)
    moments.skipped += (gradients.touched & ~finite).sum()
    return torch.nonzero(gradients.touched & finite).squeeze(-1)


@dataclass
class AdamTerms:
    """What an update of n Gaussians is made of: bias-corrected m, and sqrt(v) + eps of bias-corrected v; [n, D]."""

    mean: Tensor
    denominator: Tensor

    def delta(self, rates: Tensor | float) -> Tensor:
        """[n, D] Adam's change of the parameters."""
        return -(rates * (self.mean / self.denominator))


def advance(exp_avg: Tensor, exp_avg_sq: Tensor, gradient: Tensor, index: Tensor, steps: Tensor, rule: UpdateRule):
    """Move the moments of the Gaussians `index` [n] on by their gradients [n, D]. `steps`: [n], this one included.

    1 - beta is formed in double, and the bias correction 1 - beta^t as -expm1(t log beta): either difference taken in
    float32 would be off by 5e-5 of itself for beta = 0.999.
    """
    mean = torch.lerp(exp_avg[index], gradient, 1 - rule.beta1)
    square = torch.lerp(exp_avg_sq[index], gradient * gradient, 1 - rule.beta2)
    exp_avg[index], exp_avg_sq[index] = mean, square
    count = steps.to(gradient.dtype).unsqueeze(-1)  # [n, 1]
    mean_correction = -torch.expm1(count * math.log(rule.beta1)) if rule.beta1 > 0 else 1.0
    square_correction = -torch.expm1(count * math.log(rule.beta2)) if rule.beta2 > 0 else 1.0
    return AdamTerms(mean / mean_correction, torch.sqrt(square / square_correction) + rule.eps)


def add_packed(gaussians: Gaussians, index: Tensor, delta: Tensor) -> None:
    """Add [n, 14] changes to the Gaussians `index`, in place."""
    for name, columns in COLUMNS.items():
        value = getattr(gaussians, name)
        value.index_add_(0, index, delta[:, columns].reshape(-1, *value.shape[1:]))


def add_shN(gaussians: Gaussians, index: Tensor, delta: Tensor) -> None:
    """Add [n, B * 3] changes to the higher bands of the Gaussians `index`, in place."""
    gaussians.shN.index_add_(0, index, delta.reshape(len(index), *gaussians.shN.shape[1:]))


def check_state(saved: dict[str, Any], present: dict[str, Tensor]) -> None:
    """Raise `InputError` where a saved state lacks a tensor of the present one, or has it of another shape."""
    for name, value in present.items():
        if name not in saved or saved[name].shape != value.shape:
            found = f"shape {tuple(saved[name].shape)}" if name in saved else "nothing"
            raise InputError(
                f"optimizer state {name}: found {found}, expected shape {tuple(value.shape)}; is it of another model?"
            )


def check_moments_config(beta1: float, beta2: float, eps: float) -> None:
    """Raise `InputError` for values that Adam cannot use."""
    for name, beta in (("beta1", beta1), ("beta2", beta2)):
        require(0 <= beta < 1, name, beta, "at least 0 and less than 1")
    require(math.isfinite(eps) and eps >= 1e-20, "eps", eps, "a finite number >= 1e-20")
