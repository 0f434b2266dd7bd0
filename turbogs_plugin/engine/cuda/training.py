"""Python functions for the training kernels: sampling, loss, projection backward with the optimizer's step.

Each function does what its torch twin in `engine.reference` defines: `draws.draw_pixels`, `losses.sparse_loss` with
`ErrorMaps.update`, `raster.ReferenceScreenGradients.parameter_gradients` with `update.apply_update`. It is enqueued on
torch's current stream and does not wait. Tensors must be contiguous. A wrong device, dtype or shape, or a batch without
a view or with more than `MAX_VIEWS`, raises `RuntimeError`, which names the tensor and what was expected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate, pairwise
from types import SimpleNamespace

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.engine.cuda import launches, library
from turbogs_plugin.engine.cuda.raster import CudaScreenGradients, count_filled, plain_floats
from turbogs_plugin.engine.cuda.workspace import Workspace
from turbogs_plugin.engine.layout import MAX_PEERS, SAMPLE_UNITS, STRUCTURES, UPDATE_KINDS
from turbogs_plugin.engine.moments import GaussianMoments
from turbogs_plugin.engine.protocol import MapUpdate
from turbogs_plugin.engine.render_pass import ScreenGradients
from turbogs_plugin.engine.rules import DrawRule, LossTerms, UpdateRule
from turbogs_plugin.engine.shared import ModelCopies
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.tiles import TILE_PIXELS, DrawEnds, slots_of_tiles
from turbogs_plugin.types import (
    BLACK,
    Color,
    Gaussians,
    GaussianStats,
    LossOutput,
    PixelSamples,
    Step,
    TileGrid,
)


def sample_pixels(rule: DrawRule, maps: ErrorMaps, view_ids: tuple[int, ...], rate: float, step: Step) -> PixelSamples:
    """`Engine.draw`: sets equal to `draw_pixels`'s. `view_ids`: at most `MAX_VIEWS`."""
    maps.fetch(view_ids)
    views = np.asarray(view_ids, dtype=np.int64)
    device, sizes = maps.errors.device, maps.sizes[views]
    shapes, masks = tuple(map(tuple, sizes.tolist())), launches.NO_MASKS
    origin = rule.origin(step.iteration, masked=maps.masks is not None)
    if maps.masks is None:
        starts = TileGrid(sizes, origin).starts
        tiles, live_starts = tuple([end - start for start, end in pairwise(starts)]), None
    else:
        masks = maps.masks
        tiles, live_starts = tuple(masks.live_counts(view_ids)), tuple(masks.offsets[views].tolist())
    places = _places(rule, _wanted(rule, rate, tiles), shapes, tiles, live_starts)
    scratch = launches.NO_SCRATCH
    if rule.unit == "tile":
        dtypes = (torch.float64, torch.int32, torch.int64, torch.float32)
        scratch = launches.TileScratch(*(torch.empty(sum(tiles), dtype=dtype, device=device) for dtype in dtypes))
    slots, chosen = places.slots, places.chosen
    parts = slots, chosen, chosen + 1
    memory = torch.empty(sum(parts), dtype=torch.int32, device=device)  # in less of the host's time than three tensors
    pixel_ids, tile_ids, tile_offsets = memory.split_with_sizes(parts)
    draw = launches.SamplePixels(
        errors=maps.errors,
        stamps=maps.stamps,
        views=view_rows(maps.offsets[views].tolist(), shapes, view_ids, places.draws),
        grid=launches.GridOrigin(*origin),
        unit=SAMPLE_UNITS.index(rule.unit),
        masks=masks,
        slots_per_tile=places.slots_per_tile,
        mixed_uniform=rule.mixed_uniform,
        importance=rule.importance,
        seed=step.seed,
        iteration=step.iteration,
        now=maps.now(step),
        pixel_ids=pixel_ids,
        tile_ids=tile_ids,
        tile_offsets=tile_offsets,
        weights=torch.empty(slots, device=device) if rule.importance else None,
        scratch=scratch,
    )
    if slots:  # else every pixel is masked
        library.launch(draw)
    else:
        draw.tile_offsets.zero_()
    weights = draw.weights
    if weights is not None:
        weights = weights * ((draw.pixel_ids >= 0).sum() / weights.sum())
    return PixelSamples(
        tuple(view_ids),
        sizes,
        draw.pixel_ids,
        draw.tile_ids,
        draw.tile_offsets,
        weights,
        has_empty_slots=rule.unit != "pixel" or maps.masks is not None,
        host_ends=places.ends,
        origin=origin,
    )


