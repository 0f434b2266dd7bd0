"""A small capture to try things on: textured solids, photographed from an orbit and written as a COLMAP dataset.

The photos come from a ray caster below, several rays a pixel; the reconstruction holds the true cameras and surface
points that are seen in at least two photos, displaced by a little noise, with their tracks.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from turbogs_plugin.captures.colmap import write_whole
from turbogs_plugin.captures.undistort import load_pycolmap
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.geometry import look_at

Texture = Callable[[np.ndarray], np.ndarray]  # [R, 3] points in the solid's own coordinates -> [R, 3] colours
RAYS_PER_SIDE = 3  # each pixel is the mean of this many rays squared; odd, so that one goes through its centre
LIGHT = np.array([0.45, -0.25, 0.86], dtype=np.float32)
AMBIENT = 0.55
ORBIT_RADIUS, ORBIT_HEIGHT, ORBIT_SWING = 3.6, 1.9, 0.5
LOOK_AT = 0.25  # height of what the cameras look at, above the middle of the table
FOCAL = 1.15  # focal length in image widths: 47 degrees across
POINT_NOISE = 0.004  # standard deviation of the noise on the reconstruction's points; solids are about 1 across
POINTS_PER_VIEW = 150
PHOTO_NAME = "view_{:03d}.png"


@dataclass
class Solid:
    """A solid on the vertical axis of its own coordinates. In these, `intersect` gives distances [R] along rays from
    `origin` [3] in `directions` [R, 3], infinite where they miss it; `normal`, unit normals [R, 3] at points on it."""

    size: float | np.ndarray  # radius, or half of each side of a box [3]
    texture: Texture
    position: np.ndarray  # [3], of its origin in the world
    turn: float  # about the axis, radians

    @property
    def rotation(self) -> np.ndarray:
        """[3, 3] own to world."""
        cos, sin = np.cos(self.turn), np.sin(self.turn)
        return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]], dtype=np.float32)


class Sphere(Solid):
    def intersect(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        along = directions @ origin
        under_root = along**2 - (origin @ origin - self.size**2)
        with np.errstate(invalid="ignore"):
            return np.where(under_root > 0, -along - np.sqrt(under_root), np.inf)

    def normal(self, points: np.ndarray) -> np.ndarray:
        return points / self.size


class Box(Solid):
    def intersect(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore"):
            inverse = 1.0 / directions
        first, second = (-self.size - origin) * inverse, (self.size - origin) * inverse
        enter, leave = np.minimum(first, second).max(axis=1), np.maximum(first, second).min(axis=1)
        return np.where((enter < leave) & (enter > 0), enter, np.inf)

    def normal(self, points: np.ndarray) -> np.ndarray:
        relative = points / self.size
        return np.sign(relative) * (np.abs(relative) == np.abs(relative).max(axis=1, keepdims=True))


class Disc(Solid):
    def intersect(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        distances = -origin[2] / directions[:, 2]
        hits = origin + distances[:, None] * directions
        return np.where((distances > 0) & (hits[:, 0] ** 2 + hits[:, 1] ** 2 < self.size**2), distances, np.inf)

    def normal(self, points: np.ndarray) -> np.ndarray:
        return np.broadcast_to(np.array([0, 0, 1], dtype=np.float32), points.shape)


def checker(size: float, first: np.ndarray, second: np.ndarray) -> Texture:
    """Cubes of two colours in turn."""
    return lambda points: np.where((np.floor(points / size + 0.25).sum(axis=1) % 2 > 0.5)[:, None], first, second)


def noise(size: float, first: np.ndarray, second: np.ndarray, random: np.random.Generator) -> Texture:
    """A smooth random mix of two colours: the mean of plane waves of wavelengths about `size`."""
    waves = random.normal(size=(3, 12)).astype(np.float32) * (4.0 / size)
    phases = random.uniform(0, 2 * np.pi, 12).astype(np.float32)

    def colors(points: np.ndarray) -> np.ndarray:
        share = 0.5 + 0.5 * np.tanh(2.5 * np.sin(points @ waves + phases).mean(axis=1))
        return first + share[:, None] * (second - first)

    return colors


Solids = list[Sphere | Box | Disc]


def demo_solids(random: np.random.Generator) -> Solids:
    """Five solids on a round table; colours, textures and turns are drawn from `random`."""
    turn, vector = partial(random.uniform, 0, np.pi), partial(np.array, dtype=np.float32)

    def color() -> np.ndarray:
        return random.uniform(0.1, 0.95, 3).astype(np.float32)

    def mixed(size: float) -> Texture:
        return noise(size, color(), color(), random)

    return [
        Disc(1.7, mixed(0.8), vector([0, 0, 0]), turn()),
        Box(vector([0.35, 0.35, 0.45]), checker(0.23, color(), color()), vector([0.1, 0.0, 0.45]), turn()),
        Sphere(0.36, mixed(0.5), vector([-0.85, 0.35, 0.36]), turn()),
        Sphere(0.28, checker(0.2, color(), color()), vector([0.55, -0.85, 0.28]), turn()),
        Box(vector([0.4, 0.18, 0.15]), mixed(0.4), vector([-0.5, -0.75, 0.15]), turn()),
        Box(vector([0.15, 0.15, 0.3]), mixed(0.3), vector([0.8, 0.65, 0.3]), turn()),
    ]


def cast(solids: Solids, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[R, 3] colours and [R] distances of what rays see; black at infinity where they see nothing."""
    local = [(solid, (origin - solid.position) @ solid.rotation, directions @ solid.rotation) for solid in solids]
    hits = [solid.intersect(*rays) for solid, *rays in local]  # [S, R]
    nearest, owner = np.min(hits, axis=0).astype(np.float32), np.argmin(hits, axis=0)
    colors = np.zeros((len(directions), 3), dtype=np.float32)
    for number, solid in enumerate(solids):
        rays = np.flatnonzero((owner == number) & np.isfinite(nearest))
        points = (origin + nearest[rays, None] * directions[rays] - solid.position) @ solid.rotation
        light = np.maximum(solid.normal(points) @ solid.rotation.T @ LIGHT, 0.0)
        colors[rays] = solid.texture(points) * (AMBIENT + (1.0 - AMBIENT) * light)[:, None]
    return colors, nearest


