"""A change of a whole model's coordinates, colours and all; `placed`: a file's rows, flat or infinite ones mended."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.engine.reference.spherical_harmonics import basis, num_bands
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.frame import Frame
from turbogs_plugin.scene.geometry import quaternions
from turbogs_plugin.types import Gaussians

LARGEST_ROUNDING = 1e-4
"""Largest `rounding` that a file of single precision may have."""
OPAQUE, FLAT = 20.0, -20.0
"""Logit of an opacity that a file has as infinite (to float32, 1 is its sigmoid), and logarithm of a scale of 0."""


@dataclass(frozen=True)
class Similarity:
    """``new = scale * rotation @ old + translation``, in float64: [3, 3], a positive number, and [3]."""

    rotation: np.ndarray
    scale: float
    translation: np.ndarray

    @classmethod
    def into(cls, frame: Frame) -> Similarity:
        """From a capture's own coordinates into a frame."""
        return cls(np.eye(3), 1.0 / frame.scale, -frame.center / frame.scale)

    def inverse(self) -> Similarity:
        back = self.rotation.T
        return Similarity(back, 1.0 / self.scale, -(back @ self.translation) / self.scale)

    def after(self, first: Similarity) -> Similarity:
        """The change that makes `first` and then this one."""
        moved = self.scale * self.rotation @ first.translation + self.translation
        return Similarity(self.rotation @ first.rotation, self.scale * first.scale, moved)

    def apply_to_poses(self, viewmats: np.ndarray) -> np.ndarray:
        """[V, 4, 4] world to camera in the old coordinates -> in the new ones. Camera coordinates scale with the world,
        so rotations stay rotations."""
        moved = viewmats.copy()
        moved[:, :3, :3] = viewmats[:, :3, :3] @ self.rotation.T
        moved[:, :3, 3] = self.scale * viewmats[:, :3, 3] - moved[:, :3, :3] @ self.translation
        return moved

    def apply(self, gaussians: Gaussians) -> Gaussians:
        """The model in the new coordinates, in its own dtype. Unturned, quaternions and harmonics keep their bits."""
        if not np.array_equal(self.rotation, np.eye(3)):
            w, x, y, z = quaternions(self.rotation[None])[0]
            product = torch.tensor([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]).to(gaussians.means)
            means = gaussians.means @ torch.from_numpy(self.rotation).to(gaussians.means).T
            shN = _turned_harmonics(gaussians.shN, self.rotation)
            gaussians = replace(gaussians, means=means, quats=gaussians.quats @ product.T, shN=shN)
        means = self.scale * gaussians.means + torch.from_numpy(self.translation).to(gaussians.means)
        return replace(gaussians, means=means, scales=gaussians.scales + math.log(self.scale))


def placed(gaussians: Gaussians, change: Similarity, source: str | Path) -> Gaussians:
    """A file's model (float64), changed, as training and rendering take it: float32, on the CPU.

    Infinite opacities and scales of 0 become finite; Gaussians that are not finite are left out. Warnings about the
    file `source` count flat ones and these. Raises `InputError` where none is left."""
    if count := int((flat := gaussians.scales == -math.inf).any(dim=1).sum()):
        warnings.warn(f"{source}: {count} Gaussians are flat (scale 0, as of 2DGS) and drawn thin", stacklevel=3)
    opacities = gaussians.opacities.where(~gaussians.opacities.isinf(), OPAQUE * gaussians.opacities.sign())
    gaussians = replace(gaussians, opacities=opacities, scales=gaussians.scales.masked_fill(flat, FLAT))
    return _finite(change.apply(gaussians).map(lambda value: value.float().contiguous()), source)


def in_capture(gaussians: Gaussians, frame: Frame, target: Path, double_means: bool = False) -> Gaussians:
    """A model as files have it: in the capture's own coordinates, float32 on the CPU; means in float64 if
    `double_means`, which a frame far from the capture's origin needs (`local_origin`).

    Gaussians that are not finite are left out; a warning about the file `target` counts them. Raises `InputError` where
    none is left."""
    rows = gaussians.map(lambda value: value.detach().cpu().contiguous())
    means = torch.from_numpy(frame.restore_points(rows.means.numpy()))
    means = means if double_means else means.float()
    return _finite(replace(rows, means=means, scales=rows.scales + math.log(frame.scale)), target)


def upright(gaussians: Gaussians) -> Gaussians:
    """A model in axes x right, y up, z backward in those x right, y down, z forward of captures, and back: y and z
    change their sign in everything that depends on a direction."""
    signs = gaussians.means.new_tensor([1.0, 1.0, -1.0, -1.0])
    shN = _turned_harmonics(gaussians.shN, np.diag(signs[1:].cpu().numpy()))
    return replace(gaussians, means=gaussians.means * signs[1:], quats=gaussians.quats * signs, shN=shN)


def local_origin(frame: Frame) -> np.ndarray:
    """[3] float64: where a file of single precision has its origin, in the capture's own coordinates. 0, unless the
    capture lies so far from there that its positions would be rounded by more than `LARGEST_ROUNDING`; then near the
    frame's centre, at numbers of few digits."""
    far = rounding(frame) > LARGEST_ROUNDING
    return np.round(frame.center, -math.floor(math.log10(frame.scale))) if far else np.zeros(3)


def rounding(frame: Frame) -> float:
    """Largest rounding error of float32 at the frame's centre in the capture's own coordinates, in the frame's unit."""
    return float(np.abs(frame.center).max() * np.finfo(np.float32).eps / 2 / frame.scale)


def _finite(gaussians: Gaussians, file: str | Path) -> Gaussians:
    """The Gaussians that are finite; a warning counts the others. Raises `InputError` where there is none."""
    finite = gaussians.finite_rows()
    if not finite.any():
        raise InputError(f"{file}: none of its {len(finite)} Gaussians is finite: there is no model to use")
    if finite.all():
        return gaussians
    count = int((~finite).sum())
    warnings.warn(f"{file}: {count} of {len(finite)} Gaussians are not finite and left out", stacklevel=4)
    return gaussians.map(lambda value: value[finite])


def _turned_harmonics(shN: Tensor, rotation: np.ndarray) -> Tensor:
    """[N, B, 3] coefficients whose colour in direction ``rotation @ d`` is that of `shN` in direction d.

    The functions of one degree turn among themselves, so the matrix of a degree follows from their values in more
    directions than the 7 functions of the largest one.
    """
    turned, degree = shN.clone(), round((shN.shape[1] + 1) ** 0.5) - 1
    directions = torch.randn(64, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    directions = torch.nn.functional.normalize(directions, dim=1)
    before = basis(directions, degree)  # [R, B]
    after = basis(directions @ torch.from_numpy(rotation).double().T, degree)  # [R, B]
    for of in range(1, degree + 1):
        rows = slice(num_bands(of - 1), num_bands(of))
        matrix = torch.linalg.lstsq(after[:, rows], before[:, rows]).solution  # [2 d + 1, 2 d + 1]
        turned[:, rows] = torch.einsum("ij,njc->nic", matrix.to(shN), shN[:, rows])
    return turned
