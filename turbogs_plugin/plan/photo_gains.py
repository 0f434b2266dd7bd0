"""How much brighter or darker each photo is than the others: a gain a photo and channel, from what neighbours share.

Neighbours show the same surface points. Whether both photos really show a point (it is hidden in neither) is told by
its surroundings, a patch of 5x5 pixels: its correlation with the other photo's patch does not depend on gains. The
median ratio of the patches' mean colours is the ratio of two gains; the photos' gains are those that fit all ratios
best, in the sense of least absolute errors. So differences show that build up from photo to photo, and between flight
lines, although the nearest photo is always one of the same line.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from turbogs_plugin.scene import PosedImages
from turbogs_plugin.scene.geometry import seen
from turbogs_plugin.scene.sequence import neighbours
from turbogs_plugin.types import Cameras

POINTS_AT_MOST = 2000
"""3D points examined."""
NEIGHBOURS, CANDIDATES = 8, 24
"""Cameras that a photo is compared with, and nearest cameras among which they are sought."""
RADIUS, STEPS = 2, 600
"""Radius of a patch in steps: a step is a pixel, or this part of the photo's longer side where that is more."""
LIKENESS = 0.85
"""Correlation of two patches' luminance from which on they show the same."""
FEWEST_MATCHES, TIMES_CHANCE = 8, 3
"""Like patches from which on two photos are compared, and the factor by which they outnumber like patches of different
points."""
TEXTURE = 0.01
"""Standard deviation of luminance (0 .. 1) below which a patch looks like any other."""
DARKEST, BRIGHTEST = 0.02, 0.98
"""Mean colours of a patch, 0 .. 1: beyond, what a gain does to it is lost in steps of 255 or cut off."""
PATCHES_OF_A_PHOTO, PATCHES_AT_MOST = 400, 200_000
"""Patches examined, about: of a photo in the mean, and of all photos."""
BLOCK = 4096
"""Patches cut at a time, which a processor's cache has room for."""
LUMINANCE = np.array([0.299, 0.587, 0.114], dtype=np.float32)
ROUNDS, SMALLEST_RESIDUAL = 10, 0.01
"""Rounds of reweighted least squares, and the residual in stops below which all pairs weigh the same."""

Floats = NDArray[np.floating]
Integers = NDArray[np.integer]


@dataclass(frozen=True, eq=False)
class PhotoGains:
    """Gains of V photos, in stops: factors of 2 of their values, which are gamma-coded as in the file.

    Args:
        gains: [V, 3] float64 of the channels; their mean over what is compared is 0.
        compared: [V] bool, photos that share enough with another one; the others' gains are 0.
        spread: standard deviation of the gains of what is compared.
        rest: standard deviation of these from the gains of the photos before and after (`scene.sequence`). A camera's
            automatic that follows the light leaves little; exposures at random leave more than there was.
    """

    gains: Floats
    compared: NDArray[np.bool_]
    spread: float
    rest: float


class _Patches(NamedTuple):
    """Patches that can be compared, of all photos."""

    rows: Integers
    """[V, Q] int64, the patch of each point in each photo, -1 where there is none."""
    shapes: Floats
    """[n, 25] float32 luminance, with mean 0 and norm 1."""
    stops: Floats
    """[n, 3] float32, log2 of the mean colours."""


def compare_exposures(views: PosedImages, points: Tensor) -> PhotoGains:
    """The gains of photos, by the surface points [M, 3] that they share, in the views' frame. Where the points are not
    on surfaces (random ones, for want of better), hardly a patch has a match and hardly a photo is compared."""
    count = len(views)
    cameras = views.cameras.to("cpu", torch.float64)
    patches = _patches(views, cameras, points)
    distances = torch.cdist(cameras.centers, cameras.centers, compute_mode="donot_use_mm_for_euclid_dist")
    distances.fill_diagonal_(torch.inf)
    nearest = distances.topk(min(CANDIDATES, count - 1), largest=False).indices.numpy()  # [V, CANDIDATES]
    matches = np.full(count * count, -1)  # behind the ratio of the pair V * first + second; -1: not looked at
    found = np.zeros(count, dtype=np.int64)
    parts: list[tuple[Integers, Floats]] = [(found[:0], np.zeros((0, 3)))]
    for others in nearest.T:
        seeking = np.flatnonzero(found < NEIGHBOURS)
        ends = seeking, others[seeking]
        pairs = count * np.minimum(*ends) + np.maximum(*ends)
        new = np.unique(pairs[matches[pairs] < 0])
        ratios, matches[new] = _compare(patches, *np.divmod(new, count))
        parts.append((new, ratios))
        found[seeking] += matches[pairs] > 0
    looked_at, ratios = (np.concatenate(part) for part in zip(*parts, strict=True))
    kept = matches[looked_at] > 0
    pairs = np.stack(np.divmod(looked_at[kept], count), axis=1)  # [E, 2]
    gains = fit_gains(pairs, ratios[kept], np.sqrt(matches[looked_at[kept]]), count)
    compared = np.bincount(pairs.reshape(-1), minlength=count) > 0  # [V]
    names = [views.names[view] for view in np.flatnonzero(compared)]
    among, near = gains[compared], neighbours(views.names, names, names)
    rest = among - near.mean(torch.from_numpy(among)).numpy()
    return PhotoGains(gains, compared, _deviation(among), _deviation(rest))


