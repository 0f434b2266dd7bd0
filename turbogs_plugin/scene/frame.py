"""The similarity between a capture's own coordinates and those that training works in.

Captures come in any unit and at any place: UTM metres lie 10^6 from the origin, where float32 resolves 6 cm. So
cameras and points are brought near the origin and to an extent of about 1 in float64, before anything becomes float32,
and exports go back the same way. There is no rotation, so spherical harmonics and quaternions are the same in both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from turbogs_plugin.errors import InputError


@dataclass(frozen=True)
class Frame:
    """``capture = normalised * scale + center``, in float64: `center` [3], and a positive `scale`."""

    center: np.ndarray
    scale: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "center", np.asarray(self.center, dtype=np.float64))
        object.__setattr__(self, "scale", float(self.scale))
        if self.center.shape != (3,) or not np.isfinite(self.center).all():
            raise InputError(f"frame center is {self.center.tolist()}: it must be three finite numbers")
        if not 1e-30 < self.scale < 1e30:  # float32's range, with room
            raise InputError(f"frame scale is {self.scale}: it must be within 1e-30 .. 1e30")

    @classmethod
    def around(cls, camera_centers: np.ndarray, points: np.ndarray) -> Frame:
        """The frame whose origin is the mean of the camera centres [V, 3] and whose unit is 1.1 times their largest
        distance from it (the scene extent of 3DGS); where the cameras only turn on the spot, the median distance of the
        points [M, 3]. All in float64."""
        # Differences to one camera first: a mean of numbers near 10^6 would lose digits.
        center = camera_centers[0] + (camera_centers - camera_centers[0]).mean(axis=0)
        radius = np.linalg.norm(camera_centers - center, axis=1).max()
        depth = float(np.median(np.linalg.norm(points - center, axis=1)))
        if radius <= 1e-6 * depth:
            radius = depth
        return cls(center, 1.1 * radius if radius > 0 else 1.0)

    def normalise_points(self, points: np.ndarray) -> np.ndarray:
        """[..., 3] float64 in the capture's coordinates -> the same in the normalised frame."""
        return (points - self.center) / self.scale

    def restore_points(self, points: np.ndarray) -> np.ndarray:
        """[..., 3] in the normalised frame -> float64 in the capture's coordinates."""
        return np.asarray(points, dtype=np.float64) * self.scale + self.center

    def normalise_poses(self, viewmats: np.ndarray) -> np.ndarray:
        """[V, 4, 4] float64 world-to-camera matrices of the capture -> matrices of the normalised frame. Camera
        coordinates shrink with the world, so rotations stay rotations and no projection changes."""
        normalised = viewmats.copy()
        normalised[:, :3, 3] = (viewmats[:, :3, 3] + viewmats[:, :3, :3] @ self.center) / self.scale
        return normalised

    def restore_poses(self, viewmats: np.ndarray) -> np.ndarray:
        """[V, 4, 4] world-to-camera matrices of the normalised frame -> float64 matrices of the capture."""
        restored = np.asarray(viewmats, dtype=np.float64).copy()
        restored[:, :3, 3] = restored[:, :3, 3] * self.scale - restored[:, :3, :3] @ self.center
        return restored
