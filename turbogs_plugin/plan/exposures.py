"""How much brighter or darker each photo is than the others: a gain a photo and channel, from what neighbours share.

Neighbours show the same surface points. Which of these points both photos really show (none of them is hidden) is told
by their surroundings, a patch of 5x5 pixels: its correlation with that of the other photo does not depend on gains. The
median ratio of the patches' mean colours is the ratio of two gains; the gains that fit all these ratios best, in the
sense of least absolute errors, are those of the photos. So differences are seen that build up from photo to photo, and
those between flight lines, although the nearest photo is always one of the same line.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from turbogs_plugin.plan.sight import Sight
from turbogs_plugin.scene import PosedImages
from turbogs_plugin.scene.sequence import PhotoOrder

NEIGHBOURS, CANDIDATES = 8, 24
"""A photo is compared with so many of the cameras nearest to it, of so many that are tried."""
RADIUS = 2
"""Of a patch, in steps."""
STEPS = 600
"""A patch's step is a pixel, or this part of the photo's longer side where that is more."""
LIKENESS = 0.85
"""Correlation of two patches' luminance from which on they show the same."""
FEWEST_MATCHES = 8
"""Patches in common from which on two photos are compared."""
TIMES_CHANCE = 3
"""Photos are compared if so many times more patches are alike than patches of different points."""
TEXTURE = 0.01
"""Standard deviation of luminance (0 .. 1) below which a patch looks like any other."""
DARKEST, BRIGHTEST = 0.02, 0.98
"""Mean colours of a patch, 0 .. 1: beyond, what a gain does to it is lost in steps of 255 or cut off."""
PATCHES_OF_A_PHOTO, PATCHES_AT_MOST = 400, 200_000
"""Patches examined, about: of a photo in the mean, and of all photos."""
LUMINANCE = np.array([0.299, 0.587, 0.114], dtype=np.float32)
ROUNDS, SMALLEST_RESIDUAL = 10, 0.01
"""Of reweighted least squares, and the residual in stops below which all pairs weigh the same."""
SOLVER_STEPS, SOLVED = 1000, 1e-6

Floats = NDArray[np.floating]
Integers = NDArray[np.integer]


@dataclass(frozen=True)
class Exposures:
    """Of V photos, in stops: factors of 2 of their values, which are gamma-coded as in the file.

    Args:
        gains: [V, 3] float64 of the channels; their mean over what is compared is 0.
        left: [V, 3] float64, the gains less what the photos before and after tell (`turbogs_plugin.scene.sequence`).
        compared: [V] bool, photos that share enough with another one; the others' gains are 0.
    """

    gains: Floats
    left: Floats
    compared: NDArray[np.bool_]

    @property
    def spread(self) -> float:
        """Standard deviation of the gains."""
        return _deviation(self.gains[self.compared])

    @property
    def rest(self) -> float:
        """Standard deviation of the gains from those of the photos before and after. A camera's automatic that follows
        the light leaves little; exposures at random leave more than there was."""
        return _deviation(self.left[self.compared])


@dataclass(frozen=True)
class _Patches:
    """Of one photo, those that can be compared.

    Args:
        points: [n] int64, ascending.
        shapes: [n, 25] float32 luminance, with mean 0 and norm 1.
        stops: [n, 3] float32, log2 of the mean colours.
    """

    points: Integers
    shapes: Floats
    stops: Floats


def compare_exposures(views: PosedImages, sight: Sight) -> Exposures:
    """The gains of photos whose points are in sight.

    Where the points are not those of surfaces (random ones, for want of better), hardly a patch has a match and hardly
    a photo is compared.
    """
    count = len(views)
    patches = _patches(views, sight)
    order = sight.distances.topk(min(CANDIDATES, count - 1), largest=False).indices.tolist() if count > 1 else [[]]
    ratios: dict[tuple[int, int], tuple[Floats, int]] = {}
    for view, nearest in enumerate(order):
        found = 0
        for other in nearest:
            pair = min(view, other), max(view, other)
            if pair not in ratios:
                ratios[pair] = _compare(patches[pair[0]], patches[pair[1]])
            found += ratios[pair][1] > 0
            if found == NEIGHBOURS:
                break
    kept = {pair: ratio for pair, (ratio, matches) in ratios.items() if matches}
    pairs = np.array(list(kept), dtype=np.int64).reshape(-1, 2)
    weights = np.sqrt(np.array([ratios[pair][1] for pair in kept], dtype=np.float64))
    gains = fit_gains(pairs, np.array(list(kept.values()), dtype=np.float64).reshape(-1, 3), weights, count)
    compared = np.bincount(pairs.reshape(-1), minlength=count) > 0  # [V]
    names = [name for name, told in zip(views.names, compared, strict=True) if told]
    left = gains.copy()
    near = PhotoOrder(views.names).neighbours(names, names)
    left[compared] -= near.mean(torch.from_numpy(gains[compared])).numpy()
    return Exposures(gains, left, compared)


def fit_gains(pairs: Integers, ratios: Floats, weights: Floats, count: int) -> Floats:
    """[V, 3] gains g with the least sum of ``weight * |g[first] - g[second] - ratio|``, about.

    Their mean is 0 in every part of the photos that pairs connect.

    Args:
        pairs: [E, 2] int64.
        ratios: [E, 3], in stops.
        weights: [E] > 0.
        count: V.
    """
    gains = np.zeros((count, 3))
    for _ in range(ROUNDS if len(pairs) else 0):
        residuals = gains[pairs[:, 0]] - gains[pairs[:, 1]] - ratios
        present = weights / np.maximum(SMALLEST_RESIDUAL, np.linalg.norm(residuals, axis=1))
        gains = _least_squares(pairs, ratios, present, count)
    return gains


