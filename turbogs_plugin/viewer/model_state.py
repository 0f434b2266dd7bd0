"""The state that pictures show: a model, and where there is one, its capture and what its training keeps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from turbogs_plugin.engine.render_pass import DEFAULT_SETTINGS, RasterSettings
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.scene import PosedImages
from turbogs_plugin.types import BLACK, Color, Gaussians, PixelSamples, RowUpdate, Step


@dataclass
class DensityChange:
    """The last event of density control.

    Args:
        iteration: when it happened.
        update: what it did; its `fresh` are the rows of the present model that it added.
        removed: the Gaussians that it took away; a Gaussian that was split is replaced, not removed.
    """

    iteration: int
    update: RowUpdate
    removed: Gaussians

    @classmethod
    def of(cls, before: Gaussians, update: RowUpdate, iteration: int) -> DensityChange:
        """The change that `update` makes to the model `before` it."""
        gone = torch.ones(len(before), dtype=torch.bool, device=before.device)
        gone[update.source] = False
        return cls(iteration, update, before.map(lambda value: value[gone]))


@dataclass(frozen=True)
class CaptureViews:
    """The views of a capture under one numbering: training views, then test views.

    Args:
        train, test: cameras and photos, wherever their photos are kept.
    """

    train: PosedImages
    test: PosedImages

    def __len__(self) -> int:
        return len(self.train) + len(self.test)

    def find(self, number: int) -> tuple[PosedImages, int]:
        """The set that a view belongs to, and its number there."""
        count = len(self.train)
        return (self.train, number) if number < count else (self.test, number - count)

    def name(self, number: int) -> str:
        views, view_id = self.find(number)
        kind = "training" if views is self.train else "test"
        return f"{views.names[view_id]} ({kind} view {view_id + 1} of {len(views)})"


@dataclass
class ModelState:
    """All that a picture may show. Pictures that need what is None say so.

    Args:
        gaussians: the model, on the device that renders.
        sh_degree: highest degree of spherical harmonics in use.
        settings: of the rasterizer.
        background: behind the model, and behind transparent photos.
        capture: its views, for training and for testing.
        maps: errors and ages of the training views.
        step: the time from which ages count.
        samples: pixels of the last iteration.
        change: the last event of density control.
    """

    gaussians: Gaussians
    sh_degree: int
    settings: RasterSettings = DEFAULT_SETTINGS
    background: Color = BLACK
    capture: CaptureViews | None = None
    maps: ErrorMaps | None = None
    step: Step | None = None
    samples: PixelSamples | None = None
    change: DensityChange | None = None

    @property
    def options(self) -> dict[str, Any]:
        """Options of `render_image`."""
        return {"sh_degree": self.sh_degree, "settings": self.settings, "background": self.background}
