"""Launches of sampling, loss and exposures."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Protocol

from .base import Launch, fields_of
from .common import GridOrigin, SampleArrays
from .raster import Background

if TYPE_CHECKING:
    from torch import Tensor


@dataclass
class TileScratch:
    """Scratch for unit = tile: an entry for each tile of the batch."""

    tile_errors: Tensor | None  # float64
    tile_ages: Tensor | None  # int32
    tile_keys: Tensor | None  # int64
    tile_missed: Tensor | None  # float32


NO_SCRATCH = TileScratch(None, None, None, None)
"""For single pixels."""


MaskArrays = fields_of("Tensor | None", "tiles rows bits")
"""`masks.PixelMasks`, or `NO_MASKS`: [L] int32, [L] int32, [B, 8] int32."""


NO_MASKS = SimpleNamespace(**dict.fromkeys(MaskArrays.__annotations__))
"""Where every pixel counts."""


@dataclass
class SamplePixels(Launch):
    """Draw samples: writes `pixel_ids`, `tile_ids`, `tile_offsets` and `weights`."""

    errors: Tensor  # [X] float16
    stamps: Tensor  # [X] int16
    views: list[int]  # [K] layout.DrawRow
    grid: GridOrigin
    unit: int  # of layout.UNITS
    masks: MaskArrays
    slots_per_tile: int  # slots of a tile that the image's edge does not cut; with masks, of every tile
    mixed_uniform: bool
    importance: float
    seed: int
    iteration: int
    now: int  # a stamp's age is `now` less the stamp
    pixel_ids: Tensor  # [P] int32
    tile_ids: Tensor  # [T] int32
    tile_offsets: Tensor  # [T + 1] int32
    weights: Tensor | None  # [P] float32; None without importance
    scratch: TileScratch


@dataclass
class CountFilled(Launch):
    """Add the number of filled slots to `num_filled`."""

    pixel_ids: Tensor  # [P] int32
    num_filled: Tensor  # [1] int32


class LossSettings(Protocol):
    """Fields of `LossTerms`."""

    epsilon: float
    l1_weight: float
    structure_weight: float
    variance_constant: float
    balance: bool


MapArrays = fields_of("Tensor | None", "errors stamps view_sums")
"""`ErrorMaps`, or `NO_MAPS`: [X] float16, [X] int16, [V] float64."""


NO_MAPS = SimpleNamespace(**dict.fromkeys(MapArrays.__annotations__))
"""Where no maps are to be updated."""


@dataclass
class SparseLoss(Launch):
    """Compute the loss with its gradient and errors, and update the maps."""

    colors: Tensor  # [P, 3] float32
    targets: Tensor | None  # [P, 3] float32
    photos: Tensor | None  # [X, 3 or 4] uint8, from which to gather the colours; instead of `targets`
    samples: SampleArrays
    views: list[int]  # [K] layout.ViewRow
    grid: GridOrigin
    structure: int  # of layout.STRUCTURES
    terms: LossSettings
    maps: MapArrays
    beta: float  # EMA weight of a new error
    stamp: int  # for the pixels visited
    num_filled: Tensor | None  # [1] int32; None where all slots are filled
    loss: Tensor  # [] float64, zero
    color_gradients: Tensor  # [P, 3] float32
    pixel_errors: Tensor  # [P] float32
    nonfinite_losses: Tensor | None  # [] int64, 1 is added if the loss is not finite
    overflow: Tensor | None  # [1] int32; if not 0, the maps stay as they are
    background: Background  # shows through photos with an alpha


@dataclass
class ExposedViews:
    """Rendered colours, and the exposures of their photos."""

    colors: Tensor  # [P, 3] float32
    tile_ids: Tensor  # [T] int32
    tile_offsets: Tensor  # [T + 1] int32
    views: list[int]  # [K] layout.ViewRow
    grid: GridOrigin
    offsets: Tensor  # [V, 3, 4] float32


@dataclass
class ExposeColors(ExposedViews, Launch):
    """Map the colours by the exposures: writes `exposed`."""

    exposed: Tensor  # [P, 3] float32


@dataclass
class ExposureBackward(ExposedViews, Launch):
    """Gradients through `ExposeColors`: changes `gradients` in place, adds to `sums`."""

    gradients: Tensor  # [P, 3] float32
    sums: Tensor  # [K, 3, 4] float64, zero


ExposureArrays = fields_of("Tensor", "offsets exp_avg exp_avg_sq steps")
"""`engine.exposures.Exposures`: [V, 3, 4] float32 each, but for `steps`, [V] int32."""


@dataclass
class ExposureStep(Launch):
    """One step of Adam for the photos of a batch, in place; then the mean of all offsets is zero."""

    sums: Tensor  # [K, 3, 4] float64
    views: list[int]  # [K] layout.ViewRow
    grid: GridOrigin
    exposures: ExposureArrays
    overflow: Tensor | None  # [1] int32; if not 0, the launch does nothing
    rate: float
    beta1: float
    beta2: float
    eps: float
    pull: float
