"""Which Gaussians a pass leaves out."""

from __future__ import annotations

import torch
from torch import Tensor

from turbogs_plugin.engine.reference.philox import PURPOSE_DROPOUT, random_words
from turbogs_plugin.engine.rules import Dropout


def kept(dropout: Dropout, count: int, device: torch.device) -> Tensor | None:
    """[N] bool, the Gaussians that are not left out: row n is one if word 0 of place n is not below the threshold.

    None where all stay.
    """
    if dropout.threshold == 0:
        return None
    rows = torch.arange(count, device=device)
    return random_words(rows, 0, PURPOSE_DROPOUT, dropout.seed, dropout.iteration)[0] >= dropout.threshold
