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
from turbogs_plugin.scene.sequence import neighbours

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
    """Patches of one photo that can be compared."""

    points: Integers
    """[n] int64, ascending."""
    shapes: Floats
    """[n, 25] float32 luminance, with mean 0 and norm 1."""
    stops: Floats
    """[n, 3] float32, log2 of the mean colours."""


def compare_exposures(views: PosedImages, points: Tensor) -> PhotoGains:
    """The gains of photos, by the surface points [M, 3] that they share, in the views' frame. Where the points are not
    on surfaces (random ones, for want of better), hardly a patch has a match and hardly a photo is compared."""
    count = len(views)
    cameras = views.cameras.to("cpu", torch.float64)
    patches = _patches(views, points)
    distances = torch.cdist(cameras.centers, cameras.centers, compute_mode="donot_use_mm_for_euclid_dist")
    distances.fill_diagonal_(torch.inf)
    order = distances.topk(min(CANDIDATES, count - 1), largest=False).indices.tolist() if count > 1 else [[]]
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
    kept = [(pair, ratio, matches) for pair, (ratio, matches) in ratios.items() if matches]
    pairs = np.array([pair for pair, _, _ in kept], dtype=np.int64).reshape(-1, 2)
    told = np.array([ratio for _, ratio, _ in kept], dtype=np.float64).reshape(-1, 3)
    gains = fit_gains(pairs, told, np.sqrt([float(matches) for _, _, matches in kept]), count)
    compared = np.bincount(pairs.reshape(-1), minlength=count) > 0  # [V]
    names = [views.names[view] for view in np.flatnonzero(compared)]
    among, near = gains[compared], neighbours(views.names, names, names)
    rest = among - near.mean(torch.from_numpy(among)).numpy()
    return PhotoGains(gains, compared, _deviation(among), _deviation(rest))


def fit_gains(pairs: Integers, ratios: Floats, weights: Floats, count: int) -> Floats:
    """[V, 3] gains g with the least sum of ``weight * |g[first] - g[second] - ratio|``, about, over pairs [E, 2] with
    ratios [E, 3], in stops, and weights [E] > 0. Their mean is 0 in every part of the V photos that pairs connect."""
    from scipy.sparse import csr_matrix, diags
    from scipy.sparse.linalg import lsqr

    signs, rows = np.tile([1.0, -1.0], len(pairs)), np.repeat(np.arange(len(pairs)), 2)
    differences = csr_matrix((signs, (rows, pairs.reshape(-1))), shape=(len(pairs), count))
    gains: Floats = np.zeros((count, 3))
    for _ in range(ROUNDS if len(pairs) else 0):
        residuals = np.linalg.norm(differences @ gains - ratios, axis=1)
        roots = np.sqrt(weights / np.maximum(SMALLEST_RESIDUAL, residuals))  # [E]
        weighted = diags(roots) @ differences
        # Of all solutions the smallest, whose means are 0.
        gains = np.stack([lsqr(weighted, roots * ratios[:, channel])[0] for channel in range(3)], axis=1)
    return gains


def _compare(first: _Patches, second: _Patches) -> tuple[Floats, int]:
    """[3] median of first over second, in stops, and the number of patches behind it; 0 where these are too few."""
    _, here, there = np.intersect1d(first.points, second.points, assume_unique=True, return_indices=True)
    ours, others = first.shapes[here], second.shapes[there]  # [n, 25]
    others_of = np.roll(others, len(others) // 2, axis=0)  # of different points
    alike, by_chance = ((ours * each).sum(axis=1) >= LIKENESS for each in (others, others_of))  # [n]
    if alike.sum() < max(FEWEST_MATCHES, TIMES_CHANCE * by_chance.sum()):
        return np.zeros(3), 0
    return np.median(first.stops[here[alike]] - second.stops[there[alike]], axis=0), int(alike.sum())


def _sight(views: PosedImages, points: Tensor) -> tuple[Tensor, Tensor]:
    """[V, Q] bool, which of some of the points are in front of each camera, within its photo and not masked; and
    [V, Q] int64, their flat pixels, 0 where they are not inside."""
    cameras = views.cameras.to("cpu", torch.float64)
    chosen = points[:: max(1, -(-len(points) // POINTS_AT_MOST))].cpu().double()  # [Q, 3]
    seen = chosen @ cameras.viewmats[:, :3, :3].transpose(1, 2) + cameras.viewmats[:, None, :3, 3]  # [V, Q, 3]
    depths = seen[..., 2]
    pixels = (seen @ cameras.Ks.transpose(1, 2))[..., :2] / depths.clamp(min=1e-9)[..., None]
    sizes = torch.from_numpy(cameras.sizes)[:, None]  # [V, 1, 2]
    inside = (depths > 1e-9) & (pixels >= 0).all(dim=-1) & (pixels < sizes).all(dim=-1)
    x, y = torch.where(inside[..., None], pixels, 0.0).long().unbind(dim=-1)
    if views.masks is not None:
        inside &= torch.stack([views.masks.image(view)[y[view], x[view]] for view in range(len(views))])
    flat = torch.from_numpy(views.photos.offsets[:-1])[:, None] + y * sizes[..., 0] + x
    return inside, torch.where(inside, flat, 0)


def _patches(views: PosedImages, points: Tensor) -> list[_Patches]:
    inside, flats = _sight(views, points)
    every = -(-int(inside.sum()) // min(PATCHES_AT_MOST, PATCHES_OF_A_PHOTO * len(views))) or 1
    axes = _axes_in_photos(views)
    stored, offsets = views.photos.stored, views.photos.offsets
    grid = np.stack(np.meshgrid(*[np.arange(-RADIUS, RADIUS + 1)] * 2), axis=-1).reshape(-1, 2)  # [25, 2]
    patches = []
    for view, (width, height) in enumerate(views.photos.sizes.tolist()):
        shown = every * torch.nonzero(inside[view, ::every])[:, 0]
        flat = (flats[view, shown] - int(offsets[view])).numpy()
        (x, y), step = axes[view], max(1.0, max(width, height) / STEPS)
        turned = np.rint(step * grid @ np.array([[x, y], [-y, x]])).astype(np.int64)  # [25, 2]
        places = np.stack([flat % width, flat // width], axis=1)[:, None] + turned  # [n, 25, 2]
        whole = ((places >= 0) & (places < (width, height))).all(axis=(1, 2))
        pixels = torch.from_numpy(int(offsets[view]) + places[whole] @ np.array([1, width]))
        colors = stored.index_select(0, pixels.flatten().to(stored.device)).view(*pixels.shape, stored.shape[1])
        patches.append(_comparable(shown.numpy()[whole], colors[..., :3].cpu().numpy() / np.float32(255.0)))
    return patches


def _comparable(points: Integers, colors: Floats) -> _Patches:
    """The patches, of [n, 25, 3], that have texture, and in each channel room for a gain."""
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
