"""The training kernels, typed: sampling, loss, projection backward and the optimizer's step on CUDA tensors.

Each function does what its torch twin defines (`draw_pixels`, the losses of `strategies.loss` with `ErrorMaps.update`,
`ReferenceScreenGradients.parameter_gradients`, the steps of `strategies.adam` and `strategies.moment_lm`). It is
enqueued on torch's current stream and not waited for. Tensors must be contiguous; one of another device, dtype or shape
raises `RuntimeError`, naming it and what was expected; more views than `MAX_VIEWS` raise `InputError`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.engine.cuda import library as kernels
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.errors import InputError
from turbogs_plugin.tiles import CELL_SIDE, TILE_CELLS, TILE_PIXELS
from turbogs_plugin.types import (
    PARAMETER_NAMES,
    TILE_SIZE,
    GaussianGradients,
    Gaussians,
    LossOutput,
    PixelSamples,
    Step,
    TileGrid,
)

if TYPE_CHECKING:
    from turbogs_plugin.engine.cuda.raster import CudaScreenGradients
    from turbogs_plugin.engine.reference.draws import DrawRule
    from turbogs_plugin.engine.update_rule import GaussianMoments, UpdateRule

MAX_VIEWS = 128
"""Views of one batch that the kernels take, as many as the rasterizer."""

ROW_WIDTH = 14
"""Gradients of a view's row: means 3, scales 3, quats 4, sh0 3, opacities 1."""

UNITS = ("pixel", "cell", "tile")
STRUCTURES = ("none", "ncc", "contrast", "ssim")


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
    kernels.require()
    if rule.unit == "tile":
        plan = _plan_of_tiles(sizes, rate, rule)
    else:
        of_tile = rule.wanted(rate, TILE_PIXELS if rule.unit == "pixel" else TILE_CELLS)
        plan = _plan_within_tiles(sizes.tobytes(), of_tile, rule)
    device = errors.device
    pixel_ids = torch.empty(plan.slots, dtype=torch.int32, device=device)
    tile_ids = torch.empty(plan.chosen, dtype=torch.int32, device=device)
    tile_offsets = torch.empty(plan.chosen + 1, dtype=torch.int32, device=device)
    weights = torch.empty(plan.slots, device=device) if rule.importance else None
    scratch = []
    if rule.unit == "tile":
        dtypes = (torch.float64, torch.int32, torch.int64, torch.float32)
        scratch = [torch.empty(plan.tiles, dtype=dtype, device=device) for dtype in dtypes]
    torch.ops.turbogs.sample_pixels(
        errors, stamps, _view_table(starts, sizes, view_ids, plan.bases, plan.wanted), UNITS.index(rule.unit),
        plan.stages, plan.slots_per_tile, rule.mixed_uniform, rule.importance, seed, iteration, now,
        pixel_ids, tile_ids, tile_offsets, weights, scratch,
    )  # fmt: skip
    if weights is not None:
        weights = weights * ((pixel_ids >= 0).sum() / weights.sum())
    return PixelSamples(tuple(view_ids), sizes, pixel_ids, tile_ids, tile_offsets, weights, rule.unit != "pixel")


@dataclass(frozen=True)
class _DrawPlan:
    """What of a draw follows from the sizes of the K views, the rate and the rule.

    Args:
        tiles: of all views; chosen: of them, those that hold samples; slots: of all these.
        bases: [K] the first slot of each view, or for unit = tile its first chosen tile.
        wanted: [K] for unit = tile the tiles to choose, else 0.
        stages: units of the three stages; for unit = tile of each view, end to end.
        slots_per_tile: of a tile that is not cut; 0 for unit = tile.
    """

    tiles: int
    chosen: int
    slots: int
    bases: list[int]
    wanted: list[int]
    stages: list[int]
    slots_per_tile: int


@lru_cache(maxsize=256)
def _plan_within_tiles(sizes_bytes: bytes, wanted: int, rule: DrawRule) -> _DrawPlan:
    """Pixels or cells as units, `wanted` of each tile. `sizes_bytes`: of the [K, 2] int64 array."""
    sizes = np.frombuffer(sizes_bytes, dtype=np.int64).reshape(-1, 2)
    shapes = TileGrid(sizes).shapes
    tiles, slots_per_tile = int(shapes.prod(axis=1).sum()), wanted * (1 if rule.unit == "pixel" else CELL_SIDE**2)
    ends = np.cumsum(_view_slots(sizes, shapes, slots_per_tile, rule.unit)).tolist()
    bases, unused = [0, *ends[:-1]], [0] * len(sizes)
    return _DrawPlan(tiles, tiles, ends[-1], bases, unused, list(rule.stages(wanted)), slots_per_tile)


