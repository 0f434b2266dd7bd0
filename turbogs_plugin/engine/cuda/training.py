"""Python functions for the training kernels: sampling, loss, projection backward with the optimizer's step, exposures.

Each function does what its torch twin in `engine.reference` defines: `draws.draw_pixels`, `losses.sparse_loss` with
`ErrorMaps.update`, `raster.ReferenceScreenGradients.parameter_gradients` with `update.apply_update`, and
`engine.exposures`. It is enqueued on torch's current stream and does not wait. Tensors must be contiguous. A wrong
device, dtype or shape, or a batch without a view or with more than `MAX_VIEWS`, raises `RuntimeError`, which names the
tensor and what was expected.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.engine.cuda import launches, library
from turbogs_plugin.engine.cuda.raster import Buffers, CudaScreenGradients, plain_floats
from turbogs_plugin.engine.cuda.workspace import Workspace
from turbogs_plugin.engine.exposures import BETA1, BETA2, EPSILON, PULL, Exposures
from turbogs_plugin.engine.layout import MAX_PEERS, SAMPLE_UNITS, STRUCTURES, UPDATE_KINDS
from turbogs_plugin.engine.moments import GaussianMoments
from turbogs_plugin.engine.protocol import MapUpdate
from turbogs_plugin.engine.render_pass import ScreenGradients
from turbogs_plugin.engine.rules import DrawRule, LossTerms, UpdateRule
from turbogs_plugin.engine.shared import ModelCopies
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.scene.depths import CELL, DepthPair
from turbogs_plugin.tiles import TILE_PIXELS, DrawEnds
from turbogs_plugin.types import BLACK, Color, Gaussians, GaussianStats, LossOutput, PixelSamples, Step, TileGrid


def sample_pixels(rule: DrawRule, maps: ErrorMaps, view_ids: tuple[int, ...], rate: float, step: Step) -> PixelSamples:
    """`Engine.draw`: sets equal to `draw_pixels`'s."""
    maps.fetch(view_ids)
    views = np.asarray(view_ids, dtype=np.int64)
    device, sizes, masks, by_tile = maps.errors.device, maps.sizes[views], maps.masks, rule.unit == "tile"
    shapes, origin = tuple(map(tuple, sizes.tolist())), rule.origin(step.iteration, masked=masks is not None)
    if masks is None:
        tiles = tuple([end - start for start, end in pairwise(TileGrid(sizes, origin).starts)])
        live, live_starts = None, (0,) * len(tiles)
    else:
        tiles = live = tuple(masks.live_counts(view_ids))
        live_starts = tuple(masks.offsets[views].tolist())
    wanted = tuple([rule.wanted(rate, count if by_tile else TILE_PIXELS) for count in tiles])
    ends = DrawEnds(rule.unit, shapes, wanted, live)
    chosen, slots, draws = _places(rule, ends, tiles, live_starts)
    scratch = launches.NO_SCRATCH
    if by_tile:
        dtypes = {"errors": torch.float64, "ages": torch.int32, "keys": torch.int64}
        empty = partial(torch.empty, sum(tiles), device=device)
        scratch = SimpleNamespace(**{f"tile_{name}": empty(dtype=dtype) for name, dtype in dtypes.items()})
    parts = slots, chosen, chosen + 1
    memory = torch.empty(sum(parts), dtype=torch.int32, device=device)  # in less of the host's time than three tensors
    pixel_ids, tile_ids, tile_offsets = memory.split_with_sizes(parts)
    samples = PixelSamples(
        tuple(view_ids),
        sizes,
        pixel_ids,
        tile_ids,
        tile_offsets,
        weights=torch.empty(slots, device=device) if rule.importance else None,
        has_empty_slots=by_tile or masks is not None,
        host_ends=ends,
        origin=origin,
    )
    draw = launches.SamplePixels(
        errors=maps.errors,
        stamps=maps.stamps,
        views=view_rows(maps.offsets[views].tolist(), shapes, view_ids, draws),
        grid=launches.GridOrigin(*origin),
        unit=SAMPLE_UNITS.index(rule.unit),
        masks=launches.NO_MASKS if masks is None else masks,
        slots_per_tile=0 if by_tile else wanted[0],
        mixed_uniform=rule.mixed_uniform,
        importance=rule.importance,
        seed=step.seed,
        iteration=step.iteration,
        now=maps.now(step),
        samples=samples,
        scratch=scratch,
    )
    if slots:  # else every pixel is masked
        library.launch(draw)
    else:
        samples.tile_offsets.zero_()
    if samples.weights is not None:
        samples.weights *= (samples.pixel_ids >= 0).sum() / samples.weights.sum()
    return samples


