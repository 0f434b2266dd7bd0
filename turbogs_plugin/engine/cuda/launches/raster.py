"""Launches of the rasterizer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from .base import Launch, fields_of
from .common import GridOrigin, Scene, Splats, TileLists

if TYPE_CHECKING:
    from torch import Tensor


ProjectionSettings = fields_of("float", "near_plane far_plane alpha_min")
"""Fields of `RasterSettings`."""


DropoutWords = fields_of("int", "threshold seed iteration")
"""Fields of `rules.Dropout`."""


@dataclass
class RasterProject(Launch):
    """Stage 1: project `scene`. Writes `splats` and `tile_cursors`, and clears the records of splats on screen."""

    scene: Scene
    grid: GridOrigin
    settings: ProjectionSettings
    dropout: DropoutWords
    splats: Splats
    tile_ids: Tensor | None  # [T] int32; None where all tiles have samples
    tile_cursors: Tensor  # [T + 1] int32
    records: Tensor | None  # [K * N, 16] float32


@dataclass
class RasterCountIntersections(Launch):
    """Stage 2: where the intersections of each tile begin. Sets the flag `status[1]` if there are too many."""

    tiles: TileLists
    block_sums: Tensor  # [ceil(T / SCAN_TILES), 2] int64 scratch
    capacity: int  # M


@dataclass
class RasterSortIntersections(Launch):
    """Stages 3 and 4: the intersections of each tile, sorted by depth."""

    splats: Splats
    tiles: TileLists
    intersection_keys: Tensor  # [M] int64 scratch
    intersection_ids: Tensor  # [M] int32: the instance of each
    runs: Tensor  # [M / (SORT_RUN / 2), 2] int32 scratch


BlendSettings = fields_of("float", "alpha_min alpha_max transmittance_min")
"""Fields of `RasterSettings`."""


@dataclass
class Background:
    """The colour that shows through, 0 .. 1."""

    background_red: float
    background_green: float
    background_blue: float


@dataclass
class RasterForward(Launch):
    """Stage 5: colours, alphas and, if asked for, depths at the samples."""

    cameras: Tensor  # of `Splats`
    tile_ids: Tensor | None  # [T] int32; None where all tiles have samples
    tile_offsets: Tensor  # [T + 1] int32
    pixel_ids: Tensor  # [P] int32
    tile_starts: Tensor  # [T + 1] int32
    intersection_ids: Tensor  # [M] int32
    instances: Tensor  # of `Splats`
    colors: Tensor  # [P, 3] float32
    alphas: Tensor  # [P] float32
    transmittances: Tensor  # [P] float32
    depths: Tensor | None  # [P] float32
    last_intersections: Tensor  # [P] int32
    masks: Tensor  # [(M / BUCKET + T + 1) * chunks] int32
    bucket_counts: Tensor  # [T * chunks] int32
    chunks: int  # work items of a tile
    settings: BlendSettings
    background: Background


@dataclass
class RasterBackward(Launch):
    """Stage 6: the gradients on the screen, as records, with the sums for density control."""

    forward: RasterForward  # that of the pass
    color_gradients: Tensor  # [P, 3] float32
    alpha_gradients: Tensor | None  # [P] float32
    depth_gradients: Tensor | None  # [P] float32; only of a pass with depths
    pixel_errors: Tensor | None  # [P] float32; None for zeros
    records: Tensor  # [K * N, 16] float32
    with_density_sums: bool  # fill the columns that only density control asks for
    cleared: bool  # the records on screen are zero already
