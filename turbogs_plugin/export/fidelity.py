"""What a model loses on its way into a file: its error on test views before and after."""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import fmean

import numpy as np
import torch

from turbogs_plugin.engine.rendering import RasterSettings
from turbogs_plugin.scene import PosedImages
from turbogs_plugin.train.evaluate import psnr, render_view
from turbogs_plugin.types import Gaussians

MOST_VIEWS = 8
"""Test views that are measured, evenly spread: each is rendered once more for every model."""


@dataclass(frozen=True)
class Change:
    """Mean PSNR in dB on test views, of the model and of what became of it.

    Args:
        before, after: in dB.
        views, of: how many were measured, of how many.
    """

    before: float
    after: float
    views: int
    of: int

    def text(self) -> str:
        loss = self.before - self.after
        change = "nothing lost" if abs(loss) < 0.005 else f"{loss:.2f} dB lost" if loss > 0 else f"{-loss:.2f} dB won"
        return f"PSNR {self.before:.2f} -> {self.after:.2f} dB on {self.views} of {self.of} test views: {change}"


class Fidelity:
    """Measures models on the same few test views.

    Args:
        gaussians: the model, on the device where all are rendered.
        views: the test views, on any device.
        sh_degree: of the bands in use.
        settings: of rendering.

    Raises:
        ValueError: there are no test views.
    """

    def __init__(self, gaussians: Gaussians, views: PosedImages, sh_degree: int, settings: RasterSettings) -> None:
        if not len(views):
            raise ValueError("there are no test views")
        self._views, self._device, self._degree, self._settings = views, gaussians.device, sh_degree, settings
        shown = np.linspace(0, len(views) - 1, min(MOST_VIEWS, len(views)))
        self.view_ids = np.unique(shown.round().astype(int)).tolist()
        self.before = self.psnr(gaussians)

    def psnr(self, gaussians: Gaussians) -> float:
        """Mean PSNR in dB of a model in the scene's frame, on any device."""
        return fmean(psnr(self.image(gaussians, view), self.photo(view)) for view in self.view_ids)

    def image(self, gaussians: Gaussians, view_id: int) -> torch.Tensor:
        """[H, W, 3] float32, 0 .. 1, on the device: a model seen by one of the test cameras."""
        model = gaussians.map(lambda value: value.to(self._device))
        degree = min(self._degree, model.sh_degree)
        views = PosedImages(self._views.cameras.to(self._device), self._views.names, self._views.photos)
        return render_view(model, views, view_id, degree, self._settings)

    def photo(self, view_id: int) -> torch.Tensor:
        """[H, W, 3] float32, 0 .. 1, on the device."""
        return self._views.photos.image(view_id).to(self._device)

    def change(self, gaussians: Gaussians) -> Change:
        """What became of the model."""
        after = self.psnr(gaussians) if len(gaussians) else math.nan
        return Change(self.before, after, len(self.view_ids), len(self._views))
