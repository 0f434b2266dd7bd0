"""What density controllers share: usable Gaussians, one that always stays, a removal, statistics of a state."""

from __future__ import annotations

from dataclasses import fields
from typing import TypeVar

import torch
from torch import Tensor

from turbogs_plugin.errors import InputError
from turbogs_plugin.types import Gaussians, RowUpdate

RowsType = TypeVar("RowsType")  # a dataclass of [N] tensors


def loaded_rows(name: str, saved: dict[str, Tensor] | None, present: RowsType | None) -> RowsType | None:
    """What a state holds of Gaussians, as copies on the device of what is there, which must be of as many.

    Args:
        name: of the entry, for the error.
        saved: name of a field -> [N], or None where the saved run needed them no more.
        present: what `setup` made.
    """
    if saved is None:
        return None
    if present is None:
        raise InputError(f"density {name}: nothing to load into, call setup with the model of the saved run first")
    like = getattr(present, fields(present)[0].name)
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
