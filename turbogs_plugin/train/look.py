"""How a model is shown beside photos: the colour behind it, and the exposures of the photos.

Photos that were not trained get the exposures of the training photos taken before and after them: a camera's automatic
follows the light. Nothing of the photo itself is used but its name. Deutsch et al. (PPISP, CVPR 2026) have a network
predict it from the render: test photos are then compared with a model of their scene, not with a camera's settings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from turbogs_plugin.config.sections import parse_color
from turbogs_plugin.engine.reference.philox import PURPOSE_BACKGROUND, host_words
from turbogs_plugin.engine.render_pass import RasterSettings
from turbogs_plugin.scene.sequence import neighbours
from turbogs_plugin.types import BLACK, WHITE, Color, Step


@dataclass(frozen=True)
class Background:
    """Meaning of `train.background` for a capture."""

    fixed: Color | None
    """Colour of every iteration; None: a random one each."""
    evaluated: Color
    """Colour of evaluations and pictures."""

    @classmethod
    def of(cls, setting: str, transparent: bool) -> Background:
        """The background of a setting, beside photos that may be `transparent`. ``auto``, where no plan was made, is
        ``random`` for these: no colour of the model can stand for it, so what is empty in the photos becomes so in the
        model. Evaluations then show transparent photos on white, as published numbers of NeRF-synthetic are."""
        if setting == "random" or (setting == "auto" and transparent):
            return cls(None, WHITE if transparent else BLACK)
        color = BLACK if setting == "auto" else parse_color(setting)
        return cls(color, color)

    def at(self, step: Step) -> Color:
        """The colour of an iteration, a function of (seed, iteration) alone."""
        if self.fixed is not None:
            return self.fixed
        red, green, blue, _ = ((word.item() + 0.5) / 2.0**32 for word in host_words(PURPOSE_BACKGROUND, 1, step))
        return red, green, blue


@dataclass(frozen=True)
class Look:
    """How a model is shown beside the photos of V views, by `render_image`.

    Args:
        background: behind the model, and behind transparent photos.
        exposures: [V, 3, 4] of the views (`interpolated_exposures`); None: the model's own colours.
    """

    sh_degree: int
    settings: RasterSettings
    background: Color = BLACK
    exposures: Tensor | None = None
    antialiased: bool = False

    @property
    def options(self) -> dict[str, Any]:
        """Options of `render_image` for the model's own colours."""
        return {name: getattr(self, name) for name in ("sh_degree", "settings", "background", "antialiased")}

    def colors(self, colors: Tensor, view_id: int) -> Tensor:
        """[H, W, 3], 0 .. 1: the model's own colours [H, W, 3], seen by a view, with its exposure."""
        if self.exposures is not None:
            exposure = self.exposures[view_id]  # [3, 4], A | b: a colour c becomes c + A c + b
            colors = colors + (colors @ exposure[:, :3].T + exposure[:, 3])
        return colors.clamp(0.0, 1.0)


def interpolated_exposures(offsets: Tensor, trained: Sequence[str], photos: Sequence[str]) -> Tensor:
    """[W, 3, 4] float32, ``A | b`` of photos: the mean of their neighbours', times how well it tells exposures: the
    slope, within 0 .. 1, of the least squares of exposures of training photos between two others against their
    neighbours' mean. It is nearly 1 where exposures follow the sequence, and 0, which gives the identity, where they
    differ at random, as in a collection of many people's photos.

    Args:
        offsets: [V, 3, 4], of the training photos (`turbogs_plugin.engine.exposures.Exposures`).
        trained: [V] the training photos' names.
        photos: [W] names; a training photo gets its neighbours' exposure, not its own.
    """
    names = [*trained, *photos]
    among = neighbours(names, trained, trained)
    between = (among.weights > 0).all(dim=1).to(offsets.device)  # [V]
    own, told = offsets[between].double(), among.mean(offsets)[between].double()
    length = float(told.square().sum())
    slope = min(1.0, max(0.0, float((own * told).sum()) / length)) if length > 0 else 0.0
    return neighbours(names, trained, photos).mean(offsets) * slope
