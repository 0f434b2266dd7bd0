"""What density controllers share: statistics of a window, usable Gaussians, one that always stays, a removal."""

from __future__ import annotations

from typing import Any, TypeVar

import torch
from torch import Tensor
from turbogs_plugin.strategies.protocols import DensityController

from turbogs_plugin.errors import InputError
from turbogs_plugin.types import Gaussians, GaussianStats, RowUpdate

RowsType = TypeVar("RowsType")  # a dataclass of [N] tensors


class WindowedDensity(DensityController):
    """A density control that keeps the statistics of a window of iterations; None once it needs no more of them."""

    _stats: GaussianStats | None = None

    @property
    def stats(self) -> GaussianStats | None:
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
    """Add statistics to those of a window, in place."""
    for name, value in vars(new).items():
        total = getattr(window, name)
        if name == "max_radii":
            torch.maximum(total, value, out=total)
        else:
            total += value


def saved_rows(rows: RowsType | None) -> dict[str, Tensor] | None:
    """What `loaded_rows` takes: name of a field -> [N], or None."""
    return None if rows is None else dict(vars(rows))


def loaded_rows(name: str, saved: dict[str, Tensor] | None, present: RowsType | None) -> RowsType | None:
    """What a state holds of Gaussians, as copies on the device of what is there, which must be of as many.

    Args:
        name: of the entry, for the error.
        saved: of `saved_rows`; None where the saved run needed them no more.
        present: what `setup` made.
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
    """[N] bool: every parameter of the Gaussian is finite, and so are its variances, that its halves may be, too."""
    values = [value for _, value in gaussians.items()] + [(2 * gaussians.scales).exp()]
    return torch.stack([torch.isfinite(value.reshape(len(value), -1)).all(dim=-1) for value in values]).all(dim=0)


def leave_one(pruned: Tensor, gaussians: Gaussians) -> Tensor:
    """The mask [N], without the most opaque (finite) Gaussian where it would leave none."""
    if not bool(pruned.all()):
        return pruned
    pruned = pruned.clone()
    pruned[torch.where(finite_rows(gaussians), gaussians.opacities, -torch.inf).argmax()] = False
    return pruned


def removal(pruned: Tensor) -> RowUpdate | None:
    """The change that leaves out the Gaussians of the mask [N]; None where there are none."""
    source = torch.nonzero(~pruned).squeeze(-1)
    if len(source) == len(pruned):
        return None
    return RowUpdate(source, torch.zeros_like(source, dtype=torch.bool), {}, num_pruned=len(pruned) - len(source))
