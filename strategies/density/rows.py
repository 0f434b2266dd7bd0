"""Parts of density controllers (statistics of a window, finite Gaussians, one that always stays, a removal), and the
controller that changes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from torch import Tensor

from turbogs_plugin.errors import InputError
from turbogs_plugin.strategies.checks import require_settings
from turbogs_plugin.strategies.protocols import DensityController
from turbogs_plugin.types import Gaussians, GaussianStats, RowUpdate, Step

RowsType = TypeVar("RowsType")  # a dataclass of [N] tensors


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

    _stats: GaussianStats | None = None

    @property
    def stats(self) -> GaussianStats | None:
        return self._stats

    @property
    def window(self) -> GaussianStats:
        """The statistics. Raises RuntimeError, an error of the caller's code, where none are kept."""
        if self._stats is None:
            raise RuntimeError(
                "density control keeps no statistics: call setup before, and nothing after its last event"
            )
        return self._stats

    def setup(self, gaussians: Gaussians) -> None:
        self._stats = GaussianStats.zeros(len(gaussians), gaussians.device)

    def apply(self, update: RowUpdate) -> None:
        if self._stats is not None:
            self._stats = self._stats.map(update.apply_state)

    def state_dict(self) -> dict[str, Any]:
        return {"stats": saved_rows(self._stats)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._stats = loaded_rows("stats", state["stats"], self._stats)


def add_stats(window: GaussianStats, new: GaussianStats) -> None:
    """Add statistics to a window's sums, in place."""
    for name, value in vars(new).items():
        total = getattr(window, name)
        if name == "max_radii":
            torch.maximum(total, value, out=total)
        else:
            total += value


def saved_rows(rows: RowsType | None) -> dict[str, Tensor] | None:
    """The state that `loaded_rows` takes: name of a field -> [N], or None."""
    return None if rows is None else dict(vars(rows))


def loaded_rows(name: str, saved: dict[str, Tensor] | None, present: RowsType | None) -> RowsType | None:
    """Saved rows as copies on the device of the present ones, which must have the same number of Gaussians.

    Args:
        name: of the entry, for the error message.
        saved: from `saved_rows`; None if the saved run no longer needed them.
        present: from `setup`.
    """
    if saved is None:
        return None
    if present is None:
        raise InputError(f"density {name}: nothing to load into, call setup with the model of the saved run first")
    like = next(iter(vars(present).values()))
    for key, value in saved.items():
        if value.shape != like.shape:
            raise InputError(
                f"density {name}.{key} has shape {tuple(value.shape)}, expected {tuple(like.shape)}: "
                "load the state together with its own model"
            )
    return type(present)(**{key: value.to(like.device, copy=True) for key, value in saved.items()})


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
