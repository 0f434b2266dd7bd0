"""The colour behind the model, in training and in evaluations."""

from __future__ import annotations

from dataclasses import dataclass

from turbogs_plugin.config.sections import parse_color
from turbogs_plugin.engine.reference.philox import PURPOSE_BACKGROUND, host_words
from turbogs_plugin.types import BLACK, WHITE, Color, Step


@dataclass(frozen=True)
class Background:
    """What `train.background` means for a capture.

    Args:
        fixed: the colour of every iteration; None: a random one each.
        evaluated: that of evaluations and pictures.
    """

    fixed: Color | None
    evaluated: Color

    @classmethod
    def of(cls, setting: str, transparent: bool) -> Background:
        """That of a setting.

        A random background is one that no colour of the model can stand for, so what is empty or opaque in the photos
        becomes so in the model. It is evaluated as the kind of capture has it: transparent photos on white, as
        published numbers of NeRF-synthetic are, opaque ones on black.

        Args:
            setting: `train.background`; ``auto``, where no plan was made, is ``random`` for transparent photos.
            transparent: whether the photos have an alpha.
        """
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