def _plan_of_tiles(sizes: np.ndarray, rate: float, rule: DrawRule) -> _DrawPlan:
    """Whole tiles as units."""
    tiles = TileGrid(sizes).shapes.prod(axis=1).tolist()  # [K]
    wanted = [rule.wanted(rate, count) for count in tiles]
    stages = [number for count in wanted for number in rule.stages(count)]
    ends = np.cumsum(wanted).tolist()
    return _DrawPlan(sum(tiles), ends[-1], ends[-1] * TILE_PIXELS, [0, *ends[:-1]], wanted, stages, 0)


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


def _view_table(
    starts: np.ndarray, sizes: np.ndarray, view_ids: Sequence[int], bases: Sequence[int], wanted: Sequence[int]
) -> list[int]:
    """Six numbers for each view, as csrc/training_bindings.cpp reads them."""
    _check_views(len(view_ids))
    columns = zip(starts.tolist(), sizes.tolist(), view_ids, bases, wanted, strict=True)
    return [number for start, size, *others in columns for number in (start, *size, *others)]


@dataclass(frozen=True)
class LossTerms:
    """A loss of `strategies.loss` as the kernel takes it.

    Args:
        epsilon: of the Charbonnier term.
        l1_weight: factor of that term.
        structure: one of `STRUCTURES`.
        structure_weight: factor of the mean over tiles and channels of 1 - S.
        variance_constant: of `ncc` and `contrast`.
        balance: scale the structure term by the paper's lambda.
        gate: scale it by the truth's variance.
    """

    epsilon: float
    l1_weight: float = 1.0
    structure: str = "none"
    structure_weight: float = 0.0
    variance_constant: float = 9e-4
    balance: bool = False
    gate: bool = False


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
    nonfinite: Tensor | None = None,
    nonfinite_losses: Tensor | None = None,
) -> LossOutput:
    """Loss, gradient and pixel errors, and with `update` what `ErrorMaps.update` does, in one launch.

    Unlike in the twin a sample whose colour is not finite counts as an empty slot: its gradient and error are zero,
    the maps keep what they have, and `nonfinite` counts it.

    Args:
        colors: [P, 3] float32 or float16.
        targets: [P, 3] float32, the truth at the samples; or [X, 3] uint8, the photos of all views, gathered by the
            kernel; then `starts` is needed.
        samples: of at most `MAX_VIEWS` views.
        starts: [K] int64, first flat pixel of each view.
        update: the maps to update; their offsets give `starts`.
        nonfinite: [] int64, added to.
        nonfinite_losses: [] int64, 1 is added if the loss is not finite.

    Returns:
        The loss (a float64 scalar on the device), gradients [P, 3] float32 and errors [P] float32.
    """
    kernels.require()
    colors = colors.detach().float().contiguous()
    device, slots = colors.device, len(samples)
    photos = targets if targets.dtype == torch.uint8 else None
    maps, beta, stamp = [], 0.0, 0
    if update is not None:
        update.maps._rebase(update.step.iteration)
        maps = [update.maps.errors, update.maps.stamps, update.maps.view_sums]
        beta, stamp = update.maps.beta, update.step.iteration - update.maps.stamp_base
        starts = update.maps.offsets[list(samples.view_ids)]
    if starts is None:
        if photos is not None:
            raise ValueError("photos are gathered from the first flat pixel of each view: give `starts`")
        starts = np.zeros(len(samples.view_ids), dtype=np.int64)
    unused = [0] * len(starts)
    loss = torch.zeros((), dtype=torch.float64, device=device)
    color_gradients, pixel_errors = torch.empty_like(colors), torch.empty(slots, device=device)
    torch.ops.turbogs.sparse_loss(
        colors, None if photos is not None else targets.detach().float().contiguous(), photos,
        samples.pixel_ids, samples.tile_ids, samples.tile_offsets, samples.weights,
        _view_table(starts, samples.sizes, samples.view_ids, unused, unused), STRUCTURES.index(terms.structure),
        terms.epsilon, terms.l1_weight, terms.structure_weight, terms.variance_constant, terms.balance, terms.gate,
        maps, beta, stamp, count_filled(samples), loss, color_gradients, pixel_errors, nonfinite, nonfinite_losses,
        None if update is None else update.overflow,
    )  # fmt: skip
    return LossOutput(loss, color_gradients, pixel_errors)


