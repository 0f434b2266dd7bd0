"""From where a page looks: what a client says of its camera, checked, and the camera that an engine renders."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from turbogs_plugin.engine.reference.projection import rotation_matrices
from turbogs_plugin.scene.geometry import quaternions
from turbogs_plugin.types import Cameras

SMALLEST_SIDE, LARGEST_SIDE = 16, 1920
"""Pixels of a frame's sides, whatever size a client claims to have."""
FARTHEST = 1e6
"""Coordinates of an eye, in units of the scene's extent; beyond, float32 resolves nothing."""
FOV_LIMITS = (math.radians(1.0), math.radians(170.0))


@dataclass(frozen=True)
class Eye:
    """A pinhole camera in the middle of its image.

    Args:
        position: in the model's world.
        wxyz: unit quaternion of the rotation from the camera (x right, y down, z forward) to the world.
        fov: vertical, radians.
        width, height: of the image, pixels.
    """

    position: tuple[float, float, float]
    wxyz: tuple[float, float, float, float]
    fov: float
    width: int
    height: int

    @classmethod
    def checked(
        cls, position: Sequence[float], wxyz: Sequence[float], fov: float, width: float, height: float
    ) -> Eye | None:
        """The camera that a client claims to have; None if it is none. Sizes and angles are brought within limits, with
        the image's proportions kept as far as both sides allow."""
        try:
            place, turn = np.array(position, dtype=np.float64), np.array(wxyz, dtype=np.float64)
            numbers = np.array([fov, width, height], dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            return None
        if place.shape != (3,) or turn.shape != (4,) or not (np.isfinite(numbers).all() and (np.abs(turn) < 1e6).all()):
            return None
        length = float(np.linalg.norm(turn))
        if length < 1e-6 or not (np.abs(place) <= FARTHEST).all() or numbers[1:].min() < 1 or numbers[0] <= 0:
            return None
        scale = min(1.0, LARGEST_SIDE / float(numbers[1:].max()))
        sides = [min(max(SMALLEST_SIDE, round(side * scale)), LARGEST_SIDE) for side in numbers[1:].tolist()]
        angle = min(max(float(numbers[0]), FOV_LIMITS[0]), FOV_LIMITS[1])
        return cls(tuple(place.tolist()), tuple((turn / length).tolist()), angle, *sides)

    @classmethod
    def of_view(cls, cameras: Cameras, view_id: int) -> Eye:
        """That of a view of a capture, but for a principal point beside the middle."""
        viewmat = cameras.viewmats[view_id].double().cpu().numpy()
        rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
        width, height = cameras.sizes[view_id].tolist()
        fov = 2.0 * math.atan(height / (2.0 * float(cameras.Ks[view_id, 1, 1])))
        place = -rotation.T @ translation
        return cls(tuple(place.tolist()), tuple(quaternions(rotation.T[None])[0].tolist()), fov, width, height)

    @property
    def rotation(self) -> np.ndarray:
        """[3, 3] float64, from the camera to the world."""
        return rotation_matrices(torch.tensor(self.wxyz, dtype=torch.float64)).numpy()

    def with_at_most(self, pixels: float) -> Eye:
        """The same view in an image of at most so many pixels."""
        scale = min(1.0, math.sqrt(pixels / (self.width * self.height)))
        width, height = (max(SMALLEST_SIDE, int(side * scale)) for side in (self.width, self.height))
        return replace(self, width=width, height=height)

    def cameras(self, device: torch.device) -> Cameras:
        """One camera, float32 on a device."""
        to_camera = self.rotation.T
        viewmat = np.eye(4)
        viewmat[:3, :3] = to_camera
        viewmat[:3, 3] = -to_camera @ np.array(self.position)
        focal = self.height / (2.0 * math.tan(self.fov / 2.0))
        K = np.array([[focal, 0.0, self.width / 2.0], [0.0, focal, self.height / 2.0], [0.0, 0.0, 1.0]])
        tensors = (torch.from_numpy(array[None]).float().to(device) for array in (viewmat, K))
        return Cameras(*tensors, np.array([[self.width, self.height]], dtype=np.int64))
