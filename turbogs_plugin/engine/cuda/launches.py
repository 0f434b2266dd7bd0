"""The arguments of the operators of csrc/: a class for each operator, a field for each argument.

`library.launch` calls an operator with four lists: the tensors, integers, reals and rows of views of the launch. Each
list is in the order of the fields; those of a nested class stand in its place. The build writes the same order into a
C++ header (csrc/generate_headers.py). So this file must not import torch, and no order is written down twice.

Letters in shapes: K views, N Gaussians, T tiles with samples, P sample slots, M the most intersections of tiles and
splats, B harmonics above band 0, X flat pixels, V training views and C cameras. An instance is a Gaussian in a view,
its row k * N + n. All tensors are contiguous and on one CUDA device. Where a tensor may be None, a comment says when.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, ClassVar, Protocol

if TYPE_CHECKING:
    from torch import Tensor

LAUNCHES: list[type[Launch]] = []
"""All launches, in the order of this file."""


class Launch:
    """A call of an operator.

    Attributes:
        operator: its name, that of the class in snake case.
        paths: dotted paths of the fields in each of the four lists, in order.
    """

    operator: ClassVar[str]
    paths: ClassVar[tuple[list[str], ...]]

    def __init_subclass__(cls) -> None:
        cls.operator = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", cls.__name__).lower()
        cls.paths = _paths(cls)
        cls.lists = _reader(*cls.paths)
        LAUNCHES.append(cls)

    def lists(self) -> tuple[tuple, ...]:
        """The four lists."""


def fields_of(kind: str, names: str) -> type:
    """A type for an object of another module, of which a launch reads these fields, all of one kind."""
    return type("Fields", (), {"__annotations__": dict.fromkeys(names.split(), kind)})


def annotations(cls: type) -> dict[str, str]:
    """Name -> type of the fields of a class, those of its bases first."""
    own = (vars(base).get("__annotations__", {}) for base in reversed(cls.__mro__) if base is not Launch)
    return dict(field for fields in own for field in fields.items())


def _paths(cls: type, prefix: str = "") -> tuple[list[str], list[str], list[str], list[str]]:
    """Dotted paths of the tensors, integers, reals and rows of a class, in the order of its fields."""
    paths = [], [], [], []
    kinds = {"Tensor": 0, "Tensor | None": 0, "int": 1, "bool": 1, "float": 2, "list[int]": 3}
    for name, annotation in annotations(cls).items():
        if annotation in kinds:
            paths[kinds[annotation]].append(prefix + name)
        else:
            for mine, nested in zip(paths, _paths(globals()[annotation], f"{prefix}{name}."), strict=True):
                mine.extend(nested)
    return paths


def _reader(tensors: list[str], integers: list[str], reals: list[str], rows: list[str]) -> Callable[[Launch], tuple]:
    """A function that reads the lists from a launch. It is generated as code, because it runs for every launch."""
    lists = ["(" + "".join(f"launch.{path}, " for path in paths) + ")" for paths in (tensors, integers, reals)]
    return eval(f"lambda launch: ({', '.join(lists)}, {f'launch.{rows[0]}' if rows else '()'})")


# ---- What several launches have in common ---------------------------------------------------------------------------


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


# ---- The rasterizer -------------------------------------------------------------------------------------------------


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


@dataclass
class Sources:
    """What each process with views has rendered, in their order: N Gaussians in V views, as `Splats` and records."""

    records_0: Tensor
    radii_0: Tensor
    records_1: Tensor | None
    radii_1: Tensor | None
    records_2: Tensor | None
    radii_2: Tensor | None
    records_3: Tensor | None
    radii_3: Tensor | None
    records_4: Tensor | None
    radii_4: Tensor | None
    records_5: Tensor | None
    radii_5: Tensor | None
    records_6: Tensor | None
    radii_6: Tensor | None
    records_7: Tensor | None
    radii_7: Tensor | None


@dataclass
class CollectRecords(Launch):
    """Copy the records of splats on screen from all processes' views to those of the batch, for a run of rows; and the
    radii. What several processes have of one view is added up.

    A source may be another GPU's memory, mapped here. M rows.
    """

    target_records: Tensor  # [K, M, 16] float32, layout.ScreenRecord; where off screen, left alone
    target_radii: Tensor  # [K, M, 2] int32
    sources: Sources
    first_views: list[int]  # [sources] of the batch; a process begins with the last view of the one before, or the next
    first_row: int  # of the sources


@dataclass
class Peers:
    """Memory of each process, rank after rank, [.] float32: this GPU's, and other GPUs' mapped here."""

    peer_0: Tensor
    peer_1: Tensor | None
    peer_2: Tensor | None
    peer_3: Tensor | None
    peer_4: Tensor | None
    peer_5: Tensor | None
    peer_6: Tensor | None
    peer_7: Tensor | None


@dataclass
class GatherColors(Launch):
    """Put the colours of all processes together, and look at their flags."""

    peers: Peers  # each begins with a layout.PassStatus, int32
    counts: list[int]  # [processes] samples of each
    first: int  # number at which colours begin, in each
    colors: Tensor  # [P, 3] float32
    seen: Tensor  # [2] int32: the largest of two flags
    overflow: Tensor | None  # [1] int32, set like the first of these


# ---- Sampling and loss ----------------------------------------------------------------------------------------------


@dataclass
class TileScratch:
    """Scratch for unit = tile: an entry for each tile of the batch."""

    tile_errors: Tensor | None  # float64
    tile_ages: Tensor | None  # int32
    tile_keys: Tensor | None  # int64
    tile_missed: Tensor | None  # float32


NO_SCRATCH = TileScratch(None, None, None, None)
"""For the other units."""


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


# ---- Exposures ------------------------------------------------------------------------------------------------------


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


# ---- From the screen to the parameters ------------------------------------------------------------------------------


@dataclass
class ProjectionBackward(Launch):
    """Gradients of the parameters: a row for each view, or their sum. Every entry is written."""

    screen: ScreenBackward
    rows: Tensor  # [K or 1, N, 14] float32, layout.ParameterRow
    shN_gradients: Tensor  # [N, B, 3] float32
    touched: Tensor  # [N] bool
    view_losses: Tensor  # [K or 1, N] float32


Moments = fields_of("Tensor", "exp_avg exp_avg_sq exp_avg_shN exp_avg_sq_shN steps skipped")
"""`GaussianMoments`, float32 but for `steps`, int32, and `skipped`, int64."""


Rates = fields_of("float", "means quats scales opacities sh0 shN")
"""`ParameterRates`."""


@dataclass
class Copies:
    """How many bytes behind each parameter a copy of it lies, maybe in another GPU's memory; 0: no copy."""

    copy_0: int
    copy_1: int
    copy_2: int
    copy_3: int
    copy_4: int
    copy_5: int
    copy_6: int


NO_COPIES = Copies(*(0,) * 7)


@dataclass
class FusedStep(Launch):
    """Projection backward and one step of the optimizer, in place on Gaussians and moments, and on copies of the
    Gaussians."""

    screen: ScreenBackward
    copies: Copies
    moments: Moments
    kind: int  # of layout.UPDATE_KINDS
    rows_per_view: bool
    rates: Rates
    beta1: float
    beta2: float
    eps: float
    curvature: float
    max_step: float