def fit_gains(pairs: Integers, ratios: Floats, weights: Floats, count: int) -> Floats:
    """[V, 3] gains g with the least sum of ``weight * |g[first] - g[second] - ratio|``, about, over pairs [E, 2] with
    ratios [E, 3], in stops, and weights [E] > 0. Their mean is 0 in every part of the V photos that pairs connect."""
    from scipy.sparse import csc_matrix, diags
    from scipy.sparse.csgraph import connected_components
    from scipy.sparse.linalg import splu

    signs, rows = np.tile([1.0, -1.0], len(pairs)), np.repeat(np.arange(len(pairs)), 2)
    differences = csc_matrix((signs, (rows, pairs.reshape(-1))), shape=(len(pairs), count))
    _, parts = connected_components(differences.T @ differences, directed=False)
    # The first photo of each part has the gain 0 until the mean has: else the equations leave a constant open.
    first = diags(1.0 * np.bincount(np.unique(parts, return_index=True)[1], minlength=count))
    gains: Floats = np.zeros((count, 3))
    for _ in range(ROUNDS if len(pairs) else 0):
        residuals = np.linalg.norm(differences @ gains - ratios, axis=1)
        weighted = differences.T @ diags(weights / np.maximum(SMALLEST_RESIDUAL, residuals))
        gains = splu((weighted @ differences + first).tocsc()).solve(weighted @ ratios)
    return gains - np.stack([(np.bincount(parts, each) / np.bincount(parts))[parts] for each in gains.T], axis=1)


