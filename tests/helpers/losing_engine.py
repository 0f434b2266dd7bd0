"""The reference engine with a pass that has too little memory, as a GPU's may have."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.engine import ReferenceEngine
from turbogs_plugin.engine.reference.raster import rasterize_reference
from turbogs_plugin.engine.render_pass import Rendered


class LosingEngine(ReferenceEngine):
    """Args:
    lose: the pass that has too little memory: until `recover`, nothing changes. None: none has.
    """

    def __init__(self, lose: int | None = None) -> None:
        self.lose, self.passes, self.recovered = lose, 0, 0
        self.flag = torch.zeros(1, dtype=torch.int32)

    @property
    def overflow(self) -> Tensor:
        return self.flag

    def render(self, *arguments: Any) -> Rendered:
        self.passes += 1
        if self.passes == self.lose:
            self.flag.fill_(1)
        return rasterize_reference(*arguments)

    def update(self, *arguments: Any) -> None:
        if not self.flag:
            super().update(*arguments)

    def recover(self) -> None:
        self.flag.zero_()
        self.recovered += 1
