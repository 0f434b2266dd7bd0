"""What each operator of csrc/ takes: one class an operator, one field an argument. `library.launch` calls it.

The fields of a launch travel as four lists: its tensors, integers, reals and the rows of its views, each in the order
of the fields, with those of a nested class in its place. The build makes the same order known to C++
(csrc/generate_headers.py), so this file must not import torch, and no order is written down a second time.

Index spaces: K views, N Gaussians, T tiles with samples, P sample slots, M the most intersections of tiles and splats,
B harmonics above band 0, X flat pixels and V training views. An instance is a Gaussian in a view, row k * N + n. All
tensors are contiguous and on one CUDA device. A tensor that may be None is left out where the comment says.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType, SimpleNamespace
from typing import TYPE_CHECKING, ClassVar, Protocol

if TYPE_CHECKING:
    from torch import Tensor

LAUNCHES: list[type[Launch]] = []
"""All launches, in the order of this file."""


class Launch(Protocol):
    """What `launch` gives a class.

    Attributes:
        operator: name of the operator.
        paths: dotted paths of the fields that each of the four lists holds, in their order.
    """

    operator: ClassVar[str]
    paths: ClassVar[tuple[list[str], ...]]

    def lists(self) -> tuple[tuple, ...]:
        """The four lists."""
        ...


def launch(cls: type) -> type[Launch]:
    """Make a launch of a dataclass."""
    cls.operator = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", cls.__name__).lower()
    cls.paths = _paths(cls)
    cls.lists = _reader(*cls.paths)
    LAUNCHES.append(cls)
    return cls


def _paths(cls: type, prefix: str = "") -> tuple[list[str], list[str], list[str], list[str]]:
    """Dotted paths of the tensors, integers, reals and rows of a class, in the order of its fields."""
    tensors, integers, reals, rows = paths = [], [], [], []
    kinds = {"Tensor": tensors, "Tensor | None": tensors, "int": integers, "bool": integers, "float": reals}
    kinds["list[int]"] = rows
    for name, annotation in cls.__annotations__.items():
        if annotation in kinds:
            kinds[annotation].append(prefix + name)
        else:
            for mine, nested in zip(paths, _paths(globals()[annotation], f"{prefix}{name}."), strict=True):
                mine.extend(nested)
    return paths


def _reader(tensors: list[str], integers: list[str], reals: list[str], rows: list[str]) -> Callable[[Launch], tuple]:
    """A function that reads the lists from a launch; written out and compiled, as it runs for every launch."""
    lists = ["(" + "".join(f"launch.{path}, " for path in paths) + ")" for paths in (tensors, integers, reals)]
    return eval(f"lambda launch: ({', '.join(lists)}, {f'launch.{rows[0]}' if rows else '()'})")


def interface(layout: ModuleType) -> str:
    """The orders of all fields and the numbers of `layout`, as text. A library built of other sources tells another."""
    lines = []
    for cls in LAUNCHES:
        lines.append(f"{cls.operator}: " + "; ".join(" ".join(names) for names in cls.paths))
    for name, value in vars(layout).items():
        if isinstance(value, type):
            places = (f"{column} {place.start}:{place.stop}" for column, place in layout.columns(value).items())
            value = f"{', '.join(places)} of {value.SIZE}"
        if name[0].isupper():
            lines.append(f"{name}: {value}")
    return "\n".join(lines)


# ---- What several launches have in common ---------------------------------------------------------------------------


class GaussianArrays(Protocol):
    """`types.Gaussians`."""

    means: Tensor  # [N, 3] float32
    quats: Tensor  # [N, 4] float32, 16-byte aligned
    scales: Tensor  # [N, 3] float32
    opacities: Tensor  # [N] float32
    sh0: Tensor  # [N, 1, 3] float32
    shN: Tensor  # [N, B, 3] float32, 16-byte aligned


@dataclass(slots=True)
class Scene:
    """The Gaussians and the views of a batch."""

    gaussians: GaussianArrays
    viewmats: Tensor  # [K, 4, 4] float32
    Ks: Tensor  # [K, 3, 3] float32
    sizes: list[int]  # [K] layout.ImageRow
    sh_degree: int  # to evaluate
    eps2d: float


@dataclass(slots=True)
class Splats:
    """What the projection leaves for the stages behind it."""

    cameras: Tensor  # [K, 28] float32, layout.CameraRow
    instances: Tensor  # [K * N, 12] float32, layout.InstanceRow; nothing where off screen
    radii: Tensor  # [K, N, 2] int32, zero where off screen
    active_prefix: Tensor | None  # [tiles + 1] int32, tiles with samples of a smaller id; None where all have some


@dataclass(slots=True)
class TileLists:
    """Where the intersections of each tile lie, and how many there are."""

    tile_cursors: Tensor  # [T + 1] int32, before the count: differences of the tiles' counts
    tile_starts: Tensor  # [T + 1] int32
    status: Tensor  # [2] int32, `Workspace.status`
    counters: Tensor  # [2] int32


class StatSums(Protocol):
    """`types.GaussianStats`, or `NO_STATS`."""

    error_sums: Tensor | None  # [N] float32, as are the others
    distance_sums: Tensor | None
    weight_sums: Tensor | None
    grad_sums: Tensor | None
    absgrad_sums: Tensor | None
    view_counts: Tensor | None
    max_radii: Tensor | None


NO_STATS = SimpleNamespace(**dict.fromkeys(StatSums.__annotations__))
"""In place of statistics that are not wanted."""


@dataclass(slots=True)
class ScreenBackward:
    """Gradients on the screen, and what takes them to the parameters."""

    scene: Scene
    records: Tensor  # [K, N, 16] float32, layout.ScreenRecord; anything where off screen
    radii: Tensor  # [K, N, 2] int32
    stats: StatSums  # added to
    num_filled: Tensor | None  # [1] int32; None where all slots are filled
    num_slots: int  # P
    overflow: Tensor | None  # [1] int32; where not 0 the launch does nothing


class SampleArrays(Protocol):
    """`types.PixelSamples`."""

    pixel_ids: Tensor  # [P] int32, -1 empty
    tile_ids: Tensor  # [T] int32
    tile_offsets: Tensor  # [T + 1] int32
    weights: Tensor | None  # [P] float32


# ---- The rasterizer -------------------------------------------------------------------------------------------------


class ProjectionSettings(Protocol):
    """Of `RasterSettings`."""

    near_plane: float
    far_plane: float
    alpha_min: float


@launch
@dataclass(slots=True)
class RasterProject:
    """Stage 1: `scene` onto the screen. Writes `splats` and `tile_cursors`, and clears records on screen."""

    scene: Scene
    settings: ProjectionSettings
    splats: Splats
    tile_ids: Tensor | None  # [T] int32; None where all tiles have samples
    tile_cursors: Tensor  # [T + 1] int32
    records: Tensor | None  # [K * N, 16] float32


@launch
@dataclass(slots=True)
class RasterCountIntersections:
    """Stage 2: where the intersections of each tile begin. Raises `status[1]` where there are too many."""

    tiles: TileLists
    block_sums: Tensor  # [ceil(T / SCAN_TILES), 2] int64 scratch
    capacity: int  # M


@launch
@dataclass(slots=True)
class RasterSortIntersections:
    """Stages 3 and 4: the intersections of each tile, in order of depth."""

    splats: Splats
    tiles: TileLists
    intersection_keys: Tensor  # [M] int64 scratch
    intersection_ids: Tensor  # [M] int32: the instance of each
    runs: Tensor  # [M / (SORT_RUN / 2), 2] int32 scratch


class BlendSettings(Protocol):
    """Of `RasterSettings`."""

    alpha_min: float
    alpha_max: float
    transmittance_min: float


@launch
@dataclass(slots=True)
class RasterForward:
    """Stage 5: colours, alphas and, where asked for, depths at the samples."""

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


@launch
@dataclass(slots=True)
class RasterBackward:
    """Stage 6: records of the gradients on the screen."""

    forward: RasterForward  # of the pass
    color_gradients: Tensor  # [P, 3] float32
    alpha_gradients: Tensor | None  # [P] float32
    depth_gradients: Tensor | None  # [P] float32; only of a pass with depths
    pixel_errors: Tensor | None  # [P] float32; None for zeros
    records: Tensor  # [K * N, 16] float32
    with_density_sums: bool  # fill the columns that only density control asks for
    cleared: bool  # the records on screen are zero already


# ---- Sampling and loss ----------------------------------------------------------------------------------------------


@dataclass(slots=True)
class TileScratch:
    """For unit = tile: an entry for each tile of the batch."""

    tile_errors: Tensor | None  # float64
    tile_ages: Tensor | None  # int32
    tile_keys: Tensor | None  # int64
    tile_missed: Tensor | None  # float32


NO_SCRATCH = TileScratch(None, None, None, None)
"""For the other units."""


@launch
@dataclass(slots=True)
class SamplePixels:
    """Draws samples: writes `pixel_ids`, `tile_ids`, `tile_offsets` and `weights`."""

    errors: Tensor  # [X] float16
    stamps: Tensor  # [X] int16
    views: list[int]  # [K] layout.DrawRow
    unit: int  # of layout.UNITS
    slots_per_tile: int  # of a tile that is not cut; 0 for unit = tile
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


@launch
@dataclass(slots=True)
class CountFilled:
    """Adds the number of filled slots."""

    pixel_ids: Tensor  # [P] int32
    num_filled: Tensor  # [1] int32


class LossSettings(Protocol):
    """Of the terms of a loss."""

    epsilon: float
    l1_weight: float
    structure_weight: float
    variance_constant: float
    balance: bool
    gate: bool


class MapArrays(Protocol):
    """`ErrorMaps`, or `NO_MAPS`."""

    errors: Tensor | None  # [X] float16
    stamps: Tensor | None  # [X] int16
    view_sums: Tensor | None  # [V] float64


NO_MAPS = SimpleNamespace(**dict.fromkeys(MapArrays.__annotations__))
"""In place of maps that are not to be updated."""


@launch
@dataclass(slots=True)
class SparseLoss:
    """Loss with its gradient and errors; updates the maps."""

    colors: Tensor  # [P, 3] float32
    targets: Tensor | None  # [P, 3] float32
    photos: Tensor | None  # [X, 3] uint8: in place of `targets`, to gather them from
    samples: SampleArrays
    views: list[int]  # [K] layout.ViewRow
    structure: int  # of layout.STRUCTURES
    terms: LossSettings
    maps: MapArrays
    beta: float  # of the maps' average
    stamp: int  # for the pixels visited
    num_filled: Tensor | None  # [1] int32; None where all slots are filled
    loss: Tensor  # [] float64, zero
    color_gradients: Tensor  # [P, 3] float32
    pixel_errors: Tensor  # [P] float32
    nonfinite_losses: Tensor | None  # [] int64, added to
    overflow: Tensor | None  # [1] int32; where not 0 the maps stay as they are


# ---- From the screen to the parameters ------------------------------------------------------------------------------


@launch
@dataclass(slots=True)
class ProjectionBackward:
    """Gradients of the parameters: rows of each view or their sum. Every entry is written."""

    screen: ScreenBackward
    rows: Tensor  # [K or 1, N, 14] float32, layout.ParameterRow
    shN_gradients: Tensor  # [N, B, 3] float32
    touched: Tensor  # [N] bool
    view_losses: Tensor  # [K or 1, N] float32


class Moments(Protocol):
    """`GaussianMoments`."""

    exp_avg: Tensor  # [N, 14] float32, layout.ParameterRow
    exp_avg_sq: Tensor  # [N, 14] float32
    exp_avg_shN: Tensor  # [N, 3 * B] float32
    exp_avg_sq_shN: Tensor  # [N, 3 * B] float32
    steps: Tensor  # [N] int32
    skipped: Tensor  # [] int64


class Rates(Protocol):
    """`ParameterRates`."""

    means: float
    quats: float
    scales: float
    opacities: float
    sh0: float
    shN: float


@launch
@dataclass(slots=True)
class FusedStep:
    """Projection backward and one step of the optimizer. Changes the Gaussians and the moments in place."""

    screen: ScreenBackward
    moments: Moments
    kind: int  # of layout.UPDATE_KINDS
    rows_per_view: bool
    rates: Rates
    beta1: float
    beta2: float
    eps: float
    curvature: float
    max_step: float