@dataclass(frozen=True)
class _Places:
    """Sizes of a draw from views of given sizes.

    Args:
        chosen: tiles of all views that get samples.
        slots: of all views.
        slots_per_tile: 0 where tiles are drawn.
        draws: for each view the last six numbers of its `layout.DrawRow`.
        ends: see `PixelSamples.host_ends`.
    """

    chosen: int
    slots: int
    slots_per_tile: int
    draws: tuple[tuple[int, ...], ...]
    ends: DrawEnds


def _wanted(rule: DrawRule, rate: float, tiles: Sequence[int]) -> tuple[int, ...]:
    """Number of tiles drawn of each view, or of pixels drawn of each of its tiles."""
    if rule.unit == "tile":
        return tuple(rule.wanted(rate, count) for count in tiles)
    return (rule.wanted(rate, TILE_PIXELS),) * len(tiles)


@lru_cache(maxsize=4096)
def _places(
    rule: DrawRule,
    wanted: tuple[int, ...],
    shapes: tuple[tuple[int, int], ...],
    tiles: tuple[int, ...],
    live_starts: tuple[int, ...] | None,
) -> _Places:
    """Sizes of a draw, cached: a hundred iterations ask for equal ones, and making them takes longer than the launch.

    Args:
        wanted: of each view, from `_wanted`.
        shapes: of each view.
        tiles: of each view, those that are not masked whole.
        live_starts: where each view's tiles stand among the unmasked ones; None without masks.
    """
    by_tile, slots_per_tile = rule.unit == "tile", 0
    if by_tile:
        ends = list(accumulate(wanted))  # of each view's chosen tiles
        chosen, slots = ends[-1], ends[-1] * TILE_PIXELS
    else:
        slots_per_tile = wanted[0]
        if live_starts is None:
            ends = list(accumulate(_view_slots(*shape, wanted[0]) for shape in shapes))
        else:
            ends = list(accumulate(slots_per_tile * count for count in tiles))
        chosen, slots = sum(tiles), ends[-1]
    starts = live_starts or (0,) * len(tiles)
    draws = tuple(
        (first, *rule.stages(count), start, live)
        for first, count, start, live in zip([0, *ends[:-1]], wanted, starts, tiles, strict=True)
    )
    host_ends = DrawEnds(rule.unit, shapes, wanted, None if live_starts is None else tiles)
    return _Places(chosen, slots, slots_per_tile, draws, host_ends)


@lru_cache(maxsize=4096)
def _view_slots(width: int, height: int, wanted: int) -> int:
    """Slots of a view when `wanted` pixels are drawn from each tile."""
    return int(slots_of_tiles(wanted, np.array([[width, height]])).sum())


def view_rows(
    starts: Sequence[int],
    shapes: Sequence[Sequence[int]],
    view_ids: Sequence[int],
    draws: Sequence[tuple[int, ...]] | None = None,
) -> list[int]:
    """A `layout.ViewRow` for each view (with `draws` a `layout.DrawRow`), end to end. `shapes`: (width, height)."""
    columns = zip(starts, shapes, view_ids, draws or [()] * len(view_ids), strict=True)
    return [number for start, size, view_id, draw in columns for number in (start, *size, view_id, *draw)]


