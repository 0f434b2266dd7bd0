"""Error maps and steps for tests of pixel samplers."""

import itertools

import numpy as np
import torch

from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.strategies.protocols import PixelSampler
from turbogs_plugin.tiles import compact, pixel_table
from turbogs_plugin.types import Step

SIZES = np.array([[37, 21], [16, 16], [1, 1], [50, 3], [64, 48]])
UNITS = ["pixel", "tile"]
SIGMAS = 4.5  # a seeded test compares fewer than 1000 frequencies: a false alarm would have had a chance below 1 %


def step(iteration, seed=0):
    return Step(iteration=iteration, total=10**6, refine_until=10**6, seed=seed)


def random_maps(sizes=SIZES, seed=0):
    generator = torch.Generator().manual_seed(seed)
    maps = ErrorMaps(np.asarray(sizes))
    for view_id, (width, height) in enumerate(maps.sizes):
        maps.initialise(view_id, torch.rand(int(width * height), generator=generator))
    maps.stamps.copy_(torch.randint(-1, 90, maps.stamps.shape, generator=generator))
    return maps


class Foreign(PixelSampler):
    """A sampler that knows no masks: every third pixel, with weights and empty slots."""

    def __repr__(self) -> str:
        return "Foreign()"

    def sample(self, maps, view_ids, rate, step):
        sizes = maps.sizes[list(view_ids)]
        table = pixel_table(sizes, "cpu")
        drawn = (table >= 0) & ((table + step.iteration) % 3 == 0)
        ids = torch.arange(len(table), dtype=torch.int32)
        weights = 1.0 + table.clamp(min=0).float()
        return compact(view_ids, sizes, table, drawn, ids, np.full(len(table), 128), weights)


def pixels_by_tile(samples):
    """{tile id: list of pixel ids without the empty slots}."""
    offsets = samples.tile_offsets.tolist()
    ids = samples.pixel_ids.tolist()
    return {
        tile: [pixel for pixel in ids[begin:end] if pixel >= 0]
        for tile, begin, end in zip(samples.tile_ids.tolist(), offsets[:-1], offsets[1:], strict=True)
    }


def successive(weights, count, left):
    """{frozenset: probability} of `count` draws without replacement from `left`, by enumeration."""
    sets = {}
    for order in itertools.permutations(sorted(left), min(count, len(left))):
        total, probability = sum(weights[i] for i in left), 1.0
        for index in order:
            probability *= weights[index] / total
            total -= weights[index]
        sets[frozenset(order)] = sets.get(frozenset(order), 0.0) + probability
    return sets
