"""The state of Adam and of moment-damped LM: first and second moments of every Gaussian, and how they are laid out."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.engine.layout import ParameterRow, columns
from turbogs_plugin.errors import InputError, require
from turbogs_plugin.types import Gaussians, RowUpdate

COLUMNS = columns(ParameterRow)
"""Where each parameter lies in a packed row: all parameters but the higher bands."""


@dataclass
class GaussianMoments:
    """Adam's state of N Gaussians.

    Args:
        exp_avg, exp_avg_sq: [N, 14], the order of `COLUMNS`.
        exp_avg_shN, exp_avg_sq_shN: [N, B * 3].
        steps: [N] int32, number of updates of each Gaussian and of those it was made of. The bias correction uses it. A
            new Gaussian has moments of zero and its source's count, as with torch's Adam and gsplat's operations. So
            its moments are hardly corrected, and its first steps are 3 to 6 times the rate. That is intended: they
            bring it to its place.
        skipped: [] int64, updates skipped since the start of the run because of a non-finite gradient. Stays on the
            device, as reading it would wait for the device.
    """

    exp_avg: Tensor
    exp_avg_sq: Tensor
    exp_avg_shN: Tensor
    exp_avg_sq_shN: Tensor
    steps: Tensor
    skipped: Tensor

    @classmethod
    def zeros(cls, gaussians: Gaussians) -> GaussianMoments:
        """The state of Gaussians that were never updated, with their dtype and device."""
        count, new = len(gaussians), gaussians.means.new_zeros
        packed, coefficients = (count, ParameterRow.SIZE), (count, gaussians.shN.shape[1] * 3)
        steps, skipped = new(count, dtype=torch.int32), new((), dtype=torch.int64)
        return cls(new(packed), new(packed), new(coefficients), new(coefficients), steps, skipped)

    def apply(self, update: RowUpdate) -> None:
        """Follow a change of the set of Gaussians."""
        for name in ("exp_avg", "exp_avg_sq", "exp_avg_shN", "exp_avg_sq_shN"):
            setattr(self, name, update.apply_state(getattr(self, name)))
        self.steps = self.steps[update.source]
        for name in update.reset:
            for moment in ("exp_avg", "exp_avg_sq"):
                self.part(moment, name).zero_()

    def part(self, moment: str, name: str) -> Tensor:
        """[N, D] the moment (`exp_avg` or `exp_avg_sq`) of one parameter: a view, not a copy."""
        return getattr(self, f"{moment}_shN") if name == "shN" else getattr(self, moment)[:, COLUMNS[name]]

    def state_dict(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load a saved state. Raises `InputError` if its number of Gaussians or bands is another."""
        check_state(state, self.state_dict())
        for field in fields(self):
            present = getattr(self, field.name)
            setattr(self, field.name, state[field.name].to(device=present.device, dtype=present.dtype, copy=True))


def check_state(saved: dict[str, Any], present: dict[str, Tensor], owner: str = "optimizer state") -> None:
    """Raise `InputError`, which names the owner, if a saved state lacks a tensor of the present one, or has one of
    another shape."""
    for name, value in present.items():
        if name not in saved or saved[name].shape != value.shape:
            found = f"shape {tuple(saved[name].shape)}" if name in saved else "nothing"
            expected = f"expected shape {tuple(value.shape)}; is it of another model?"
            raise InputError(f"{owner} {name}: found {found}, {expected}")


def check_moments_config(beta1: float, beta2: float, eps: float) -> None:
    """Raise `InputError` for values that Adam cannot use."""
    for name, beta in (("beta1", beta1), ("beta2", beta2)):
        require(0 <= beta < 1, name, beta, "at least 0 and less than 1")
    require(math.isfinite(eps) and eps >= 1e-20, "eps", eps, "a finite number >= 1e-20")
