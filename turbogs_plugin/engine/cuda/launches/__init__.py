"""The arguments of the operators of csrc/: a class for each operator, a field for each argument.

`library.launch` calls an operator with four lists: the tensors, integers, reals and rows of views of the launch. Each
list is in the order of the fields; the fields of a nested class stand in its place. The build writes this order into a
C++ header (csrc/generate_headers.py), so no order is written down twice, and when they run these files import neither
torch nor anything of the package but each other.

Letters in shapes: K views, N Gaussians, T tiles with samples, P sample slots, M the most intersections of tiles and
splats, B harmonics above band 0, X flat pixels, V training views and C cameras. An instance is a Gaussian in a view,
its row k * N + n. All tensors are contiguous and on one CUDA device. Where a tensor may be None, a comment says when.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from .base import LAUNCHES, Launch, fields_of, nested_type

if TYPE_CHECKING:
    from types import SimpleNamespace as Copies
    from types import SimpleNamespace as TileScratch

    from torch import Tensor

    from turbogs_plugin.engine.exposures import Exposures
    from turbogs_plugin.engine.moments import GaussianMoments
    from turbogs_plugin.engine.render_pass import RasterSettings as BlendSettings
    from turbogs_plugin.engine.render_pass import RasterSettings as ProjectionSettings
    from turbogs_plugin.engine.render_pass import Upstream
    from turbogs_plugin.engine.rules import Dropout, LossTerms, ParameterRates
    from turbogs_plugin.error_maps import ErrorMaps
    from turbogs_plugin.masks import PixelMasks
    from turbogs_plugin.scene.depths import InverseDepths
    from turbogs_plugin.types import Gaussians, GaussianStats, LossOutput, PixelSamples
else:  # the fields that launches read of these
    Gaussians = fields_of(Tensor="means quats scales opacities sh0 shN")  # quats and shN 16-byte aligned
    GaussianStats = fields_of(  # [N] float32 each
        Tensor="error_sums distance_sums weight_sums grad_sums absgrad_sums square_sums view_counts max_radii"
    )
    PixelSamples = fields_of(Tensor="pixel_ids tile_ids tile_offsets weights")  # int32; weights float32 or None
    ProjectionSettings = fields_of(float="near_plane far_plane alpha_min")
    BlendSettings = fields_of(float="alpha_min alpha_max transmittance_min")
    Dropout = fields_of(int="threshold seed iteration")
    Upstream = fields_of(Tensor="color_gradients alpha_gradients depth_gradients pixel_errors")
    GaussianMoments = fields_of(Tensor="exp_avg exp_avg_sq exp_avg_shN exp_avg_sq_shN steps skipped")
    TileScratch = fields_of(Tensor="tile_errors tile_ages tile_keys")  # by tile of the batch
    Copies = fields_of(int="copy_0 copy_1 copy_2 copy_3 copy_4 copy_5 copy_6")
    ParameterRates = fields_of(float="means quats scales opacities sh0 shN")
    PixelMasks = fields_of(Tensor="tiles rows bits")  # [L] int32, [L] int32, [B, 8] int32
    LossTerms = fields_of(float="epsilon l1_weight structure_weight variance_constant", bool="balance")
    LossOutput = fields_of(Tensor="loss color_gradients pixel_errors depth_gradients")
    InverseDepths = fields_of(Tensor="cells starts")  # [Y] float32, [V] int64
    ErrorMaps = fields_of(Tensor="errors stamps view_sums")  # [X] float16, [X] int16, [V] float64
    Exposures = fields_of(Tensor="offsets exp_avg exp_avg_sq steps")

__all__ = ["LAUNCHES", "Launch", "nested_type"]

NO_COPIES: Any = SimpleNamespace(**dict.fromkeys(Copies.__annotations__, 0))
NO_STATS: Any = SimpleNamespace(**dict.fromkeys(GaussianStats.__annotations__))
NO_MASKS: Any = SimpleNamespace(**dict.fromkeys(PixelMasks.__annotations__))
NO_SCRATCH: Any = SimpleNamespace(**dict.fromkeys(TileScratch.__annotations__))
NO_MAPS: Any = SimpleNamespace(**dict.fromkeys(ErrorMaps.__annotations__))
NO_DEPTHS: Any = SimpleNamespace(**dict.fromkeys(InverseDepths.__annotations__))
"""Arguments of a launch without copies, statistics, masks, tiles to draw, maps, or known depths."""


@dataclass
class Scene:
    """The Gaussians and the views of a batch."""

    gaussians: Gaussians
    viewmats: Tensor  # [C, 4, 4] float32, the capture's cameras, or the views' alone
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


@dataclass
class ScreenBackward:
    """Gradients on the screen, and what is needed to take them to the parameters."""

    scene: Scene
    records: Tensor  # [K, N, 16] float32, layout.ScreenRecord; anything where off screen
    radii: Tensor  # [K, N, 2] int32
    stats: GaussianStats  # the launch adds to them
    overflow: Tensor | None  # [1] int32; if not 0, the launch does nothing


@dataclass
class RasterProject(Launch):
    """Stage 1: project `scene`. Writes `splats` and `tile_cursors`, and clears the records of splats on screen."""

    scene: Scene
    grid: GridOrigin
    settings: ProjectionSettings
    dropout: Dropout
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
class Intersections:
    """The M intersections of a pass, tile after tile, and memory to sort them in."""

    intersection_keys: Tensor  # [M] int64 scratch
    intersection_ids: Tensor  # [M] int32: the instance of each
    runs: Tensor  # [M / (SORT_RUN / 2), 2] int32 scratch


@dataclass
class RasterSortIntersections(Launch):
    """Stages 3 and 4: the intersections of each tile, sorted by depth."""

    splats: Splats
    tiles: TileLists
    intersections: Intersections


@dataclass
class Background:
    """The colour that shows through, 0 .. 1."""

    background_red: float
    background_green: float
    background_blue: float


@dataclass
class PixelArrays:
    """What the forward pass leaves of each sample, and for the backward pass."""

    colors: Tensor  # [P, 3] float32
    alphas: Tensor  # [P] float32
    transmittances: Tensor  # [P] float32
    last_intersections: Tensor  # [P] int32
    masks: Tensor  # [(M / BUCKET + T + 1) * chunks] int32
    bucket_counts: Tensor  # [T * chunks] int32
    chunks: int  # work items of a tile


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
    pixels: PixelArrays
    depths: Tensor | None  # [P] float32
    settings: BlendSettings
    background: Background


@dataclass
class RasterBackward(Launch):
    """Stage 6: the gradients on the screen, as records, with the sums for density control."""

    forward: RasterForward  # the pass's own launch
    upstream: Upstream  # [P, 3] and [P] float32; depth gradients only of a pass with depths
    records: Tensor  # [K * N, 16] float32, zero on screen
    with_density_sums: bool  # fill the columns that only density control asks for


@dataclass
class ProjectionBackward(Launch):
    """Gradients of the parameters: a row for each view, or their sum. Every entry is written."""

    screen: ScreenBackward
    rows: Tensor  # [K or 1, N, 14] float32, layout.ParameterRow
    shN_gradients: Tensor  # [N, B, 3] float32
    touched: Tensor  # [N] bool


@dataclass
class FusedStep(Launch):
    """Projection backward and one step of the optimizer, in place on Gaussians and moments, and on copies of the
    Gaussians."""

    screen: ScreenBackward
    copies: Copies  # bytes from each parameter to a copy of it, maybe in another GPU's memory; 0: no copy
    moments: GaussianMoments
    kind: int  # of layout.UPDATE_KINDS
    rates: ParameterRates
    beta1: float
    beta2: float
    eps: float


@dataclass
class SamplePixels(Launch):
    """Draw samples: writes the tensors of `samples`."""

    errors: Tensor  # [X] float16
    stamps: Tensor  # [X] int16
    views: list[int]  # [K] layout.DrawRow
    grid: GridOrigin
    unit: int  # of layout.SAMPLE_UNITS
    masks: PixelMasks
    slots_per_tile: int  # slots of a tile that the image's edge does not cut; with masks, of every tile
    mixed_uniform: bool
    importance: float
    seed: int
    iteration: int
    now: int  # a stamp's age is `now` less the stamp
    samples: PixelSamples  # weights are None without importance
    scratch: TileScratch  # float64, int32 and int64; None for unit = pixel


@dataclass
class SparseLoss(Launch):
    """Compute the loss with its gradient and errors, and update the maps."""

    colors: Tensor  # [P, 3] float32
    targets: Tensor | None  # [P, 3] float32
    photos: Tensor | None  # [X, 3 or 4] uint8, from which to gather the colours; instead of `targets`
    samples: PixelSamples
    views: list[int]  # [K] layout.ViewRow
    grid: GridOrigin
    structure: int  # of layout.STRUCTURES
    terms: LossTerms
    maps: ErrorMaps
    beta: float  # EMA weight of a new error
    stamp: int  # for the pixels visited
    num_filled: Tensor | None  # [1] int32; None where all slots are filled
    output: LossOutput  # the loss is [] float64, zero
    nonfinite_losses: Tensor | None  # [] int64, 1 is added if the loss is not finite
    overflow: Tensor | None  # [1] int32; if not 0, the maps stay as they are
    background: Background  # shows through photos with an alpha
    depths: Tensor | None  # [P] float32, rendered; None: no depth term
    known: InverseDepths
    cell: int  # its side, pixels
    depth_factor: float


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
class ExposeColors(Launch):
    """Map the colours by the exposures: writes `exposed`."""

    batch: ExposedViews
    exposed: Tensor  # [P, 3] float32


@dataclass
class ExposureBackward(Launch):
    """Gradients through `ExposeColors`: changes `gradients` in place, adds to `sums`."""

    batch: ExposedViews

    gradients: Tensor  # [P, 3] float32
    sums: Tensor  # [K, 3, 4] float64, zero


@dataclass
class ExposureStep(Launch):
    """One step of Adam for the photos of a batch, in place; then the mean of all offsets is zero."""

    sums: Tensor  # [K, 3, 4] float64
    views: list[int]  # [K] layout.ViewRow
    grid: GridOrigin
    exposures: Exposures
    overflow: Tensor | None  # [1] int32; if not 0, the launch does nothing
    rate: float
    beta1: float
    beta2: float
    eps: float
    pull: float


@dataclass
class CollectRecords(Launch):
    """Copy the records of splats on screen from all processes' views to those of the batch, for a run of rows; and the
    radii. What several processes have of one view is added up. M rows."""

    target_records: Tensor  # [K, M, 16] float32, layout.ScreenRecord; where off screen, left alone
    target_radii: Tensor  # [K, M, 2] int32
    first_views: list[int]  # [sources] of the batch; a process begins with the last view of the one before, or the next
    first_row: int  # of the sources
    sources: list[Tensor]  # records and radii of each process with views, of N Gaussians; maybe in other GPUs' memory


@dataclass
class GatherColors(Launch):
    """Put the colours of all processes together, and look at their flags."""

    colors: Tensor  # [P, 3] float32
    counts: list[int]  # [processes] samples of each
    first: int  # number at which colours begin, in each process's memory
    seen: Tensor  # [2] int32: the largest of two flags
    overflow: Tensor | None  # [1] int32, set like the first of these
    peers: list[Tensor]  # [.] float32 of each process: maybe another GPU's memory; a layout.PassStatus comes first
