"""What a model loses on its way into a file: its error on test views before and after."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from statistics import fmean

import numpy as np
import torch

from turbogs_plugin.scene import PosedImages
from turbogs_plugin.scene.geometry import evenly
from turbogs_plugin.train.evaluate import Look, psnr, render_view
from turbogs_plugin.types import Gaussians

MOST_VIEWS = 8
"""Test views that are measured, evenly spread: each is rendered once more for every model."""


@dataclass(frozen=True)
class Change:
    """PSNR in dB on test views, of the model and of what became of it.

    Args:
        before, after: means; `after` is NaN where no Gaussian is left.
        views, of: how many were measured, of how many.
        worst_view, worst_loss: name of the measured view that lost most, and how much it lost.
        equal: whether every number of the model is as it was.
    """

    before: float
    after: float
    views: int
    of: int
    worst_view: str = ""
    worst_loss: float = 0.0
    equal: bool = False

    def text(self) -> str:
        measured = f"on {self.views} of {self.of} test views"
        if math.isnan(self.after):
            return f"PSNR {self.before:.3f} dB before {measured}, and none after: no Gaussian is left"
        change = f"{_lost(self.before - self.after)}; worst in {self.worst_view}: {_lost(self.worst_loss)}"
        if self.equal:
            change = "nothing lost, all numbers are equal"
        return f"PSNR {self.before:.3f} -> {self.after:.3f} dB {measured}: {change}"


def _lost(loss: float) -> str:
    if abs(loss) < 0.0005:
        return "less than 0.001 dB lost" if loss >= 0 else "less than 0.001 dB won"
    return f"{loss:.3f} dB lost" if loss > 0 else f"{-loss:.3f} dB won"


class Fidelity:
    """Measures models on the same few test views.

    Args:
        gaussians: the model, on the device where all are rendered.
        views: the test views, at least one, on any device. Masked pixels do not count.
        look: how it is shown; without exposures, as a file of a model holds none.

    Attributes:
        view_ids: those that are measured.
        before: mean PSNR in dB of the model.
    """

    def __init__(self, gaussians: Gaussians, views: PosedImages, look: Look) -> None:
        self._views, self._device, self._look = views, gaussians.device, look
        self.view_ids = evenly(len(views), MOST_VIEWS)
        self._model, self._before = gaussians, self.psnr(gaussians)
        self.before = fmean(self._before)

    def psnr(self, gaussians: Gaussians) -> list[float]:
        """[`view_ids`] PSNR in dB of a model in the scene's frame, on any device."""
        return [self._psnr(self.image(gaussians, view), view) for view in self.view_ids]

    def _psnr(self, image: torch.Tensor, view_id: int) -> float:
        photo, mask = self.photo(view_id), self.mask(view_id)
        return psnr(image, photo) if mask is None else psnr(image[mask], photo[mask])

    def image(self, gaussians: Gaussians, view_id: int) -> torch.Tensor:
        """[H, W, 3] float32, 0 .. 1, on the device: a model seen by one of the test cameras."""
        model = gaussians.map(lambda value: value.to(self._device))
        views = replace(self._views, cameras=self._views.cameras.to(self._device), masks=None)
        look = replace(self._look, sh_degree=min(self._look.sh_degree, model.sh_degree))
        return render_view(model, views, view_id, look)

    def photo(self, view_id: int) -> torch.Tensor:
        """[H, W, 3] float32, 0 .. 1, on the device: a transparent one on the background that the model has."""
        return self._views.photos.image(view_id, self._look.background).to(self._device)

    def mask(self, view_id: int) -> torch.Tensor | None:
        """[H, W] bool on the device, True where a pixel counts; None where all do."""
        mask = self._views.mask(view_id)
        return None if mask is None else mask.to(self._device)

    def change(self, gaussians: Gaussians) -> Change:
        """What became of the model."""
        counts = (len(self.view_ids), len(self._views))
        if not len(gaussians):
            return Change(self.before, math.nan, *counts)
        after = self.psnr(gaussians)
        losses = [before - now for before, now in zip(self._before, after, strict=True)]
        place = int(np.argmax(losses))
        worst = (self._views.names[self.view_ids[place]], losses[place])
        pairs = zip(self._model.items(), gaussians.items(), strict=True)
        equal = all(torch.equal(value, other.to(value.device)) for (_, value), (_, other) in pairs)
        return Change(self.before, fmean(after), *counts, *worst, equal)
