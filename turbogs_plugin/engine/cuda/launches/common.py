"""What several launches have in common."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Protocol

from .base import fields_of

if TYPE_CHECKING:
    from torch import Tensor


GaussianArrays = fields_of("Tensor", "means quats scales opacities sh0 shN")
"""`types.Gaussians`, float32; `quats` and `shN` are 16-byte aligned."""


@dataclass
class Scene:
    """The Gaussians and the views of a batch."""

    gaussians: GaussianArrays
    viewmats: Tensor  # [C, 4, 4] float32, of the capture's cameras or of those of the views alone
    Ks: Tensor  # [C, 3, 3] float32
    images: list[int]  # [K] layout.ImageRow
    sh_degree: int  # to evaluate
    eps2d: float


@dataclass
class GridOrigin:
    """`PixelSamples.origin`."""

    origin_x: int
    origin_y: int


@dataclass
class Splats:
    """The results of the projection, for the later stages."""

    cameras: Tensor  # [K, 32] float32, layout.CameraRow
    instances: Tensor  # [K * N, 12] float32, layout.InstanceRow; nothing where off screen
    radii: Tensor  # [K, N, 2] int32, zero where off screen
    active_prefix: Tensor | None  # [tiles + 1] int32, number of tiles with samples of a smaller id; None: all have some


@dataclass
class TileLists:
    """Where the intersections of each tile lie, and how many there are."""

    tile_cursors: Tensor  # [T + 1] int32, before the count: differences of the tiles' counts
    tile_starts: Tensor  # [T + 1] int32
    status: Tensor  # [2] int32, `Workspace.status`
    counters: Tensor  # [2] int32


StatSums = fields_of(
    "Tensor | None", "error_sums distance_sums weight_sums grad_sums absgrad_sums square_sums view_counts max_radii"
)
"""`types.GaussianStats`, or `NO_STATS`: each [N] float32."""


NO_STATS = SimpleNamespace(**dict.fromkeys(StatSums.__annotations__))
"""Where no statistics are wanted."""


@dataclass
class ScreenBackward:
    """Gradients on the screen, and what is needed to take them to the parameters."""

    scene: Scene
    records: Tensor  # [K, N, 16] float32, layout.ScreenRecord; anything where off screen
    radii: Tensor  # [K, N, 2] int32
    stats: StatSums  # the launch adds to them
    num_filled: Tensor | None  # [1] int32; None where all slots are filled
    num_slots: int  # P
    overflow: Tensor | None  # [1] int32; if not 0, the launch does nothing


class SampleArrays(Protocol):
    """`types.PixelSamples`."""

    pixel_ids: Tensor  # [P] int32, -1 empty
    tile_ids: Tensor  # [T] int32
    tile_offsets: Tensor  # [T + 1] int32
    weights: Tensor | None  # [P] float32
