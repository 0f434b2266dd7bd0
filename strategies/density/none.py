"""No density control."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from turbogs_plugin.errors import require_not_negative
from turbogs_plugin.types import Gaussians, GaussianStats, RowUpdate, Step


@dataclass
class NoDensity:
    """The set of Gaussians stays as it is.

    Args:
        max_gaussians: cap on the points that a model begins with. 0: no cap.
    """

    max_gaussians: int = 0

    def __post_init__(self) -> None:
        require_not_negative(self, "max_gaussians")

    @property
    def stats(self) -> GaussianStats | None:
        return None

    def setup(self, gaussians: Gaussians) -> None:
        pass

    def update(self, gaussians: Gaussians, step: Step) -> RowUpdate | None:
        return None

    def apply(self, update: RowUpdate) -> None:
        pass

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass
