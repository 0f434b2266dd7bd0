"""How processes keep one state: the first one's change of the set of Gaussians goes to all, and states are compared."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.distributed.ranks import ProcessRanks
from turbogs_plugin.errors import TrainingStopped
from turbogs_plugin.model.torch_file import leaves
from turbogs_plugin.types import RowUpdate

STEP = 0x9E3779B97F4A7C15 - (1 << 64)
"""2^64 over the golden ratio, as a signed number: multiples of it spread over all 64 bits."""

CHUNK = 1 << 22
"""Elements that `digest` takes at a time, to bound its memory."""


def digest(value: Tensor) -> int:
    """A number of 63 bits that changes with any bit of a tensor, wherever it is computed."""
    flat, total = value.detach().flatten(), torch.zeros((), dtype=torch.int64, device=value.device)
    kind = {1: torch.uint8, 2: torch.int16}.get(flat.element_size(), torch.int32)
    for start in range(0, len(flat), CHUNK):
        part = flat[start : start + CHUNK]
        copy = torch.empty(part.shape, dtype=part.dtype, device=part.device)  # a stride of 1, even of one element
        words = copy.copy_(part).view(kind).long()
        places = torch.arange(start, start + len(words), dtype=torch.int64, device=value.device)
        mixed = (words + 1) * (places * 2 + 1) * STEP
        total += (mixed ^ (mixed >> 29)).sum()
    return int(total) & ((1 << 63) - 1)


def require_equal(ranks: ProcessRanks, state: dict[str, Any]) -> None:
    """Raise `TrainingStopped` if a tensor or a number of a state differs between processes.

    Args:
        state: nested dicts; ``iteration`` is among them.
    """
    digests = {}
    for name, value in leaves(state, "state"):
        if isinstance(value, Tensor | int | float):
            kind = torch.float64 if isinstance(value, float) else None
            digests[name] = digest(torch.as_tensor(value, dtype=kind))
    for name, *values in zip(digests, *ranks.gather_numbers(list(digests.values())), strict=True):
        others = [rank for rank, value in enumerate(values) if value != values[0]]
        if others:
            raise TrainingStopped(
                f"iteration {state['iteration']}: {name} of rank {others[0]} differs from that of rank 0, though all "
                "make the same steps; do the GPUs and their software differ, or is one broken?"
            )


def first_change(ranks: ProcessRanks, update: RowUpdate | None, device: torch.device) -> RowUpdate | None:
    """The first process's change of the set of Gaussians, on all."""
    plain = None
    if update is not None:
        shapes = {name: value.shape for name, value in update.values.items()}
        plain = len(update.source), shapes, update.reset, (update.num_cloned, update.num_split, update.num_pruned)
    plain = ranks.agree(plain)
    if plain is None:
        return None
    count, shapes, reset, counts = plain
    if ranks.first and update is not None:
        source, fresh = update.source, update.fresh.to(torch.uint8)
        values = {name: value.contiguous() for name, value in update.values.items()}
    else:
        source = torch.empty(count, dtype=torch.int64, device=device)
        fresh = torch.empty(count, dtype=torch.uint8, device=device)
        values = {name: torch.empty(shape, device=device) for name, shape in shapes.items()}
    for tensor in (source, fresh, *values.values()):
        ranks.broadcast(tensor)
    return RowUpdate(source, fresh.bool(), values, reset, *counts)
