"""A digest of a tensor's bits that is quick to take where the tensor is."""

from __future__ import annotations

import torch
from torch import Tensor

STEP = 0x9E3779B97F4A7C15 - (1 << 64)
"""2^64 over the golden ratio, as a signed number: multiples of it spread over all 64 bits."""

CHUNK = 1 << 22
"""Elements that are taken at a time, to bound the memory."""


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
