"""Front-to-back compositing of splats at sampled pixels, and its gradient.

Tiles with similar numbers of splats form a block ``[B tiles, S samples, G splats]``, padded to a rectangle. Its size is
bounded, so that its intermediate arrays stay in cache. The splats of deep tiles are taken in slices. Once every pixel
of a block is opaque, its further slices are skipped.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from turbogs_plugin.engine.layout import ScreenRecord
from turbogs_plugin.engine.reference.intersection import Intersections
from turbogs_plugin.engine.reference.projection import Splats
from turbogs_plugin.engine.render_pass import RasterSettings
from turbogs_plugin.types import PixelSamples

BLOCK_ELEMENTS = {"cpu": 1 << 18, "cuda": 1 << 24}
"""Elements of one intermediate array of a block."""

SLICE_SPLATS = 128
"""Splats of a tile that are composited at a time."""

ALPHA_TINY = 1e-10
"""Smallest alpha by which a depth is divided, as in gsplat."""


@dataclass
class Block:
    """B tiles. `samples`: [B, S] slots, P where padded. `start`, `count`: [B] the tiles' range of intersections."""

    samples: Tensor
    start: Tensor
    count: Tensor
    depth: int  # largest count


@dataclass
class Compositor:
    """Composites the splats of a pass, and takes gradients back to them.

    Args:
        intersections: M, of the T tiles.
        samples: P.
        settings: thresholds.
        table: [10, R] the splats, see `splat_table`.
    """

    intersections: Intersections
    samples: PixelSamples
    settings: RasterSettings
    table: Tensor

    def blocks(self) -> Iterator[Block]:
        """All tiles that have both samples and intersections, those with the most intersections first."""
        tile_counts = self.intersections.tile_counts
        device_counts, order = tile_counts.sort(descending=True, stable=True)
        counts = device_counts.tolist()
        offsets = self.samples.tile_offsets.long()
        sample_counts, sample_starts = offsets.diff()[order], offsets[:-1][order]
        host_sample_counts = sample_counts.tolist()
        starts = (tile_counts.cumsum(0) - tile_counts)[order]
        limit = BLOCK_ELEMENTS[self.table.device.type]

        begin = 0
        while begin < len(counts) and counts[begin] > 0:
            depth, most_samples, end = counts[begin], 0, begin
            while end < len(counts) and counts[end] > 0:
                most = max(most_samples, host_sample_counts[end])
                if end > begin and (end + 1 - begin) * most * min(depth, SLICE_SPLATS) > limit:
                    break
                most_samples, end = most, end + 1
            number = torch.arange(most_samples, device=self.table.device)
            slots = sample_starts[begin:end, None] + number
            slots = slots.masked_fill_(number >= sample_counts[begin:end, None], len(self.samples))
            yield Block(slots, starts[begin:end], device_counts[begin:end], depth)
            begin = end

    def slices(self) -> Iterator[tuple[Block, Tensor, Tensor, Slice]]:
        """Every slice of every block; a block's slices come front to back, until all its pixels are opaque. Yields the
        block; numbers [B, G] of the slice's intersections; which of them are real, not padding; the slice."""
        centers = self.samples.coordinates().to(self.table.dtype) + 0.5
        centers = torch.cat([centers, centers.new_zeros(1, 2)])  # [P + 1, 2], the last of them padding
        for block in self.blocks():
            block_centers = centers[block.samples]  # [B, S, 2]
            transmittance = torch.ones_like(block_centers[:, :, :1])
            for first in range(0, block.depth, SLICE_SPLATS):
                number = torch.arange(first, min(first + SLICE_SPLATS, block.depth), device=self.table.device)
                real = number < block.count[:, None]
                numbers = torch.where(real, block.start[:, None] + number, 0)
                rows = self.intersections.rows[numbers]
                piece = composite_slice(self.table, rows, real, block_centers, transmittance, self.settings)
                yield block, numbers, real, piece
                transmittance = piece.transmittance
                if not transmittance.any():
                    break

    def forward(self) -> Tensor:
        """[P, 5]: sums of weight times (red, green, blue, 1, depth) at all samples. Zero in empty slots."""
        sums = self.table.new_zeros(len(self.samples) + 1, 5)
        for block, _, _, piece in self.slices():
            sums[block.samples] = sums[block.samples].baddbmm_(piece.weights, piece.features.transpose(1, 2))
        return sums[:-1] * self.samples.filled[:, None]

    def backward(self, sums: Tensor, gradients: Tensor, pixel_errors: Tensor) -> Tensor:
        """[R, 16], `layout.ScreenRecord` of the splats, from gradients [P, 5] of the result `sums` of `forward`, and
        errors [P].

        The weights are composited a second time, front to back. The contribution behind a splat is the pixel's total
        minus what has been seen of it, so nothing is divided by a small transmittance.
        """
        intersections, filled = self.intersections, self.samples.filled[:, None]
        # Red, green, blue, alpha, depth, error, 1. Zero in the padding slot and in empty ones.
        upstream = torch.cat([gradients, pixel_errors[:, None].to(sums.dtype), torch.ones_like(sums[:, :1])], dim=1)
        upstream = torch.where(filled, upstream, 0.0)
        upstream = torch.cat([upstream, upstream.new_zeros(1, 7)])
        totals = torch.cat([(upstream[:-1, :5] * sums).sum(dim=1, keepdim=True), sums.new_zeros(1, 1)])
        records = self.table.new_zeros(len(intersections.rows), ScreenRecord.SIZE)
        for block, numbers, real, piece in self.slices():
            # `totals` [P + 1, 1]: the contribution of the splats still to come
            record, totals[block.samples] = _slice_backward(piece, upstream[block.samples], totals[block.samples])
            records[intersections.slots[numbers[real]]] = record[real]
        return intersections.sum_by_row(records)


