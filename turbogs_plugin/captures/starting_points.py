"""Points to start from: of a cloud in a .ply, or random ones in colours from the photos."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.errors import InputError
from turbogs_plugin.masks import PixelMasks
from turbogs_plugin.scene.geometry import camera_centers, evenly, mean_neighbor_distances, seen
from turbogs_plugin.scene.photos import Photos, pixel_offsets
from turbogs_plugin.scene.ply import read_colors, read_vertices
from turbogs_plugin.types import Cameras
from turbogs_plugin.types.gaussians import SH_C0

NUM_RANDOM_POINTS = 50_000
GREY = 128  # colour of points without one
MODEL_PROPERTIES = {"opacity", "f_dc_0", "scale_0", "rot_0", "packed_position"}
"""Properties of a .ply of which a model has at least one, and a cloud of points none."""
LOOKING = 0.9  # share of the views that must have one point in their images to be taken for views of one thing
LEAST_SPACING = 1e-2  # cameras nearer to each other than this share of their extent are taken to be in one place
COLOR_VIEWS = 32  # photos that give random points their colours, at most


def read_cloud(path: Path) -> tuple[np.ndarray, np.ndarray, str]:
    """[M, 3] float64 and [M, 3] uint8 of a cloud in a .ply, and words on it where it has no colours and is grey. A 3DGS
    model's colours are its harmonics of degree 0."""
    vertices = {name.lower().removeprefix("diffuse_"): column for name, column in read_vertices(path).items()}
    points = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
    for channel, share in (("red", "f_dc_0"), ("green", "f_dc_1"), ("blue", "f_dc_2")):
        if channel[0] in vertices:
            vertices.setdefault(channel, vertices[channel[0]])
        elif share in vertices:
            vertices.setdefault(channel, (0.5 + SH_C0 * vertices[share].astype(np.float64)).clip(0.0, 1.0))
    if (colors := read_colors(path, vertices)) is None:
        return points, np.full(points.shape, GREY, np.uint8), ", grey as it has no colours"
    return points, colors, ""


