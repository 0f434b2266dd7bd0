"""Parts of density controllers (statistics of a window, finite Gaussians, one that always stays, a removal), and the
controller that changes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.engine.moments import check_state
from turbogs_plugin.strategies.checks import require_settings
from turbogs_plugin.strategies.protocols import DensityController
from turbogs_plugin.types import Gaussians, GaussianStats, RowUpdate, Step


@dataclass
class NoDensity(DensityController):
    """The set of Gaussians stays as it is.

    Args:
        max_gaussians: most initial Gaussians. 0: no cap.
    """

    max_gaussians: int = 0

    def __post_init__(self) -> None:
        require_settings(self)

    def event_due(self, step: Step) -> bool:
        return False

    def update(self, gaussians: Gaussians, step: Step) -> RowUpdate | None:
        return None


class WindowedDensity(DensityController):
    """A density control that keeps the statistics of a window of iterations, until it needs no more of them."""

    stats: GaussianStats | None = None

    @property
    def window(self) -> GaussianStats:
        """The statistics. Raises RuntimeError, an error of the caller's code, where none are kept."""
        if self.stats is None:
            raise RuntimeError("density control has no statistics before setup, nor after its last event")
        return self.stats

    def setup(self, gaussians: Gaussians) -> None:
        self.stats = GaussianStats.zeros(len(gaussians), gaussians.device)

    def apply(self, update: RowUpdate) -> None:
        if self.stats is not None:
            self.stats = self.stats.map(update.apply_state)

    def state_dict(self) -> dict[str, Any]:
        return {"stats": None if self.stats is None else dict(vars(self.stats))}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        if state["stats"] is None:  # after the last event
            self.stats = None
        else:
            check_state(state["stats"], vars(self.window), "density stats")
            for name, value in vars(self.window).items():
                value.copy_(state["stats"][name])


def add_stats(window: GaussianStats, new: GaussianStats) -> None:
    """Add statistics to a window's sums, in place."""
    for name, value in vars(new).items():
        total = getattr(window, name)
        if name == "max_radii":
            torch.maximum(total, value, out=total)
        else:
            total += value


def finite_rows(gaussians: Gaussians) -> Tensor:
    """[N] bool: every parameter of the Gaussian is finite, and so are its variances, which a split needs."""
    return gaussians.finite_rows() & ((2 * gaussians.scales.amax(dim=1)).exp() < torch.inf)


def keep_one(kept: Tensor, gaussians: Gaussians) -> tuple[Tensor, int]:
    """The mask [N] and how many it keeps. If it would keep none, the most opaque (finite) Gaussian is added to it."""
    count = int(kept.sum())
    if count > 0:
        return kept, count
    kept = kept.clone()
    kept[torch.where(finite_rows(gaussians), gaussians.opacities, -torch.inf).argmax()] = True
    return kept, 1


def removal(pruned: Tensor) -> RowUpdate | None:
    """The change that removes the Gaussians of the mask [N]; None if there are none."""
    source = torch.nonzero(~pruned).squeeze(-1)
    if len(source) == len(pruned):
        return None
    return RowUpdate(source, torch.zeros_like(source, dtype=torch.bool), {}, num_pruned=len(pruned) - len(source))
