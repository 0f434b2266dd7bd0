"""A made-up capture of any number of small photos, to try what many of them take: a flight over textured ground.

    python examples/many_photos.py FLIGHT --photos 3000
    turbogs train FLIGHT --out RUN --max-memory 8GiB

It writes ``images/*.jpg`` and a COLMAP model by pycolmap. The photos are bilinear samples of a random texture on the
plane z = 0, taken from flight lines there and back, slightly tilted.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image

HEIGHT, SPACING, TILT = 1.0, 0.25, 0.15
"""Of the flight above the ground; between photos and lines; and the random turn of a camera in radians."""
FOCAL = 1.2
"""In widths of a photo."""
CELLS = 64
"""Of the texture, in a unit of length."""
POINTS_OF_A_PHOTO, TRACK = 10, 4
"""3D points for each photo, and the most photos that see one of them."""


def flight(photos: int, random: np.random.Generator) -> np.ndarray:
    """[V, 3, 4] float64 world to camera (x right, y down, z forward), in lines of about as many photos as lines."""
    lines = max(1, round(photos**0.5))
    line, place = np.divmod(np.arange(photos), -(-photos // lines))
    back = line % 2 == 1
    centers = np.stack([place, line, np.zeros(photos)], axis=1) * SPACING + [0.0, 0.0, HEIGHT]
    down = np.diag([1.0, -1.0, -1.0])  # x is the world's x, y its -y, and the camera looks along -z
    poses = np.empty((photos, 3, 4))
    for view, angles in enumerate(random.normal(0.0, TILT, (photos, 3))):
        turn = pycolmap.Rotation3d(angles).matrix() @ np.diag([-1.0, -1.0, 1.0] if back[view] else [1.0, 1.0, 1.0])
        poses[view, :, :3] = turn @ down
        poses[view, :, 3] = -poses[view, :, :3] @ centers[view]
    return poses


def ground(extent: tuple[float, float], random: np.random.Generator) -> np.ndarray:
    """[H, W, 3] float32, 0 .. 255, colours at the corners of cells, coarse and fine."""
    width, height = (int(CELLS * side) + 2 for side in extent)
    texture = np.zeros((height, width, 3), dtype=np.float32)
    for cells, weight in ((CELLS // 2, 60.0), (CELLS // 8, 40.0), (2, 25.0)):
        coarse = random.integers(0, 256, (height // cells + 2, width // cells + 2, 3), dtype=np.uint8)
        grown = Image.fromarray(coarse).resize((width, height), Image.Resampling.BICUBIC)
        texture += (np.asarray(grown, dtype=np.float32) - 128.0) * (weight / 64.0)
    return np.clip(texture + 128.0, 5.0, 250.0)


def photograph(texture: np.ndarray, origin: np.ndarray, pose: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """[H, W, 3] uint8: the ground, whose first corner is at `origin` [2], along the camera's `rays` [H, W, 3]."""
    center = -pose[:, :3].T @ pose[:, 3]
    directions = rays @ pose[:, :3]
    places = center[:2] - directions[..., :2] * (center[2] / directions[..., 2:])
    cells = np.clip((places - origin) * CELLS, 0.0, np.array(texture.shape[1::-1]) - 1.001)
    first = cells.astype(np.int64)
    (u, v), (i, j) = np.moveaxis(cells - first, -1, 0)[..., None], np.moveaxis(first, -1, 0)
    top = texture[j, i] * (1 - u) + texture[j, i + 1] * u
    bottom = texture[j + 1, i] * (1 - u) + texture[j + 1, i + 1] * u
    return np.rint(top * (1 - v) + bottom * v).astype(np.uint8)


def write_flight(folder: Path, photos: int, width: int = 200, height: int = 150, seed: int = 0) -> None:
    """Write the capture into a new folder. The same arguments give the same capture."""
    random = np.random.default_rng(seed)
    poses = flight(photos, random)
    centers = -np.einsum("vji,vj->vi", poses[:, :, :3], poses[:, :, 3])
    origin = centers[:, :2].min(axis=0) - HEIGHT
    extent = centers[:, :2].max(axis=0) + HEIGHT - origin
    texture = ground(tuple(extent), random)
    focal = FOCAL * width
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    rays = np.stack([x / focal, y / focal, np.ones_like(x)], axis=-1)
    (folder / "images").mkdir(parents=True)
    (folder / "sparse" / "0").mkdir(parents=True)
    names = [f"photo_{view:05d}.jpg" for view in range(photos)]

    def write(name: str, pose: np.ndarray) -> None:
        Image.fromarray(photograph(texture, origin, pose, rays)).save(folder / "images" / name, quality=92)

    with ThreadPoolExecutor() as threads:
        list(threads.map(write, names, poses))

    margin = 0.7 * HEIGHT  # beyond, no photo reaches
    places = random.uniform(size=(POINTS_OF_A_PHOTO * photos, 2)) * (extent - 2 * margin) + origin + margin
    points = np.column_stack([places, np.zeros(len(places))])
    keypoints: list[list[np.ndarray]] = [[] for _ in range(photos)]
    tracks: list[list[pycolmap.TrackElement]] = []
    for point in points:
        distances = ((centers - point) ** 2).sum(axis=1)
        near = np.argpartition(distances, min(2 * TRACK, photos - 1))[: 2 * TRACK]
        near = near[distances[near].argsort()]
        local = poses[near, :, :3] @ point + poses[near, :, 3]
        pixels = focal * local[:, :2] / local[:, 2:] + [width / 2, height / 2]
        seen = ((pixels > 0) & (pixels < [width, height])).all(axis=1).nonzero()[0][:TRACK]
        tracks.append([])
        for which in seen if len(seen) > 1 else ():
            view = int(near[which])
            tracks[-1].append(pycolmap.TrackElement(view + 1, len(keypoints[view])))
            keypoints[view].append(pixels[which])
    model = pycolmap.Reconstruction()
    parameters = [focal, focal, width / 2, height / 2]
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=width, height=height, params=parameters)
    model.add_camera_with_trivial_rig(camera)
    for view, (name, pose) in enumerate(zip(names, poses, strict=True)):
        image = pycolmap.Image(name, np.array(keypoints[view]).reshape(-1, 2), camera_id=1, image_id=view + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    colors = texture[tuple(((places - origin) * CELLS).astype(np.int64).T[::-1])].astype(np.uint8)
    for point, track, color in zip(points, tracks, colors, strict=True):
        if track:
            model.add_point3D(point, pycolmap.Track(track), color)
    model.write_binary(folder / "sparse" / "0")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="new folder")
    parser.add_argument("--photos", type=int, default=3000)
    parser.add_argument("--width", type=int, default=200)
    parser.add_argument("--height", type=int, default=150)
    options = parser.parse_args()
    if options.out.exists():
        parser.error(f"{options.out} is there already: choose a new folder")
    write_flight(options.out, options.photos, options.width, options.height)


if __name__ == "__main__":
    main()