def plain_cloud(file: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Finite points of a .ply, [M, 3] float64 and [M, 3] uint8; None where it is a model's, or no .ply."""
    if Path(file).suffix.lower() != ".ply" or not MODEL_PROPERTIES.isdisjoint(read_vertices(file)):
        return None
    points, colors, _ = read_cloud(Path(file))
    finite = np.isfinite(points).all(axis=1)
    if not finite.any():
        raise InputError(f"{file} has no finite point: export it again")
    return points[finite], colors[finite]


def clouds_beside(folders: Sequence[Path], used: Path | None, remedy: str) -> list[str]:
    """A line on clouds in some folders that are not used; none where there is none. `remedy`: how they would be."""
    files = [file.name for folder in folders for file in sorted(folder.glob("*.[pP][lL][yY]")) if file != used]
    return [f"{', '.join(files[:3])} not used: {remedy}"] if files else []


def starting_points(viewmats: np.ndarray, Ks: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, str]:
    """[`NUM_RANDOM_POINTS`, 3] float64 for a capture without any, the same for the same cameras: world to camera
    [V, 4, 4], intrinsics [V, 3, 3] (float64), sizes [V, 2] (width, height). And words that go on from "random points".

    Where cameras look at one thing (`LOOKING`), points fill a cube about the point nearest to all viewing axes, whose
    side is the median distance of the cameras from it. Elsewhere they are drawn within the views, by `_depth_bounds`.
    """
    centers, axes = camera_centers(viewmats), viewmats[:, 2, :3]
    mean = centers.mean(axis=0)
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # [V, 3, 3]
    pull = 1e-3 * len(centers) * np.eye(3)  # a slight one towards the mean settles the case of parallel axes
    offsets = np.einsum("vij,vj->i", across, centers - mean)
    focus = mean + np.linalg.solve(across.sum(axis=0) + pull, offsets)
    looking = [len(seen(focus[None], *camera)[0]) for camera in zip(viewmats, Ks, sizes, strict=True)]
    if np.mean(looking) < LOOKING:
        points = _in_views(viewmats, Ks, sizes, *_depth_bounds(centers))
        return points, "before the cameras, which do not look at one thing"
    side = float(np.median(np.linalg.norm(centers - focus, axis=1))) or 1.0
    within = np.random.default_rng(0).uniform(-0.5, 0.5, (NUM_RANDOM_POINTS, 3))
    return focus + within * side, "about what the cameras look at"


def _depth_bounds(centers: np.ndarray) -> tuple[float, float]:
    """Nearest and farthest depth that cameras at `centers` [V, 3] can tell from others, as a guess: the geometric mean
    of extent (the median distance from the mean) and spacing, at most half the extent; and ten times the extent."""
    mean = centers[0] + (centers - centers[0]).mean(axis=0)
    extent = float(np.median(np.linalg.norm(centers - mean, axis=1)))
    if extent <= 1e-12 * np.abs(centers).max():  # all in one place but for rounding
        return 0.5, 10.0
    # Cameras of a rig stand in one place: the spacing is between places.
    rounded = np.round(((centers - mean) / (LEAST_SPACING * extent)).clip(-1e15, 1e15))
    places = torch.from_numpy(np.unique(rounded, axis=0))
    spacing = float(mean_neighbor_distances(places, 1).median()) * LEAST_SPACING if len(places) > 1 else 1.0
    return extent * min(0.5, spacing**0.5), extent * 10.0


def _in_views(viewmats: np.ndarray, Ks: np.ndarray, sizes: np.ndarray, near: float, far: float) -> np.ndarray:
    """[`NUM_RANDOM_POINTS`, 3] float64: a view and a place in it are drawn evenly, and the inverse of the depth between
    `near` and `far`, so that points lie as densely in the image as in depth, as far as parallax tells depths apart."""
    random, count = np.random.default_rng(0), NUM_RANDOM_POINTS
    views = random.integers(0, len(viewmats), count)
    pixels = random.uniform(size=(count, 2)) * sizes[views]
    shares = random.uniform(size=count)
    depths = 1.0 / (1.0 / far + shares * (1.0 / near - 1.0 / far))
    rays = (pixels - Ks[views, :2, 2]) / Ks[views][:, [0, 1], [0, 1]]  # [M, 2]
    in_camera = depths[:, None] * np.column_stack([rays, np.ones(len(rays))])
    return np.einsum("mji,mj->mi", viewmats[views, :3, :3], in_camera - viewmats[views, :3, 3])


def colors_in_photos(points: Tensor, cameras: Cameras, photos: Photos, masks: PixelMasks | None = None) -> Tensor:
    """[M, 3] uint8: for each point [M, 3] float32 the mean colour of the pixels at which at most `COLOR_VIEWS` photos,
    evenly spread, see it, hidden or not.

    Masked pixels (`masks`, on the CPU) do not count, and transparent ones by their alpha. Points that none sees get the
    mean of the others; grey where there is none.
    """
    places, viewmats, Ks = (tensor.cpu().float().numpy() for tensor in (points, cameras.viewmats, cameras.Ks))
    sums, counts = torch.zeros(len(points), 3), torch.zeros(len(points), 1)
    for view in evenly(len(photos), COLOR_VIEWS):
        rows, inside, _ = map(torch.from_numpy, seen(places, viewmats[view], Ks[view], photos.sizes[view]))
        pixels = inside.long() @ torch.tensor([1, photos.sizes[view, 0]])
        start = int(pixel_offsets(photos.sizes)[view])
        colors = photos.stored[(start + pixels).to(photos.stored.device)].cpu().float()
        if not photos.transparent:
            colors = torch.nn.functional.pad(colors, (0, 1), value=255.0)
        if masks is not None:
            colors *= masks.image(view).reshape(-1)[pixels, None]
        sums.index_add_(0, rows, colors[:, :3])  # which are multiplied by alpha already
        counts.index_add_(0, rows, colors[:, 3:] / 255.0)
    others = sums.sum(dim=0) / counts.sum() if counts.any() else torch.full((3,), float(GREY))
    return torch.where(counts > 0, sums / counts.clamp(min=1e-9), others).round().to(torch.uint8)