def _compare(patches: _Patches, first: Integers, second: Integers) -> tuple[Floats, Integers]:
    """Of pairs of photos, [E] each: [E, 3] medians of first over second, in stops, and [E] the numbers of patches
    behind them; 0 where these are too few."""
    rows, count = (patches.rows[first], patches.rows[second]), len(first)  # [E, Q]
    places = np.nonzero((rows[0] >= 0) & (rows[1] >= 0))  # [n], of each point that both photos show
    pair, here, there = places[0], rows[0][places], rows[1][places]
    shared = np.bincount(pair, minlength=count)
    starts = (np.cumsum(shared) - shared)[pair]
    # Beside each patch, one of another point: half of the pair's points further, round to its first.
    other = there[starts + (np.arange(len(pair)) - starts - shared[pair] // 2) % shared[pair]]
    ours, theirs, others = (patches.shapes.take(each, axis=0) for each in (here, there, other))  # [n, 25]
    alike, by_chance = (np.einsum("np,np->n", ours, each) >= LIKENESS for each in (theirs, others))  # [n]
    matches, chance = (np.bincount(pair[each], minlength=count) for each in (alike, by_chance))
    matches[matches < np.maximum(FEWEST_MATCHES, TIMES_CHANCE * chance)] = 0
    kept = alike & (matches[pair] > 0)
    told = patches.stops[here[kept]] - patches.stops[there[kept]]
    return _medians(told, pair[kept], matches), matches


def _medians(values: Floats, groups: Integers, sizes: Integers) -> Floats:
    """[E, 3] medians of the columns of [n, 3] in each of E groups, 0 in an empty one. `groups`: [n], ascending;
    `sizes`: [E]."""
    ordered = np.stack([column[np.lexsort((column, groups))] for column in values.T], axis=1)
    medians, filled, starts = np.zeros((len(sizes), 3)), sizes > 0, np.cumsum(sizes) - sizes
    lower, upper = ((starts + (sizes - odd) // 2)[filled] for odd in (1, 0))
    medians[filled] = 0.5 * (ordered[lower] + ordered[upper])
    return medians


def _patches(views: PosedImages, cameras: Cameras, points: Tensor) -> _Patches:
    """Patches about some of the points, in each photo that shows one, turned as `_axes_in_photos` has it."""
    inside, x, y = _sight(views, cameras, points)
    (widths, heights), steps = cameras.sizes.T[:, :, None], np.maximum(1.0, cameras.sizes.max(axis=1) / STEPS)
    grid = np.stack(np.meshgrid(*[np.arange(-RADIUS, RADIUS + 1)] * 2), axis=-1).reshape(-1, 2)  # [25, 2]
    right, down = _axes_in_photos(cameras).T
    turns = np.array([[right, down], [-down, right]]).transpose(2, 0, 1)  # [V, 2, 2]
    across, along = np.rint(steps[:, None, None] * grid @ turns).astype(np.int64).transpose(2, 0, 1)  # [V, 25] each
    for place, moves, ends in ((x, across, widths), (y, along, heights)):  # whole patches alone
        inside &= (place >= -moves.min(axis=1, keepdims=True)) & (place < ends - moves.max(axis=1, keepdims=True))
    view, point = np.nonzero(inside)  # [n]
    middles, around = views.photos.offsets[view] + (y * widths + x)[inside], along * widths + across
    stored, rows = views.photos.stored.cpu().numpy(), np.full(inside.shape, -1)
    blocks = (slice(start, start + BLOCK) for start in range(0, max(1, len(view)), BLOCK))
    cut = (stored.take(middles[block, None] + around[view[block]], axis=0) for block in blocks)  # [b, 25, 3 or 4] each
    parts = [_comparable(colors[..., :3] / np.float32(255.0)) for colors in cut]
    usable, shapes, stops = (np.concatenate(part) for part in zip(*parts, strict=True))
    rows[view[usable], point[usable]] = np.arange(len(shapes))
    return _Patches(rows, shapes, stops)


def _sight(views: PosedImages, cameras: Cameras, points: Tensor) -> tuple[NDArray[np.bool_], Integers, Integers]:
    """Which of some points each photo shows, and their pixels, x and y: [V, Q] each."""
    chosen = points[:: max(1, -(-len(points) // POINTS_AT_MOST))].cpu().double().numpy()  # [Q, 3]
    inside = np.zeros((len(views), len(chosen)), dtype=bool)
    x, y = np.zeros((2, *inside.shape), dtype=np.int64)
    for view, camera in enumerate(zip(cameras.viewmats.numpy(), cameras.Ks.numpy(), cameras.sizes, strict=True)):
        rows, pixels, _ = seen(chosen, *camera)
        x[view, rows], y[view, rows] = columns, lines = pixels.astype(np.int64).T
        inside[view, rows] = True if views.masks is None else views.masks.image(view)[lines, columns].numpy()
    every = -(-int(inside.sum()) // min(PATCHES_AT_MOST, PATCHES_OF_A_PHOTO * len(views))) or 1
    return inside[:, ::every], x[:, ::every], y[:, ::every]


def _comparable(colors: Floats) -> tuple[NDArray[np.bool_], Floats, Floats]:
    """Which of patches [n, 25, 3] have texture, and in each channel room for a gain; shapes and stops of these."""
    means, luminance = np.einsum("npc->nc", colors) / colors.shape[1], colors @ LUMINANCE
    shapes = luminance - luminance.mean(axis=1, keepdims=True)
    deviations = np.sqrt(np.einsum("np,np->n", shapes, shapes) / shapes.shape[1])
    usable = (deviations >= TEXTURE) & ((means > DARKEST) & (means < BRIGHTEST)).all(axis=1)
    shapes = shapes[usable] / (deviations[usable, None] * np.sqrt(shapes.shape[1]))
    return usable, shapes, np.log2(means[usable])


def _axes_in_photos(cameras: Cameras) -> Floats:
    """[V, 2] a direction of the world as unit vectors in the photos, so that patches of photos that are turned against
    each other (a flight there and back) are turned alike: the direction that the cameras look along least."""
    directions: Tensor = cameras.directions
    axis = torch.linalg.eigh(directions.T @ directions).eigenvectors[:, 0]
    seen = (cameras.viewmats[:, :2, :3] @ axis).numpy()  # [V, 2]
    lengths = np.linalg.norm(seen, axis=1, keepdims=True)
    return np.where(lengths > 1e-6, seen / np.maximum(lengths, 1e-6), [1.0, 0.0])


def _deviation(values: Floats) -> float:
    """Root of the mean square of [n, 3], 0 where there is none."""
    return float(np.sqrt((values**2).mean())) if len(values) else 0.0