@dataclass
class Slice:
    """One slice of a block, [B, S, G] unless noted: what the forward pass computes and the backward pass needs."""

    features: Tensor  # [B, 5, G] red, green, blue, 1, depth
    conics: Tensor  # [3, B, 1, G]
    opacities: Tensor  # [B, 1, G]
    dx: Tensor
    dy: Tensor
    sigma: Tensor
    alpha: Tensor  # zero where the splat is skipped or the pixel has ended
    clamped: Tensor | None  # alpha was cut at alpha_max; None: nowhere
    weights: Tensor
    transmittance: Tensor  # [B, S, 1] behind the slice, zero where the pixel has ended


def composite_slice(
    table: Tensor, rows: Tensor, real: Tensor, centers: Tensor, transmittance: Tensor, settings: RasterSettings
) -> Slice:
    """Weights of a slice's splats.

    Args:
        table: [10, R] mean x, y; conic a, b, c; opacity; red, green, blue; depth.
        rows, real: [B, G].
        centers: [B, S, 2] pixel centres.
        transmittance: [B, S, 1] before the slice.
    """
    count, splats = rows.shape
    fields = table.index_select(1, rows.flatten()).reshape(10, count, 1, splats)
    a, b, c = conics = fields[2:5]
    opacities = fields[5] * real[:, None]
    features = torch.cat([fields[6:9], torch.ones_like(fields[9:]), fields[9:]])[:, :, 0].transpose(0, 1).contiguous()

    dx, dy = fields[0] - centers[:, :, :1], fields[1] - centers[:, :, 1:]
    sigma = (0.5 * c * dy).mul_(dy)
    sigma.addcmul_((0.5 * a * dx).addcmul_(b.expand_as(dx), dy), dx)
    torch.threshold_(sigma, -torch.finfo(sigma.dtype).tiny, torch.finfo(sigma.dtype).max / 4)  # negative: skipped
    alpha = sigma.neg().exp_().mul_(opacities)
    clamped = alpha > settings.alpha_max if bool((opacities > settings.alpha_max).any()) else None
    if clamped is not None:
        alpha.clamp_(max=settings.alpha_max)
    at_least = torch.nextafter(alpha.new_tensor(settings.alpha_min), alpha.new_tensor(0.0)).item()
    torch.threshold_(alpha, at_least, 0.0)

    through = torch.empty(count, centers.shape[1], splats + 1, dtype=alpha.dtype, device=alpha.device)
    through[:, :, :1] = transmittance
    torch.sub(1, alpha, out=through[:, :, 1:])
    through = through.cumprod(dim=-1)
    weights = alpha * through[:, :, :-1]
    behind = through[:, :, -1:].clone()
    if bool((behind <= settings.transmittance_min).any()):
        ended = through[:, :, 1:] <= settings.transmittance_min
        weights.masked_fill_(ended, 0)
        alpha.masked_fill_(ended, 0)
        torch.threshold_(behind, settings.transmittance_min, 0.0)
    return Slice(features, conics, opacities, dx, dy, sigma, alpha, clamped, weights, behind)


