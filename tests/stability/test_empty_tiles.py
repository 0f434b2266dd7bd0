"""Tiles that are listed but have no sample, as one that a mask leaves none of."""

import dataclasses

import numpy as np
import pytest
import torch
from helpers.rendering_scenes import make_cameras, make_gaussians, thin_out

from turbogs_plugin.engine.reference.losses import sparse_loss
from turbogs_plugin.engine.render import dense_samples, rasterize
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.strategies.losses import CharbonnierNccLoss, SparseSsimLoss
from turbogs_plugin.types import GaussianStats, PixelSamples, Step

SIZES = [(40, 24), (33, 17)]
NOW = Step(7, 100, 70)


def emptied(samples: PixelSamples, tiles: list[int]) -> PixelSamples:
    """The same slots, none of those of these tiles filled. `tiles`: places in `tile_ids`."""
    pixel_ids = samples.pixel_ids.clone()
    for tile in tiles:
        pixel_ids[samples.tile_offsets[tile] : samples.tile_offsets[tile + 1]] = -1
    return dataclasses.replace(samples, pixel_ids=pixel_ids)


def without(samples: PixelSamples, tiles: list[int]) -> PixelSamples:
    """The samples of the other tiles alone."""
    counts = samples.tile_offsets.diff()
    kept = torch.ones(len(counts), dtype=torch.bool)
    kept[tiles] = False
    offsets = torch.cat([torch.zeros(1), counts[kept].cumsum(dim=0)]).to(torch.int32)
    return dataclasses.replace(
        samples,
        pixel_ids=samples.pixel_ids[kept.repeat_interleave(counts)],
        tile_ids=samples.tile_ids[kept],
        tile_offsets=offsets,
    )


@pytest.mark.parametrize("loss", [CharbonnierNccLoss(), SparseSsimLoss()], ids=["ncc", "ssim"])
@pytest.mark.parametrize("tiles", [[0], [2, 3], [-1]], ids=["the first", "two in a row", "the last"])
def test_a_tile_without_a_sample_is_as_if_it_were_not_listed(loss, tiles):
    """But that a structure term is a mean over the listed tiles: it is smaller by the ratio of their numbers."""
    gaussians, cameras = make_gaussians(40), make_cameras(SIZES)
    whole = thin_out(dense_samples(cameras), 0.3)
    tiles = [range(len(whole.tile_ids))[tile] for tile in tiles]
    generator = torch.Generator().manual_seed(0)
    photos = torch.rand(int(np.prod(SIZES, axis=1).sum()), 3, generator=generator, dtype=torch.float64)
    ratio = (len(whole.tile_ids) - len(tiles)) / len(whole.tile_ids)
    outcomes, structures = [], []
    for samples, factor in ((emptied(whole, tiles), ratio), (without(whole, tiles), 1.0)):
        structures.append([])
        maps = ErrorMaps.from_images([torch.full((height, width), 0.5) for width, height in SIZES])
        stats = GaussianStats.zeros(len(gaussians), "cpu")
        rendered, filled = rasterize(gaussians, cameras, samples), samples.filled
        truth = photos[samples.flat_pixels(maps.offsets)] * filled[:, None]
        result = loss(rendered.colors, truth, samples)
        for of_slots in (rendered.colors, rendered.alphas, result.color_gradients, result.pixel_errors):
            assert (of_slots[~filled] == 0).all()
        plain = sparse_loss(dataclasses.replace(loss.terms, structure="none"), rendered.colors, truth, samples)
        for structure in (result.loss - plain.loss, (result.color_gradients - plain.color_gradients)[filled]):
            structures[-1].append(structure / factor)
        maps.update(samples, result.pixel_errors, NOW)
        screen = rendered.backward(plain.color_gradients, plain.pixel_errors, with_statistics=True)
        gradients = screen.parameter_gradients(True, stats)
        kept = [rendered.colors[filled], plain.loss, plain.color_gradients[filled], maps.errors, maps.view_sums]
        outcomes.append([*kept, *vars(gradients).values(), *vars(stats).values()])
    for ours, expected in zip(*outcomes, strict=True):
        torch.testing.assert_close(ours, expected, rtol=1e-9, atol=1e-12)
    for ours, expected in zip(*structures, strict=True):
        torch.testing.assert_close(ours, expected, rtol=1e-9, atol=1e-12)
