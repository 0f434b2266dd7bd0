"""The camera of a page of the viewer: checked as a client tells it, and as an engine renders it; and what a capture's
cameras look at."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch

from turbogs_plugin.engine.reference.projection import rotation_matrices
from turbogs_plugin.scene.geometry import camera_centers, quaternions, viewmat_of_pose
from turbogs_plugin.types import Cameras

SMALLEST_SIDE, LARGEST_SIDE = 16, 1920
"""Bounds of a frame's sides in pixels, whatever size a client claims to have."""
FARTHEST = 1e6
"""Largest coordinate of a camera, in units of the scene's extent; beyond, float32 resolves nothing."""
FOV_LIMITS = (math.radians(1.0), math.radians(170.0))


@dataclass(frozen=True)
class ViewerCamera:
    """A pinhole camera whose principal point is the middle of its image of `width` and `height` pixels.

    Args:
        position: in the model's world.
        wxyz: unit quaternion of the rotation from the camera (x right, y down, z forward) to the world.
        fov: vertical, radians.
    """

    position: tuple[float, float, float]
    wxyz: tuple[float, float, float, float]
    fov: float
    width: int
    height: int

    @classmethod
    def checked(
        cls, position: Iterable[float], wxyz: Iterable[float], fov: float, width: float, height: float
    ) -> ViewerCamera | None:
        """The camera that a client claims to have; None if it is none. Sizes and angles are brought within limits, with
        the image's proportions kept as far as both sides allow."""
        try:
            numbers = np.array([*position, *wxyz, fov, width, height], dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            return None
        if numbers.shape != (10,) or not np.isfinite(numbers).all() or numbers[7:].min() <= 0:
            return None
        place, turn, sides = numbers[:3], numbers[3:7], numbers[8:]
        if not 1e-6 < np.abs(turn).max() < 1e6 or np.abs(place).max() > FARTHEST:
            return None
        scaled = sides * min(1.0, LARGEST_SIDE / sides.max())
        angle = float(np.clip(numbers[7], *FOV_LIMITS))
        return cls._of(place, turn / np.linalg.norm(turn), angle, np.clip(scaled.round(), SMALLEST_SIDE, LARGEST_SIDE))

    @classmethod
    def of_view(cls, cameras: Cameras, view_id: int) -> ViewerCamera:
        """The camera of a capture's view; the principal point moves to the centre."""
        viewmat = cameras.viewmats[view_id, None].double().cpu().numpy()
        fov = 2.0 * math.atan(cameras.sizes[view_id, 1] / (2.0 * float(cameras.Ks[view_id, 1, 1])))
        turn = quaternions(viewmat[:, :3, :3].transpose(0, 2, 1))[0]
        return cls._of(camera_centers(viewmat)[0], turn, fov, cameras.sizes[view_id])

    @classmethod
    def _of(cls, position: np.ndarray, wxyz: np.ndarray, fov: float, size: np.ndarray) -> ViewerCamera:
        (x, y, z), (a, b, c, d), (width, height) = position.tolist(), wxyz.tolist(), size.tolist()
        return cls((x, y, z), (a, b, c, d), fov, int(width), int(height))

    @property
    def rotation(self) -> np.ndarray:  # [3, 3] float64, from the camera to the world
        return rotation_matrices(torch.tensor(self.wxyz, dtype=torch.float64)).numpy()

    def with_at_most(self, pixels: float) -> ViewerCamera:
        """The view in an image of at most `pixels` pixels."""
        scale = min(1.0, math.sqrt(pixels / (self.width * self.height)))
        width, height = (max(SMALLEST_SIDE, int(side * scale)) for side in (self.width, self.height))
        return replace(self, width=width, height=height)

    def cameras(self, device: torch.device) -> Cameras:
        """The camera as one of `Cameras`, float32 on a device."""
        viewmat = viewmat_of_pose(self.rotation, np.array(self.position))
        focal = self.height / (2.0 * math.tan(self.fov / 2.0))
        K = np.array([[focal, 0.0, self.width / 2.0], [0.0, focal, self.height / 2.0], [0.0, 0.0, 1.0]])
        viewmats, Ks = (torch.from_numpy(array[None]).float().to(device) for array in (viewmat, K))
        return Cameras(viewmats, Ks, np.array([[self.width, self.height]], dtype=np.int64))


def focus_and_up(cameras: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """The point nearest to all lines of sight (least squares), [3], and the mean upward direction, [3], a unit vector.
    Where the lines are parallel, or meet behind the cameras, the point is one unit in front of their mean."""
    centers, directions = (value.double().cpu().numpy() for value in (cameras.centers, cameras.directions))
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]  # [C, 3, 3]
    matrix = across.mean(axis=0)
    point = centers.mean(axis=0) + _unit(directions.mean(axis=0), np.array([0.0, 0.0, 1.0]))
    if np.linalg.eigvalsh(matrix)[0] > 1e-3:
        nearest = np.linalg.solve(matrix, np.einsum("cij,cj->i", across, centers) / len(centers))
        if np.median(((nearest - centers) * directions).sum(axis=1)) > 0:
            point = nearest
    down = cameras.viewmats[:, 1, :3].double().cpu().numpy().mean(axis=0)
    return point, _unit(-down, np.array([0.0, -1.0, 0.0]))


def _unit(vector: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-9 else otherwise / np.linalg.norm(otherwise)
