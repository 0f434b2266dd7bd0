"""The draw of pixels or tiles by which the samplers choose what is rendered (paper section 3.5).

Within every 16x16 tile of the K views, N units are drawn without replacement in three stages, each from the units that
the stages before it left: the *hard* share by error, the *stable* share by age, the *mixed* rest by both. A unit is a
pixel (the paper's) or a whole tile; whole tiles are drawn among the tiles of a view. Their grid begins elsewhere in
each iteration (`DrawRule.origin`), but for maps with masks.

The draw is defined down to the bit, so that `draw_pixels` here and its CUDA twin return equal sets:

1. Each unit has an error E, float32. For a pixel it is the pixel's error. For a tile it is the exact sum of its pixels'
   errors, rounded once; sums of halves are exact in float64. It also has an age A, an integer, the largest age of its
   pixels, which differ, as the grid of tiles begins elsewhere in each iteration.
2. Each unit has four random words ``x0 .. x3`` (layout in `philox`). Their place is the pixel id ``y * width + x``, or
   the tile's number within its view; the purpose says which of the two.
3. Each stage ranks the units not yet drawn by a 64-bit key, and takes the largest. Keys are distinct, as their low 20
   bits are ``2^20 - 1 - rank``, so among equals the lower rank goes first. The rank is the pixel's `sample_order`, or
   the tile's number in its view. The high bits are:

   - hard: the bits, as an integer, of the float32 ``max(E, 2^-100) / exponential(x0)``, an exponential race: taking the
     largest is the multinomial draw without replacement, with the probabilities E / sum(E). Zero errors come after
     all others, in random order, so a tile without error is drawn uniformly;
   - stable: ``A << 24 | x1 >> 8``, the largest age, ties at random;
   - mixed: the bits of ``max(M, 2^-100) / exponential(x2)`` with ``M = E / S + A / B``, the two divisions and the sum
     each rounded to float32. S and B are the exact sums of E and A over all units of the tile (of the view for unit =
     tile), drawn or not, rounded to float32. A quotient by zero counts as 0. For `mixed` = uniform, M = 1.

Importance weights, of pixels alone, are ``w = p^-a`` over their mean. p is the probability that a pixel is drawn, given
the keys of the others ("rank conditioning", Cohen and Kaplan 2007: dividing by it makes a single stage exactly
unbiased). In a stage, tau is the least key with which the pixel would have been taken. Of one that the stage takes, it
is the largest key left (none if the stage takes all); of any other, drawn before or not at all, the smallest key taken.
With tau for the number in its high bits, the probability of a stage is ``1 - exp(-max(E or M, 2^-100) / tau)`` in a
race, ``clamp(((A + 1) << 24) - tau, 0, 2^24) / 2^24`` in the stable stage, and 1 without a tau. It is 0 for a stage
that takes nothing. Together, ``p = 1 - (1 - p_hard) (1 - p_stable) (1 - p_mixed)``, and 1 where all units of a
row are drawn.

Where maps have masks, a masked pixel is no unit, adds to no sum, and is in no tile that is drawn. A tile without
another pixel is no unit either. The number of a tile within its view is then that among its live tiles.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.engine.reference.philox import PURPOSE_PIXELS, PURPOSE_TILES, Words, exponentials, random_words
from turbogs_plugin.engine.rules import DrawRule
from turbogs_plugin.error_maps import AGE_MAX, ErrorMaps
from turbogs_plugin.tiles import TILE_PIXELS, DrawEnds, compact, pixel_table, tile_areas
from turbogs_plugin.types import PixelSamples, Step, TileGrid

RANK_BITS = 20
AGE_TIE_BITS = 24
WEIGHT_FLOOR = 2.0**-100
"""Weight of a unit without error: so small that it never wins against a positive one."""


def draw_units(
    errors: Tensor, ages: Tensor, exist: Tensor, words: Words, wanted: int, rule: DrawRule
) -> tuple[Tensor, Tensor | None]:
    """Draw from each of R rows of U units, in the three stages of the module docstring.

    Args:
        errors, ages: [R, U] float64, exact sums, and integers; 0 where there is no unit.
        exist: [R, U] bool, there is a unit: rows of tiles cut by the image's edge have gaps.
        words: four [R, U] int64 random words.
        wanted: units to draw from each row.

    Returns:
        [R, U] bool, the units drawn; and their inclusion probabilities p, [R, U] float32 (meaningless for units not
        drawn), or None if the rule has no importance weights.
    """
    ranks = (1 << RANK_BITS) - 1 - torch.arange(exist.shape[1], device=errors.device)  # [U]
    ages, sums = ages.long(), errors.sum(dim=1, keepdim=True).float()
    errors = errors.float()
    if rule.mixed_uniform:
        mixed = torch.ones_like(errors)
    else:
        mixed = _share(errors, sums) + _share(ages.float(), ages.sum(dim=1, keepdim=True).float())

    drawn = torch.zeros_like(exist)
    missed = torch.ones_like(errors)  # probability of not being drawn
    weights_of = {"hard": errors, "mixed": mixed}  # the stable stage goes by age alone
    stages = ("hard", "stable", "mixed")
    for stage, count, word in zip(stages, rule.stages(wanted), words[:3], strict=True):
        if count == 0:
            continue
        if stage == "stable":
            primary = (ages << AGE_TIE_BITS) | (word >> (32 - AGE_TIE_BITS))
        else:
            weights = weights_of[stage].clamp(min=WEIGHT_FLOOR)
            primary = (weights / exponentials(word)).view(torch.int32).long()
        keys = torch.where(exist & ~drawn, (primary << RANK_BITS) | ranks, -1)
        largest = keys.topk(min(count + 1, keys.shape[1]), dim=1).values
        largest = torch.nn.functional.pad(largest, (0, 1), value=-1)  # a stage may take all there are
        smallest_taken, largest_left = largest[:, count - 1, None], largest[:, count, None]
        taken = keys > largest_left
        drawn |= taken
        if rule.importance:
            tau = torch.where(taken, largest_left, smallest_taken) >> RANK_BITS  # -1 for none
            if stage == "stable":
                chance = (((ages + 1) << AGE_TIE_BITS) - tau).clamp(0, 1 << AGE_TIE_BITS) * 2.0**-AGE_TIE_BITS
            else:
                threshold = tau.to(torch.int32).view(torch.float32)
                chance = torch.where(tau < 0, 1.0, -torch.expm1(-weights / threshold))
            missed = missed * (1.0 - chance)
    if not rule.importance:
        return drawn, None
    complete = (drawn | ~exist).all(dim=1, keepdim=True)
    return drawn, torch.where(complete, 1.0, 1.0 - missed)


def _share(values: Tensor, sums: Tensor) -> Tensor:
    """``values / sums``, 0 where the sum is 0."""
    return torch.where(sums > 0, values / sums, 0.0)


def draw_pixels(rule: DrawRule, maps: ErrorMaps, view_ids: tuple[int, ...], rate: float, step: Step) -> PixelSamples:
    """`Engine.draw`, as the module docstring defines it.

    Returns:
        Samples whose counts are all known without reading from the device. A tile has min(N, its pixels) slots for
        unit = pixel, 256 for tile. With masks there are live tiles alone, each with N or 256 slots.
    """
    maps.fetch(view_ids)
    device, views = maps.errors.device, np.asarray(view_ids, dtype=np.int64)
    sizes = maps.sizes[views]
    origin = rule.origin(step.iteration, masked=maps.masks is not None)
    table = pixel_table(sizes, device, origin)  # [T, 256]
    exist = table >= 0
    counts = TileGrid(sizes, origin).shapes.prod(axis=1)  # [K]
    tile_ids = None
    if maps.masks is not None:
        counts = np.array(maps.masks.live_counts(view_ids))
        tile_ids, unmasked = maps.masks.live_tiles(view_ids)
        table = table[tile_ids]
        exist = unmasked & (table >= 0)
    tile_views = np.repeat(views, counts)  # [T]
    flat = torch.as_tensor(maps.offsets[tile_views], device=device)[:, None] + table.clamp(min=0)
    errors = torch.where(exist, maps.errors[flat].double(), 0.0)  # [T, 256]
    ages = torch.where(exist, (maps.now(step) - maps.stamps[flat].int()).clamp(0, AGE_MAX), 0)
    view_numbers = torch.as_tensor(tile_views, device=device)[:, None]  # [T, 1]

    def words(place: Tensor, purpose: int) -> Words:
        return random_words(place.clamp(min=0).long(), view_numbers, purpose, step.seed, step.iteration)

    live = None if tile_ids is None else tuple(counts.tolist())
    if rule.unit == "tile":
        chosen, wanted = _draw_tiles(errors.sum(dim=1), ages.amax(dim=1), counts, words, rate, rule)
        table, drawn, slots, weights = table[chosen], exist[chosen], np.full(len(chosen), TILE_PIXELS), None
        tile_ids = chosen if tile_ids is None else tile_ids[chosen]
    else:
        wanted = [rule.wanted(rate, TILE_PIXELS)] * len(counts)
        drawn, probabilities = draw_units(errors, ages, exist, words(table, PURPOSE_PIXELS), wanted[0], rule)
        weights = None if probabilities is None else probabilities.clamp(min=2.0**-24) ** -rule.importance
        slots = np.minimum(wanted[0], tile_areas(sizes)) if live is None else np.full(len(table), wanted[0])
        tile_ids = torch.arange(len(table), device=device) if tile_ids is None else tile_ids
    full = rule.unit == "pixel" and live is None
    samples = compact(view_ids, sizes, table, drawn, tile_ids.int(), slots, weights, full=full, origin=origin)
    return replace(samples, host_ends=DrawEnds(rule.unit, tuple(map(tuple, sizes.tolist())), tuple(wanted), live))


def _draw_tiles(
    errors: Tensor, ages: Tensor, counts: np.ndarray, words: Callable[[Tensor, int], Words], rate: float, rule: DrawRule
) -> tuple[Tensor, list[int]]:
    """Positions of whole tiles, drawn from each view, among the T; the number drawn of each view. `errors`, `ages`:
    [T] of the tiles; `counts`: [K] tiles of each view; `words` gives the random words of places [T, 1]."""
    device, ends = errors.device, np.concatenate([[0], np.cumsum(counts)])
    tiles = torch.arange(len(errors), device=device)
    firsts = torch.as_tensor(np.repeat(ends[:-1], np.diff(ends)), device=device)
    of_tiles = words((tiles - firsts)[:, None], PURPOSE_TILES)  # of the numbers within the view
    chosen, numbers = [], []
    for first, end in itertools.pairwise(ends.tolist()):
        row = slice(first, end)
        wanted = rule.wanted(rate, end - first)
        numbers.append(wanted)
        exist = torch.ones(1, end - first, dtype=torch.bool, device=device)
        x0, x1, x2, x3 = (word[row].T for word in of_tiles)
        drawn, _ = draw_units(errors[None, row], ages[None, row], exist, (x0, x1, x2, x3), wanted, rule)
        # Their number is known here; a boolean index would wait for the device.
        tile_ids = torch.argsort(drawn[0].to(torch.int8), stable=True, descending=True)[:wanted]
        chosen.append(first + tile_ids)
    return torch.cat(chosen), numbers