def write_demo_capture(path: str | Path, seed: int = 0, views: int = 32, width: int = 160, height: int = 120) -> Path:
    """Write the demo capture to the new folder `path`: ``images/*.png`` and ``sparse/0``, the same for the same
    arguments. Raises `InputError`, and writes nothing, where `path` is there already or cannot be written, or fewer
    than 3 views or an image without area are asked for."""
    target = Path(path)
    if target.exists():
        raise InputError(f"{target} is there already: choose a new folder for the demo capture")
    if views < 3 or width < 1 or height < 1:
        raise InputError(f"the demo capture was asked for {views} views of {width}x{height}: at least 3 of 1x1 needed")
    load_pycolmap()  # where the package is absent, or another one, that is said first
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=".") as temporary:
        capture = Path(temporary) / "capture"
        for folder in ("images", "sparse/0"):
            (capture / folder).mkdir(parents=True)
        _photograph(capture, target, seed, views, width, height)
        capture.rename(target)
    return target


def _photograph(capture: Path, target: Path, seed: int, views: int, width: int, height: int) -> None:
    """Write the photos, from a ring about the table that swings in height; and what COLMAP would have made of them.
    `target` is the capture's folder for the user."""
    random, side, focal = np.random.default_rng(seed), RAYS_PER_SIDE, FOCAL * width
    poses, solids = np.empty((views, 3, 4)), demo_solids(random)
    x, y = np.meshgrid((np.arange(width * side) + 0.5) / side, (np.arange(height * side) + 0.5) / side)
    rays = np.stack([(x - width / 2) / focal, (y - height / 2) / focal, np.ones_like(x)], axis=-1)
    depths = np.empty((views, height, width), dtype=np.float32)  # of pixels' centres; infinite where there is nothing
    chosen_points, chosen_colors = [], []
    for view, pose in enumerate(poses):
        angle = 2 * np.pi * view / views
        ring = ORBIT_RADIUS * np.array([np.cos(angle), np.sin(angle)])
        at = np.array([*ring, ORBIT_HEIGHT + ORBIT_SWING * np.sin(3 * angle)])
        pose[:] = look_at(at, target=np.array([0.0, 0.0, LOOK_AT]), up=np.array([0.0, 0.0, 1.0]))[:3]
        origin = (-pose[:, :3].T @ pose[:, 3]).astype(np.float32)
        directions = (rays.reshape(-1, 3) @ pose[:, :3]).astype(np.float32)
        lengths = np.linalg.norm(directions, axis=1, keepdims=True)
        directions /= lengths
        seen, distances = cast(solids, origin, directions)
        pixels = seen.reshape(height, side, width, side, 3).mean(axis=(1, 3))
        Image.fromarray(np.round(pixels * 255).astype(np.uint8)).save(capture / "images" / PHOTO_NAME.format(view))
        centers = np.s_[side // 2 :: side, side // 2 :: side]
        depths[view] = (distances[:, None] / lengths).reshape(height * side, width * side)[centers]
        hits = np.flatnonzero(np.isfinite(distances))
        chosen = random.choice(hits, min(POINTS_PER_VIEW, len(hits)), replace=False)
        chosen_points.append(origin + distances[chosen, None] * directions[chosen])
        chosen_colors.append(seen[chosen])
    points, colors = np.concatenate(chosen_points), np.concatenate(chosen_colors)  # [M, 3] on surfaces

    local = np.einsum("vij,mj->vmi", poses[:, :, :3], points) + poses[:, None, :, 3]  # [V, M, 3]
    places = local[..., :2] / local[..., 2:] * focal + [width / 2, height / 2]  # [V, M, 2]
    columns, rows = np.floor(places).astype(int).transpose(2, 0, 1)
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    there = depths[np.arange(views)[:, None], rows.clip(0, height - 1), columns.clip(0, width - 1)]
    visible = inside & (np.abs(local[..., 2] - there) < 0.02 * there)  # [V, M]
    visible &= visible.sum(axis=0) >= 2
    numbers = np.cumsum(visible, axis=1) - 1  # [V, M] of a point among the points of its view

    pycolmap = load_pycolmap()
    reconstruction, params = pycolmap.Reconstruction(), [focal, focal, width / 2, height / 2]
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=width, height=height, params=params)
    reconstruction.add_camera_with_trivial_rig(camera)
    for view, pose in enumerate(poses):
        keypoints = places[view, visible[view]]
        image = pycolmap.Image(PHOTO_NAME.format(view), keypoints=keypoints, camera_id=1, image_id=view + 1)
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    displaced = points + random.normal(scale=POINT_NOISE, size=points.shape)
    for point in np.flatnonzero(visible.any(axis=0)):
        seen_by = np.flatnonzero(visible[:, point])
        track = pycolmap.Track([pycolmap.TrackElement(view + 1, numbers[view, point]) for view in seen_by])
        reconstruction.add_point3D(displaced[point], track, np.round(colors[point] * 255).astype(np.uint8))
    reconstruction.update_point_3d_errors()
    write_whole(reconstruction, capture / "sparse/0", target)