def count_filled(samples: PixelSamples) -> Tensor | None:
    """[1] int32 on the device: the filled slots; None where all are."""
    if not samples.has_empty_slots:
        return None
    count = torch.zeros(1, dtype=torch.int32, device=samples.pixel_ids.device)
    torch.ops.turbogs.count_filled(samples.pixel_ids, count)
    return count


def projection_backward(screen: CudaScreenGradients, rows: bool) -> GaussianGradients:
    """The gradients of the parameters: one row per view (`rows`), or their sum. Adds to `screen.stats`.

    The fields that have rows are views of one packed [K, N, 14] tensor. After an overflow they are zero.
    """
    kernels.require()
    count, bands = len(screen.gaussians), screen.gaussians.shN.shape[1]
    num_rows = len(screen.cameras) if rows else 1
    # The kernel writes every entry, unless an overflow keeps it from running.
    new = torch.empty if screen.overflow is None else torch.zeros
    device = screen.records.device
    packed = new(num_rows, count, ROW_WIDTH, device=device)
    shN = new(count, bands, 3, device=device)
    touched = new(count, dtype=torch.bool, device=device)
    view_losses = new(num_rows, count, device=device)
    torch.ops.turbogs.projection_backward(*_backward_arguments(screen), packed, shN, touched, view_losses)
    return GaussianGradients(
        means=packed[..., 0:3],
        scales=packed[..., 3:6],
        quats=packed[..., 6:10],
        sh0=packed[..., 10:13].unsqueeze(-2),
        opacities=packed[..., 13],
        shN=shN,
        touched=touched,
        view_losses=view_losses,
    )


def fused_step(screen: CudaScreenGradients, gaussians: Gaussians, moments: GaussianMoments, rule: UpdateRule) -> None:
    """Projection backward and one step of `rule` in one launch: changes `gaussians` and `moments`, adds to
    `screen.stats`, and leaves nothing of use in `screen.records`.

    Args:
        screen: of at most `MAX_VIEWS` views.
        gaussians: the model that `screen` was made of: float32, contiguous.
        moments: its optimizer state, float32.
    """
    kernels.require()
    if any(value.data_ptr() != getattr(screen.gaussians, name).data_ptr() for name, value in gaussians.items()):
        raise ValueError("fused_step: these are not the Gaussians that the gradients were made of")
    kind, curvature, max_step, rows_per_view = 0, 0.0, 0.0, False
    if rule.lm is not None:
        kind = 1 if rule.lm.units == "balanced" else 2
        curvature, max_step, rows_per_view = rule.lm.curvature, rule.lm.max_step, rule.lm.rows == "views"
    state = [getattr(moments, field.name) for field in fields(moments)]
    torch.ops.turbogs.fused_step(
        *_backward_arguments(screen), state, kind, rows_per_view, list(astuple(rule.rates)), rule.beta1, rule.beta2,
        rule.eps, curvature, max_step,
    )  # fmt: skip


def _check_views(count: int) -> None:
    if not 1 <= count <= MAX_VIEWS:
        raise InputError(f"a batch takes 1 .. {MAX_VIEWS} views, got {count}")


def _backward_arguments(screen: CudaScreenGradients) -> tuple:
    """What the two operators have in common."""
    _check_views(len(screen.cameras))
    stats = [] if screen.stats is None else [getattr(screen.stats, field.name) for field in fields(screen.stats)]
    return (
        [getattr(screen.gaussians, name).detach() for name in PARAMETER_NAMES],
        screen.cameras.viewmats.contiguous(), screen.cameras.Ks.contiguous(),
        screen.cameras.sizes.reshape(-1).tolist(), screen.records, screen.radii, stats, screen.sh_degree,
        screen.settings.eps2d, count_filled(screen.samples), len(screen.samples), screen.overflow,
    )  # fmt: skip