def splat_table(splats: Splats) -> Tensor:
    """[10, R], the channels that `composite_slice` lists."""
    columns = [splats.means2d, splats.conics, splats.opacities[:, None], splats.colors, splats.depths[:, None]]
    return torch.cat(columns, dim=1).T.contiguous()


def _slice_backward(piece: Slice, upstream: Tensor, behind: Tensor) -> tuple[Tensor, Tensor]:
    """Records [B, G, 16] of a slice, and `behind` after it."""
    contribution = torch.bmm(upstream[:, :, :5], piece.features).mul_(piece.weights)  # [B, S, G]
    seen = contribution.cumsum(dim=-1)
    after = behind - seen[:, :, -1:]
    # d loss / d sigma = -alpha * d loss / d alpha
    slope = seen.sub_(behind).mul_(piece.alpha).div_(1 - piece.alpha).add_(contribution).neg_()
    if piece.clamped is not None:
        slope.masked_fill_(piece.clamped, 0)
    a, b, c = piece.conics
    slope_x, slope_y = slope * piece.dx, slope * piece.dy
    record = slope.new_zeros(ScreenRecord.SIZE, slope.shape[0], slope.shape[2])
    first = (slope_x.sum(dim=1), slope_y.sum(dim=1))
    record[ScreenRecord.SQUARE_SUM] = slope.square().sum(dim=1)
    record[ScreenRecord.MEAN.start] = a[:, 0] * first[0] + b[:, 0] * first[1]
    record[ScreenRecord.MEAN.start + 1] = b[:, 0] * first[0] + c[:, 0] * first[1]
    record[ScreenRecord.ABSOLUTE.start] = (a * slope_x).addcmul_(b.expand_as(slope_x), slope_y).abs_().sum(dim=1)
    record[ScreenRecord.ABSOLUTE.start + 1] = (b * slope_x).addcmul_(c.expand_as(slope_x), slope_y).abs_().sum(dim=1)
    record[ScreenRecord.CONIC.start + 1] = (slope_x * piece.dy).sum(dim=1)
    record[ScreenRecord.CONIC.start] = 0.5 * slope_x.mul_(piece.dx).sum(dim=1)
    record[ScreenRecord.CONIC.start + 2] = 0.5 * slope_y.mul_(piece.dy).sum(dim=1)
    opacities = piece.opacities[:, 0]
    record[ScreenRecord.OPACITY] = torch.where(opacities > 0, -slope.sum(dim=1) / opacities, 0.0)
    weighted = torch.bmm(upstream.transpose(1, 2), piece.weights)  # [B, 7, G]
    record[ScreenRecord.COLOR] = weighted[:, :3].transpose(0, 1)
    record[ScreenRecord.DEPTH] = weighted[:, 4]
    record[ScreenRecord.ERROR_SUM] = weighted[:, 5]
    record[ScreenRecord.WEIGHT_SUM] = weighted[:, 6]
    # In place: the exponents are not needed after this.
    distances = piece.sigma.mul_(2).sqrt_().mul_(piece.weights)
    record[ScreenRecord.DISTANCE_SUM] = torch.bmm(upstream[:, :, 6:].transpose(1, 2), distances)[:, 0]
    return record.permute(1, 2, 0), after
