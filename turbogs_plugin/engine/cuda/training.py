"""The training kernels, typed: sampling, loss, and projection backward with the optimizer's step on CUDA tensors.

Each function does what its torch twin in `engine.reference` defines: `draws.draw_pixels`, `losses.sparse_loss` with
`ErrorMaps.update`, `raster.ReferenceScreenGradients.parameter_gradients` with `update.apply_update`. It is enqueued on
torch's current stream and not waited for. Tensors must be contiguous; one of another device, dtype or shape raises
`RuntimeError`, naming it and what was expected; more views than the kernels take raise `InputError`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.engine.cuda import launches, library
from turbogs_plugin.engine.cuda.raster import CudaScreenGradients, count_filled, require_views
from turbogs_plugin.engine.layout import STRUCTURES, UNITS, UPDATE_KINDS
from turbogs_plugin.engine.moments import GaussianMoments
from turbogs_plugin.engine.rules import DrawRule, LossTerms, UpdateRule
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.tiles import CELL_SIDE, TILE_CELLS, TILE_PIXELS
from turbogs_plugin.types import TILE_SIZE, Gaussians, GaussianStats, LossOutput, PixelSamples, Step, TileGrid


def sample_pixels(
    errors: Tensor,
    stamps: Tensor,
    now: int,
    starts: np.ndarray,
    sizes: np.ndarray,
    view_ids: Sequence[int],
    rate: float,
    rule: DrawRule,
    seed: int,
    iteration: int,
) -> PixelSamples:
    """Draw the samples of K views; arguments and result are those of `draw_pixels`, whose sets these equal.

    Args:
        errors: [X] float16, stamps: [X] int16, on one CUDA device.
        view_ids: at most `MAX_VIEWS` training views.
    """
    library.require()
    if rule.unit == "tile":
        plan = _plan_of_tiles(sizes, rate, rule)
    else:
        of_tile = rule.wanted(rate, TILE_PIXELS if rule.unit == "pixel" else TILE_CELLS)
        plan = _plan_within_tiles(sizes.tobytes(), of_tile, rule)
    device = errors.device
    scratch = launches.NO_SCRATCH
    if rule.unit == "tile":
        dtypes = (torch.float64, torch.int32, torch.int64, torch.float32)
        scratch = launches.TileScratch(*(torch.empty(plan.tiles, dtype=dtype, device=device) for dtype in dtypes))
    draw = launches.SamplePixels(
        errors=errors,
        stamps=stamps,
        views=view_rows(starts, sizes, view_ids, plan.draws),
        unit=UNITS.index(rule.unit),
        slots_per_tile=plan.slots_per_tile,
        mixed_uniform=rule.mixed_uniform,
        importance=rule.importance,
        seed=seed,
        iteration=iteration,
        now=now,
        pixel_ids=torch.empty(plan.slots, dtype=torch.int32, device=device),
        tile_ids=torch.empty(plan.chosen, dtype=torch.int32, device=device),
        tile_offsets=torch.empty(plan.chosen + 1, dtype=torch.int32, device=device),
        weights=torch.empty(plan.slots, device=device) if rule.importance else None,
        scratch=scratch,
    )
    library.launch(draw)
    weights = draw.weights
    if weights is not None:
        weights = weights * ((draw.pixel_ids >= 0).sum() / weights.sum())
    return PixelSamples(
        tuple(view_ids), sizes, draw.pixel_ids, draw.tile_ids, draw.tile_offsets, weights, rule.unit != "pixel"
    )


@dataclass(frozen=True)
class _DrawPlan:
    """What of a draw follows from the sizes of the K views, the rate and the rule.

    Args:
        tiles: of all views; chosen: of them, those that hold samples; slots: of all these.
        draws: [K] what `layout.DrawRow` has beyond `layout.ViewRow`.
        slots_per_tile: of a tile that is not cut; 0 for unit = tile.
    """

    tiles: int
    chosen: int
    slots: int
    draws: list[tuple[int, ...]]
    slots_per_tile: int


@lru_cache(maxsize=256)
def _plan_within_tiles(sizes_bytes: bytes, wanted: int, rule: DrawRule) -> _DrawPlan:
    """Pixels or cells as units, `wanted` of each tile. `sizes_bytes`: of the [K, 2] int64 array."""
    sizes = np.frombuffer(sizes_bytes, dtype=np.int64).reshape(-1, 2)
    shapes = TileGrid(sizes).shapes
    tiles, slots_per_tile = int(shapes.prod(axis=1).sum()), wanted * (1 if rule.unit == "pixel" else CELL_SIDE**2)
    ends = np.cumsum(_view_slots(sizes, shapes, slots_per_tile, rule.unit)).tolist()
    draws = [(first, 0, *rule.stages(wanted)) for first in [0, *ends[:-1]]]
    return _DrawPlan(tiles, tiles, ends[-1], draws, slots_per_tile)


def _plan_of_tiles(sizes: np.ndarray, rate: float, rule: DrawRule) -> _DrawPlan:
    """Whole tiles as units."""
    tiles = TileGrid(sizes).shapes.prod(axis=1).tolist()  # [K]
    wanted = [rule.wanted(rate, count) for count in tiles]
    ends = np.cumsum(wanted).tolist()
    draws = [(first, count, *rule.stages(count)) for first, count in zip([0, *ends[:-1]], wanted, strict=True)]
    return _DrawPlan(sum(tiles), ends[-1], ends[-1] * TILE_PIXELS, draws, 0)


def _view_slots(sizes: np.ndarray, shapes: np.ndarray, slots_per_tile: int, unit: str) -> np.ndarray:
    """[K] int64: slots of each view; only its last column and last row of tiles are cut."""

    def slots(width: np.ndarray, height: np.ndarray) -> np.ndarray:
        cells = -(-width // CELL_SIDE) * -(-height // CELL_SIDE)
        cap = slots_per_tile if unit == "pixel" else np.minimum(slots_per_tile, cells * CELL_SIDE**2)
        return np.minimum(cap, width * height)

    full = np.full(len(sizes), TILE_SIZE)
    columns, rows = shapes[:, 0] - 1, shapes[:, 1] - 1
    width, height = sizes[:, 0] - columns * TILE_SIZE, sizes[:, 1] - rows * TILE_SIZE
    whole_rows = rows * (columns * slots(full, full) + slots(width, full))
    return whole_rows + columns * slots(full, height) + slots(width, height)


def view_rows(
    starts: np.ndarray, sizes: np.ndarray, view_ids: Sequence[int], draws: Sequence[tuple[int, ...]] | None = None
) -> list[int]:
    """A `layout.ViewRow` of each view, or with `draws` a `layout.DrawRow`, end to end."""
    require_views(len(view_ids))
    columns = zip(starts.tolist(), sizes.tolist(), view_ids, draws or [()] * len(view_ids), strict=True)
    return [number for start, size, view_id, draw in columns for number in (start, *size, view_id, *draw)]


@dataclass
class MapUpdate:
    """The maps to update along with a loss.

    Args:
        maps: of all views, on the device of the colours.
        step: gives the stamp.
        overflow: [1] int32 on the device, or None; where it is not 0, the maps stay as they are.
    """

    maps: ErrorMaps
    step: Step
    overflow: Tensor | None = None


def sparse_loss(
    colors: Tensor,
    targets: Tensor,
    samples: PixelSamples,
    terms: LossTerms,
    *,
    starts: np.ndarray | None = None,
    update: MapUpdate | None = None,
    nonfinite_losses: Tensor | None = None,
) -> LossOutput:
    """Loss, gradient and pixel errors, and with `update` what `ErrorMaps.update` does, in one launch.

    A sample whose colour is not finite counts as an empty slot: its gradient and error are zero, and the maps keep what
    they have.

    Args:
        colors: [P, 3] float32 or float16.
        targets: [P, 3] float32, the truth at the samples; or [X, 3] uint8, the photos of all views, gathered by the
            kernel; then `starts` is needed.
        samples: of at most `MAX_VIEWS` views.
        starts: [K] int64, first flat pixel of each view.
        update: the maps to update; their offsets give `starts`.
        nonfinite_losses: [] int64, 1 is added if the loss is not finite.

    Returns:
        The loss (a float64 scalar on the device), gradients [P, 3] float32 and errors [P] float32.
    """
    library.require()
    colors = colors.detach().float().contiguous()
    device, slots = colors.device, len(samples)
    photos = targets if targets.dtype == torch.uint8 else None
    maps, beta, stamp, overflow = launches.NO_MAPS, 0.0, 0, None
    if update is not None:
        maps, overflow = update.maps, update.overflow
        maps._rebase(update.step.iteration)
        beta, stamp = maps.beta, update.step.iteration - maps.stamp_base
        starts = maps.offsets[list(samples.view_ids)]
    if starts is None:
        if photos is not None:
            raise ValueError("photos are gathered from the first flat pixel of each view: give `starts`")
        starts = np.zeros(len(samples.view_ids), dtype=np.int64)
    loss = launches.SparseLoss(
        colors=colors,
        targets=None if photos is not None else targets.detach().float().contiguous(),
        photos=photos,
        samples=samples,
        views=view_rows(starts, samples.sizes, samples.view_ids),
        structure=STRUCTURES.index(terms.structure),
        terms=terms,
        maps=maps,
        beta=beta,
        stamp=stamp,
        num_filled=count_filled(samples),
        loss=torch.zeros((), dtype=torch.float64, device=device),
        color_gradients=torch.empty_like(colors),
        pixel_errors=torch.empty(slots, device=device),
        nonfinite_losses=nonfinite_losses,
        overflow=overflow,
    )
    library.launch(loss)
    return LossOutput(loss.loss, loss.color_gradients, loss.pixel_errors)


def fused_step(
    screen: CudaScreenGradients,
    gaussians: Gaussians,
    moments: GaussianMoments,
    rule: UpdateRule,
    stats: GaussianStats | None = None,
) -> None:
    """Projection backward and one step of `rule` in one launch: changes `gaussians` and `moments`, adds to `stats`, and
    leaves nothing of use in `screen.records`.

    Args:
        screen: of at most `MAX_VIEWS` views.
        gaussians: the model that `screen` was made of: float32, contiguous.
        moments: its optimizer state, float32.
    """
    library.require()
    if any(value.data_ptr() != getattr(screen.gaussians, name).data_ptr() for name, value in gaussians.items()):
        raise ValueError("fused_step: these are not the Gaussians that the gradients were made of")
    kind, curvature, max_step, rows_per_view = "adam", 0.0, 0.0, False
    if rule.lm is not None:
        kind = f"{rule.lm.units}_lm"
        curvature, max_step, rows_per_view = rule.lm.curvature, rule.lm.max_step, rule.lm.rows == "views"
    library.launch(
        launches.FusedStep(
            screen=screen.backward_arguments(stats),
            moments=moments,
            kind=UPDATE_KINDS.index(kind),
            rows_per_view=rows_per_view,
            rates=rule.rates,
            beta1=rule.beta1,
            beta2=rule.beta2,
            eps=rule.eps,
            curvature=curvature,
            max_step=max_step,
        )
    )
