"""Samplers of the pixels that are rendered (paper section 3.5), as rules that every engine can draw."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from torch import Tensor

from turbogs_plugin.engine import engine_of
from turbogs_plugin.engine.rules import DrawRule
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.errors import require
from turbogs_plugin.strategies.checks import require_each, require_settings
from turbogs_plugin.strategies.protocols import PixelSampler
from turbogs_plugin.tiles import TILE_PIXELS, dense_pixels
from turbogs_plugin.types import PixelSamples, Step

ViewIds = Sequence[int] | int | np.ndarray | Tensor
"""Views as a sampler takes them; see `view_numbers`."""


def view_numbers(view_ids: ViewIds, maps: ErrorMaps) -> tuple[int, ...]:
    """The views of a batch as plain numbers on the host.

    Args:
        view_ids: K training views; a single one may be given as its number. For a tensor on another device the host
            waits once, so give host numbers where there are some.

    Raises:
        InputError: no view, not whole numbers, a view that the maps do not have, or one view twice.
    """
    plain = view_ids.tolist() if isinstance(view_ids, (Tensor, np.ndarray)) else view_ids
    views, known = tuple(plain) if isinstance(plain, Iterable) else (plain,), range(len(maps.sizes))
    # The pixels of a view that comes twice would be updated twice, and the sum of its errors be wrong.
    valid = all(view in known for view in views) and 0 < len(set(views)) == len(views)
    require(valid, "view_ids", plain, f"different whole numbers of views from 0 to {len(known) - 1}")
    return tuple(map(int, views))


@dataclass
class RandomPixelSampler(PixelSampler):
    """Uniformly random pixels of each tile (or tiles of each view), without replacement, by the `rule` alone: the
    engine of the maps' device draws.

    Args:
        unit: `pixel`, as in the paper, or `tile`: whole tiles of a view, which begin elsewhere in each iteration
            (`DrawRule.origin`).
        multiple: samples of a tile are rounded to a multiple of this, where `unit` is `pixel`. The rasterizer takes 32
            samples at once, and 33 in the time of 64. 1: the paper's number, rounded down.
    """

    unit: Literal["pixel", "tile"] = "pixel"
    multiple: int = 1
    heeds_masks = True

    def __post_init__(self) -> None:
        require_settings(self)
        divides = self.multiple >= 1 and TILE_PIXELS % self.multiple == 0
        require(divides, "multiple", self.multiple, f"a divisor of {TILE_PIXELS}, the pixels of a tile")

    @property
    def rule(self) -> DrawRule:
        """One stage, which ignores the maps."""
        return DrawRule(self.unit, 0.0, 0.0, mixed_uniform=True, importance=0.0, multiple=self.multiple)

    def sample(self, maps: ErrorMaps, view_ids: ViewIds, rate: float, step: Step) -> PixelSamples:
        """Draw the share `rate` (r) of the pixels of each tile or, with `unit: tile`, of the tiles of each view.

        Args:
            view_ids: see `view_numbers`.
        """
        require(0 < rate <= 1, "rate", rate, "above 0 and at most 1, a share of the pixels")
        require(isinstance(step, Step), "step", step, "a Step, as Step(iteration=0, total=1000, refine_until=500) is")
        return engine_of(maps.errors.device).draw(self.rule, maps, view_numbers(view_ids, maps), rate, step)


@dataclass
class ErrorGuidedPixelSampler(RandomPixelSampler):
    """The paper's sampler: hard units by error, stable ones by age, the rest by both (`engine.reference.draws`).

    Args:
        hard_ratio: r_hard, share of the units of each tile drawn by error; 0.4 in the paper.
        stable_ratio: r_stable, share of the units of each tile drawn by age; 0.3 in the paper.
        mixed: draw of the remaining share, which the paper names but does not define: by `error_age`, the mean of the
            two normalised distributions, or `uniform`.
        importance: exponent a of the importance weights p^-a, p the probability that a pixel is drawn: 0 none, as in
            the paper's runs; 1 unbiased (exactly so for a draw of a single stage). Whole tiles have none.
    """

    hard_ratio: float = 0.4
    stable_ratio: float = 0.3
    mixed: Literal["error_age", "uniform"] = "error_age"
    importance: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_each(self, lambda value: 0 <= value <= 1, "between 0 and 1", "hard_ratio", "importance")
        allowed = f"between 0 and 1 - hard_ratio ({1 - self.hard_ratio:g})"
        require(0 <= self.stable_ratio <= 1 - self.hard_ratio + 1e-9, "stable_ratio", self.stable_ratio, allowed)
        require(not self.importance or self.unit == "pixel", "importance", self.importance, "0 where unit is tile")

    @property
    def rule(self) -> DrawRule:
        """Three stages: by error, by age, and the rest."""
        stages = (self.hard_ratio, self.stable_ratio, self.mixed == "uniform")
        return DrawRule(self.unit, *stages, self.importance, self.multiple)


@dataclass
class DensePixelSampler(PixelSampler):
    """Every pixel of the chosen views that is not masked, whatever the rate."""

    heeds_masks = True

    def sample(self, maps: ErrorMaps, view_ids: ViewIds, rate: float, step: Step) -> PixelSamples:
        view_ids = view_numbers(view_ids, maps)
        if maps.masks is not None:
            return maps.masks.pixels(view_ids)
        return dense_pixels(view_ids, maps.sizes[np.asarray(view_ids, dtype=np.int64)], maps.errors.device)