def sparse_loss(
    terms: LossTerms,
    colors: Tensor,
    targets: Tensor,
    samples: PixelSamples,
    update: MapUpdate | None = None,
    overflow: Tensor | None = None,
    background: Color = BLACK,
    workspace: Workspace | None = None,
) -> LossOutput:
    """Loss, gradient and pixel errors, in one launch. With `update` it also does what `ErrorMaps.update` does.

    A sample whose colour is not finite counts as an empty slot: its gradient and error are zero, and its pixel in the
    maps stays as it is.

    Args:
        colors: [P, 3] float32 or float16.
        targets: [P, 3] float32, the truth at the samples. Or [X, 3 or 4] uint8, the photos of all views, from which the
            kernel gathers; they are laid out like the maps, so `update` is then needed.
        samples: of at most `MAX_VIEWS` views.
        overflow: [1] int32 on the device, or None; if it is not 0, maps and count of `update` stay as they are.
        background: shows through photos that have an alpha.
        workspace: has memory for the gradients and errors, which are then valid until it is used for the next loss.

    Returns:
        The loss (a float64 scalar on the device), gradients [P, 3] float32 and errors [P] float32.
    """
    colors = plain_floats(colors)
    photos = targets if targets.dtype == torch.uint8 else None
    maps, beta, stamp, nonfinite_losses = launches.NO_MAPS, 0.0, 0, None
    starts = [0] * len(samples.view_ids)
    if update is not None:
        maps, nonfinite_losses = update.maps, update.nonfinite_losses
        beta, stamp = maps.beta, maps.stamp(update.step)
        starts = maps.offsets[list(samples.view_ids)].tolist()
    elif photos is not None:
        raise ValueError("photos are gathered from where the maps of each view begin: give `update`")
    output = _loss_output(len(colors), colors.device, workspace)
    loss = launches.SparseLoss(
        colors=colors,
        targets=None if photos is not None else plain_floats(targets),
        photos=photos,
        samples=samples,
        views=view_rows(starts, samples.sizes.tolist(), samples.view_ids),
        grid=launches.GridOrigin(*samples.origin),
        structure=STRUCTURES.index(terms.structure),
        terms=terms,
        maps=maps,
        beta=beta,
        stamp=stamp,
        num_filled=count_filled(samples),
        loss=output.loss,
        color_gradients=output.color_gradients,
        pixel_errors=output.pixel_errors,
        nonfinite_losses=nonfinite_losses,
        overflow=overflow,
        background=launches.Background(*background),
    )
    library.launch(loss)
    return output


def _loss_output(slots: int, device: torch.device, workspace: Workspace | None) -> LossOutput:
    """Output for the kernel to fill; its loss is zero."""
    if workspace is None:
        zero = torch.zeros((), dtype=torch.float64, device=device)
        return LossOutput(zero, torch.empty(slots, 3, device=device), torch.empty(slots, device=device))
    gradients = workspace.buffer("color_gradients", (slots, 3), torch.float32)
    return LossOutput(workspace.zero(), gradients, workspace.buffer("pixel_errors", (slots,), torch.float32))


def fused_step(
    rule: UpdateRule,
    screen: ScreenGradients,
    gaussians: Gaussians,
    moments: GaussianMoments,
    stats: GaussianStats | None = None,
    copies: ModelCopies | None = None,
) -> None:
    """Projection backward and one step of `rule` in one launch: changes `gaussians`, `copies` and `moments`, adds to
    `stats`, and leaves nothing of use in `screen.records`.

    Args:
        screen: of a backward pass of this engine and at most `MAX_VIEWS` views.
        gaussians: the model that `screen` was made from: float32, contiguous.
        moments: its optimizer state, float32.
        copies: of `gaussians`, `MAX_PEERS` - 1 at most.
    """
    if not isinstance(screen, CudaScreenGradients):
        raise TypeError(f"fused_step: {type(screen).__name__} is not of a pass of the kernels")
    drawn = screen.scene.gaussians
    if gaussians is not drawn and any(
        value.data_ptr() != getattr(drawn, name).data_ptr() for name, value in gaussians.items()
    ):
        raise ValueError("fused_step: these are not the Gaussians that the gradients were made of")
    lm = rule.lm
    library.launch(
        launches.FusedStep(
            screen=screen.backward_arguments(stats),
            copies=_copies(copies),
            moments=moments,
            kind=UPDATE_KINDS.index("adam" if lm is None else f"{lm.units}_lm"),
            rows_per_view=rule.per_view,
            rates=rule.rates,
            beta1=rule.beta1,
            beta2=rule.beta2,
            eps=rule.eps,
            curvature=0.0 if lm is None else lm.curvature,
            max_step=0.0 if lm is None else lm.max_step,
        )
    )


def _copies(copies: ModelCopies | None) -> SimpleNamespace:
    """`launches.Copies`: a distance for each other process, 0 for those that are not there."""
    if copies is None:
        return launches.NO_COPIES
    distances = (*copies.distances, *(0,) * (MAX_PEERS - 1 - len(copies.distances)))
    return SimpleNamespace(**{f"copy_{place}": distance for place, distance in enumerate(distances)})