@lru_cache(maxsize=4096)
def _places(
    rule: DrawRule, host_ends: DrawEnds, tiles: tuple[int, ...], live_starts: tuple[int, ...]
) -> tuple[int, int, list[list[int]]]:
    """Sizes of a draw: the number of tiles that get samples, the number of their slots, and for each view the last six
    numbers of its `layout.DrawRow`. Cached, as making them takes longer than the launch.

    Args:
        tiles: of each view, those that are not masked whole.
        live_starts: where each view's tiles stand among the unmasked ones; 0 without masks.
    """
    view_ends, slot_ends = host_ends()
    firsts, starts = np.append(0, view_ends)[:-1], np.append(0, slot_ends)  # [K] tiles, [T + 1] slots
    if rule.unit == "pixel":
        firsts = starts[firsts]
    columns = zip(firsts.tolist(), host_ends.wanted, live_starts, tiles, strict=True)
    draws = [[first, *rule.stages(count), start, live] for first, count, start, live in columns]
    return len(slot_ends), int(starts[-1]), draws


def view_rows(
    starts: Sequence[int],
    shapes: Sequence[Sequence[int]],
    view_ids: Sequence[int],
    draws: Sequence[Sequence[int]] | None = None,
) -> list[int]:
    """A `layout.ViewRow` for each view (with `draws` a `layout.DrawRow`), end to end. `shapes`: (width, height)."""
    columns = zip(starts, shapes, view_ids, draws or [()] * len(view_ids), strict=True)
    return [number for start, size, view_id, draw in columns for number in (start, *size, view_id, *draw)]


def sparse_loss(
    terms: LossTerms,
    colors: Tensor,
    targets: Tensor,
    samples: PixelSamples,
    depths: DepthPair | None = None,
    update: MapUpdate | None = None,
    overflow: Tensor | None = None,
    background: Color = BLACK,
    workspace: Workspace | None = None,
) -> LossOutput:
    """`Engine.evaluate`, and with `update` `Engine.learn`, in one launch. The loss is a float64 scalar on the device.

    Args:
        colors: [P, 3] float32 or float16.
        targets: [P, 3] float32, the truth at the samples. Or [X, 3 or 4] uint8, the photos of all views, from which the
            kernel gathers; they are laid out like the maps, so `update` is then needed.
        overflow: [1] int32 on the device, or None; if it is not 0, maps and count of `update` stay as they are.
        background: shows through photos that have an alpha.
        workspace: has memory for the gradients and errors, which are then valid until it is used for the next loss.
    """
    colors = plain_floats(colors)
    photos = targets if targets.dtype == torch.uint8 else None
    maps, beta, stamp, nonfinite_losses = launches.NO_MAPS, 0.0, 0, None
    starts = [0] * len(samples.view_ids)
    if update is not None:
        maps, nonfinite_losses = update.maps, update.nonfinite_losses
        beta, stamp = maps.beta, maps.stamp(update.step)
        starts = maps.offsets[list(samples.view_ids)].tolist()
    buffers, slots = Buffers(workspace, colors.device), len(colors)
    output = LossOutput(
        loss=torch.zeros((), dtype=torch.float64, device=colors.device) if workspace is None else workspace.zero(),
        color_gradients=buffers.floats("color_gradients", slots, 3),
        pixel_errors=buffers.floats("pixel_errors", slots),
        depth_gradients=None if depths is None else buffers.floats("depth_gradients", slots),
    )
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
        num_filled=samples.filled.sum(dtype=torch.int32).reshape(1) if samples.has_empty_slots else None,
        output=output,
        nonfinite_losses=nonfinite_losses,
        overflow=overflow,
        background=launches.Background(*background),
        depths=None if depths is None else plain_floats(depths.rendered),
        known=launches.NO_DEPTHS if depths is None else depths.known,
        cell=CELL,
        depth_factor=0.0 if depths is None else terms.depth_weight / depths.known.share,
    )
    library.launch(loss)
    return output