def _least_squares(pairs: Integers, ratios: Floats, weights: Floats, count: int) -> Floats:
    """[V, 3] of the normal equations, a graph's Laplacian, by conjugate gradients: from 0 on, means stay 0."""

    def towards(differences: Floats) -> Floats:
        weighted = weights[:, None] * differences
        return _summed(pairs, np.stack([weighted, -weighted], axis=1), count)

    solution = np.zeros((count, 3))
    residual = towards(ratios)
    direction, size = residual, (residual**2).sum(axis=0)  # [V, 3], [3]
    enough = SOLVED**2 * ((weights[:, None] * ratios) ** 2).sum(axis=0)
    for _ in range(SOLVER_STEPS):
        active = size > enough  # a channel that is solved stays as it is
        if not active.any():
            break
        image = towards(direction[pairs[:, 0]] - direction[pairs[:, 1]])
        step = np.divide(size, (direction * image).sum(axis=0), out=np.zeros(3), where=active)
        solution, residual = solution + step * direction, residual - step * image
        before, size = size, (residual**2).sum(axis=0)
        direction = residual + np.divide(size, before, out=np.zeros(3), where=active) * direction
    return solution


def _summed(pairs: Integers, values: Floats, count: int) -> Floats:
    """[V, 3] sums of [E, 2, 3] values over the places that [E, 2] pairs name."""
    flat, rows = pairs.reshape(-1), values.reshape(-1, 3)
    return np.stack([np.bincount(flat, rows[:, channel], minlength=count) for channel in range(3)], axis=1)


def _compare(first: _Patches, second: _Patches) -> tuple[Floats, int]:
    """[3] the median of first over second, in stops, and of how many patches that is; 0 where it is too few."""
    _, here, there = np.intersect1d(first.points, second.points, assume_unique=True, return_indices=True)
    ours, others = first.shapes[here], second.shapes[there]
    alike = _alike(ours, others)
    by_chance = _alike(ours, np.roll(others, len(others) // 2, axis=0))  # of different points
    if alike.sum() < max(FEWEST_MATCHES, TIMES_CHANCE * by_chance.sum()):
        return np.zeros(3), 0
    return np.median(first.stops[here[alike]] - second.stops[there[alike]], axis=0), int(alike.sum())


def _alike(first: Floats, second: Floats) -> NDArray[np.bool_]:
    """[n] of [n, 25] shapes."""
    return (first * second).sum(axis=1) >= LIKENESS


def _patches(views: PosedImages, sight: Sight) -> list[_Patches]:
    in_sight = int(sight.inside.sum())
    every = -(-in_sight // min(PATCHES_AT_MOST, PATCHES_OF_A_PHOTO * len(views))) or 1
    axes = _axes_in_photos(views)
    stored, offsets = views.photos.stored, views.photos.offsets
    grid = np.stack(np.meshgrid(*[np.arange(-RADIUS, RADIUS + 1)] * 2), axis=-1).reshape(-1, 2)  # [25, 2]
    patches = []
    for view, (width, height) in enumerate(views.photos.sizes.tolist()):
        points = every * torch.nonzero(sight.inside[view, ::every])[:, 0]
        flat = (sight.flat[view, points] - int(offsets[view])).numpy()
        (x, y), step = axes[view], max(1.0, max(width, height) / STEPS)
        turned = np.rint(step * grid @ np.array([[x, y], [-y, x]])).astype(np.int64)  # [25, 2]
        places = np.stack([flat % width, flat // width], axis=1)[:, None] + turned  # [n, 25, 2]
        whole = ((places >= 0) & (places < (width, height))).all(axis=(1, 2))
        pixels = torch.from_numpy(int(offsets[view]) + places[whole] @ np.array([1, width]))
        colors = stored[pixels.to(stored.device)][..., :3].cpu().numpy() / np.float32(255.0)  # [n, 25, 3]
        patches.append(_comparable(points.numpy()[whole], colors))
    return patches


def _comparable(points: Integers, colors: Floats) -> _Patches:
    """Of patches [n, 25, 3] those that have texture, and in each channel room for a gain."""
    means, luminance = colors.mean(axis=1), colors @ LUMINANCE
    shapes = luminance - luminance.mean(axis=1, keepdims=True)
    deviations = np.sqrt((shapes**2).mean(axis=1))
    usable = (deviations >= TEXTURE) & ((means > DARKEST) & (means < BRIGHTEST)).all(axis=1)
    shapes = shapes[usable] / (deviations[usable, None] * np.sqrt(shapes.shape[1]))
    return _Patches(points[usable], shapes, np.log2(means[usable]))


def _axes_in_photos(views: PosedImages) -> Floats:
    """[V, 2] a direction of the world as unit vectors in the photos, so that patches of photos that are turned against
    each other (a flight there and back) are turned alike: the direction that the cameras look along least."""
    cameras = views.cameras.to("cpu", torch.float64)
    directions: Tensor = cameras.directions
    axis = torch.linalg.eigh(directions.T @ directions).eigenvectors[:, 0]
    seen = (cameras.viewmats[:, :2, :3] @ axis).numpy()  # [V, 2]
    lengths = np.linalg.norm(seen, axis=1, keepdims=True)
    return np.where(lengths > 1e-6, seen / np.maximum(lengths, 1e-6), [1.0, 0.0])


def _deviation(values: Floats) -> float:
    """Root of the mean square of [n, 3], 0 where there is none."""
    return float(np.sqrt((values**2).mean())) if len(values) else 0.0
