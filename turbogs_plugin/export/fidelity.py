"""The loss of a model on its way into a file: its error on test views before and after."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from statistics import fmean

import numpy as np
import torch

from turbogs_plugin.scene import PosedImages
from turbogs_plugin.scene.geometry import evenly
from turbogs_plugin.train.look import Look
from turbogs_plugin.train.metrics import psnr, render_view
from turbogs_plugin.types import Gaussians

MOST_VIEWS = 8
"""Test views that are measured, evenly spread: each is rendered once more for every model."""


@dataclass(frozen=True)
class Change:
    """PSNR in dB on test views, of the model and of what became of it.

    Args:
        before, after: means; `after` is NaN where no Gaussian is left.
        views, of: number of measured views, and of all test views.
        worst_view, worst_loss: name of the measured view that lost most, and how much it lost.
        equal: whether every number of the model stayed.
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


def measure_change(model: Gaussians, other: Gaussians, views: PosedImages, look: Look) -> Change:
    """Compare a model with what became of it, on at most `MOST_VIEWS` views.

    Args:
        model: on the device that renders.
        other: in the scene's frame, on any device.
        views: the test views, at least one, on any device. Masked pixels do not count.
        look: how the models are shown; without exposures, as a file of a model holds none.
    """
    other = other.map(lambda value: value.to(model.device))
    view_ids = evenly(len(views), MOST_VIEWS)
    before = [view_psnr(model, views, view, look) for view in view_ids]
    counts = (len(view_ids), len(views))
    if not len(other):
        return Change(fmean(before), math.nan, *counts)
    after = [view_psnr(other, views, view, look) for view in view_ids]
    losses = [first - second for first, second in zip(before, after, strict=True)]
    place = int(np.argmax(losses))
    pairs = zip(model.items(), other.items(), strict=True)
    equal = all(torch.equal(value, changed) for (_, value), (_, changed) in pairs)
    return Change(fmean(before), fmean(after), *counts, views.names[view_ids[place]], losses[place], equal)


def view_psnr(model: Gaussians, views: PosedImages, view_id: int, look: Look) -> float:
    """PSNR in dB of a model in one view, on the model's device, as an evaluation measures it."""
    shown = replace(views, cameras=views.cameras.to(model.device), masks=None)
    image = render_view(model, shown, view_id, replace(look, sh_degree=min(look.sh_degree, model.sh_degree)))
    photo, mask = views.photos.image(view_id, look.background).to(model.device), views.mask(view_id)
    if mask is None:
        return psnr(image, photo)
    return psnr(image[mask.to(model.device)], photo[mask.to(model.device)])
