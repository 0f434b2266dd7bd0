"""No density control."""

from __future__ import annotations

from dataclasses import dataclass

from turbogs_plugin.strategies.checks import require_settings
from turbogs_plugin.strategies.protocols import DensityController
from turbogs_plugin.types import Gaussians, RowUpdate, Step


@dataclass
class NoDensity(DensityController):
    """The set of Gaussians stays as it is.

    Args:
        max_gaussians: cap on the initial number of Gaussians. 0: no cap.
    """

    max_gaussians: int = 0

    def __post_init__(self) -> None:
        require_settings(self)

    def event_due(self, step: Step) -> bool:
        return False

    def update(self, gaussians: Gaussians, step: Step) -> RowUpdate | None:
        return None