def fused_step(
    rule: UpdateRule,
    screen: ScreenGradients,
    gaussians: Gaussians,
    moments: GaussianMoments,
    stats: GaussianStats | None = None,
    copies: ModelCopies | None = None,
) -> None:
    """Projection backward and one step of `rule` in one launch: changes `gaussians`, `copies` and `moments`, adds to
    `stats`, and leaves nothing of use in `screen.records`. `gaussians` are those that `screen` was made from, float32
    and contiguous; there are at most `MAX_PEERS` - 1 copies.
    """
    if not isinstance(screen, CudaScreenGradients):
        raise TypeError(f"fused_step: {type(screen).__name__} is not of a pass of the kernels")
    drawn = screen.scene.gaussians
    if gaussians is not drawn and any(
        value.data_ptr() != getattr(drawn, name).data_ptr() for name, value in gaussians.items()
    ):
        raise ValueError("fused_step: these are not the Gaussians that the gradients were made of")
    library.launch(
        launches.FusedStep(
            screen=screen.backward_arguments(stats),
            copies=_copies(copies),
            moments=moments,
            kind=UPDATE_KINDS.index(rule.kind),
            rates=rule.rates,
            beta1=rule.beta1,
            beta2=rule.beta2,
            eps=rule.eps,
        )
    )


def _copies(copies: ModelCopies | None) -> SimpleNamespace:
    """`launches.Copies`: a distance for each other process, 0 for those that are not there."""
    if copies is None:
        return launches.NO_COPIES
    distances = (*copies.distances, *(0,) * (MAX_PEERS - 1 - len(copies.distances)))
    return SimpleNamespace(**{f"copy_{place}": distance for place, distance in enumerate(distances)})


def expose_colors(exposures: Exposures, colors: Tensor, samples: PixelSamples) -> Tensor:
    """`Engine.expose`."""
    exposed = torch.empty(len(colors), 3, device=colors.device)
    library.launch(launches.ExposeColors(_exposed_views(exposures, colors, samples), exposed))
    return exposed


def learn_exposures(
    exposures: Exposures,
    colors: Tensor,
    gradients: Tensor,
    samples: PixelSamples,
    rate: float,
    overflow: Tensor | None = None,
) -> Tensor:
    """`Engine.learn_exposures`, in two launches; `gradients`, where float32 and contiguous, is changed in place."""
    batch, gradients = _exposed_views(exposures, colors, samples), plain_floats(gradients)
    sums = torch.zeros(len(samples.view_ids), 3, 4, dtype=torch.float64, device=colors.device)
    library.launch(launches.ExposureBackward(batch, gradients, sums))
    adam = {"rate": rate, "beta1": BETA1, "beta2": BETA2, "eps": EPSILON, "pull": PULL}
    library.launch(launches.ExposureStep(sums, batch.views, batch.grid, exposures, overflow, **adam))
    return gradients


def _exposed_views(exposures: Exposures, colors: Tensor, samples: PixelSamples) -> launches.ExposedViews:
    return launches.ExposedViews(
        colors=plain_floats(colors),
        tile_ids=samples.tile_ids,
        tile_offsets=samples.tile_offsets,
        views=view_rows([0] * len(samples.view_ids), samples.sizes.tolist(), samples.view_ids),
        grid=launches.GridOrigin(*samples.origin),
        offsets=exposures.offsets,
    )
