"""Photos of points by cameras that a reconstruction knows only about: each has a lens of its own."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image
from scipy.spatial.transform import Rotation

from turbogs_plugin.captures.bundle_adjustment import Pinholes
from turbogs_plugin.types.cameras import Observations

WIDTH, HEIGHT, FOCAL = 640, 480, 560.0


@dataclass
class Tracked:
    """V photos of M points."""

    true: Pinholes  # the cameras as they are
    given: Pinholes  # and as a reconstruction has them
    points: np.ndarray  # [M, 3], as they are
    observations: Observations  # what photos show, with some noise

    def seen(self, cameras: Pinholes, points: np.ndarray | None = None) -> np.ndarray:
        """[O, 2] pixels where cameras see the points of the observations."""
        views, points = self.observations.view_ids, self.points if points is None else points
        rotated = np.einsum("nij,nj->ni", cameras.rotations[views], points[self.observations.point_ids])
        in_camera = rotated + cameras.translations[views]
        return in_camera[:, :2] / in_camera[:, 2:] * cameras.focal[views] + cameras.centers[views]

    def misplaced(self, cameras: Pinholes) -> float:
        """Pixels, the mean between where cameras see the true points and where they are seen in truth."""
        return float(np.linalg.norm(self.seen(cameras) - self.seen(self.true), axis=1).mean())


def tracked(
    views: int = 8, points: int = 150, noise: float = 0.1, shift: float = 1.5, flat: float = 1.0, seed: int = 0
) -> Tracked:
    """Cameras about the origin that look at it from a distance of 4.

    Args:
        noise: of the observations, in pixels.
        shift: standard deviation in pixels of the true principal points from the middle; focal lengths differ by a
            thousandth for each of these pixels. The given cameras have the middle and one focal length.
        flat: thickness of the cloud of points over its width.
    """
    random = np.random.default_rng(seed)
    cloud = random.uniform(-1.0, 1.0, (points, 3)) * [1.0, 1.0, flat]
    rotations, translations = np.zeros((views, 3, 3)), np.zeros((views, 3))
    for view in range(views):
        across, down = 0.9 * np.sin(2.4 * view), 0.5 * np.cos(1.7 * view)
        rotations[view] = Rotation.from_euler("yx", [across, down]).as_matrix()  # first across, then down
        translations[view] = [0.0, 0.0, 4.0 + 0.3 * np.sin(view)]
    middle = np.tile([0.5 * WIDTH, 0.5 * HEIGHT], (views, 1))
    half_widths = np.full(views, 0.5 * WIDTH)
    given = Pinholes(rotations, translations, np.full((views, 2), FOCAL), middle, half_widths)
    focal = given.focal * (1.0 + 1e-3 * shift * random.normal(size=(views, 2)))
    true = Pinholes(rotations, translations, focal, middle + shift * random.normal(size=(views, 2)), half_widths)
    view_ids, point_ids = (each.ravel() for each in np.meshgrid(np.arange(views), np.arange(points), indexing="ij"))
    case = Tracked(true, given, cloud, Observations(np.zeros((len(view_ids), 2)), view_ids, point_ids))
    pixels = case.seen(true) + noise * random.normal(size=(len(view_ids), 2))
    return Tracked(true, given, cloud, Observations(pixels, view_ids, point_ids))


def write_tracked(
    folder: Path, case: Tracked, suffix: str = ".bin", model: str = "PINHOLE", distortion: tuple[float, ...] = ()
) -> Path:
    """A COLMAP capture of it: the given cameras, photos of noise, and the points with their tracks. `distortion`: of
    the model OPENCV, which bends what photos show."""
    reconstruction = pycolmap.Reconstruction()
    random = np.random.default_rng(1)
    views, count = len(case.given.focal), len(case.points)
    for view in range(views):
        straight = [*case.given.focal[view], *case.given.centers[view]]
        params = straight if model == "PINHOLE" else [*straight, *(distortion or (0.0,) * 4)]
        camera = pycolmap.Camera(camera_id=view + 1, model=model, width=WIDTH, height=HEIGHT, params=params)
        reconstruction.add_camera_with_trivial_rig(camera)
        pose = pycolmap.Rigid3d(np.c_[case.given.rotations[view], case.given.translations[view]])
        shown = case.observations.pixels[case.observations.view_ids == view]
        if any(distortion):
            rays = (shown - case.given.centers[view]) / case.given.focal[view]
            shown = camera.img_from_cam(np.c_[rays, np.ones(len(rays))])
        # A first feature without a point, as most have none.
        features, numbers = np.vstack([[1.0, 2.0], shown]), {"camera_id": view + 1, "image_id": 10 * view + 3}
        image = pycolmap.Image(f"{view:02d}.png", features, **numbers)
        reconstruction.add_image_with_trivial_frame(image, pose)
        path = folder / "images" / image.name
        path.parent.mkdir(parents=True, exist_ok=True)
        small = random.integers(0, 255, (HEIGHT // 16, WIDTH // 16, 3), dtype=np.uint8)
        Image.fromarray(small).resize((WIDTH, HEIGHT), Image.Resampling.NEAREST).save(path)
    for point in range(count):
        shown_by = np.flatnonzero(case.observations.point_ids == point)
        elements = []
        for place in shown_by:
            view = case.observations.view_ids[place]
            first = int(np.searchsorted(case.observations.view_ids, view))
            elements.append(pycolmap.TrackElement(10 * int(view) + 3, int(place) - first + 1))
        reconstruction.add_point3D(case.points[point], pycolmap.Track(elements), np.array([9, 8, 7], dtype=np.uint8))
    target = folder / "sparse" / "0"
    target.mkdir(parents=True)
    {".bin": reconstruction.write_binary, ".txt": reconstruction.write_text}[suffix](target)
    return folder
