"""Bundle adjustment: each photo's own pinhole camera, from where the photo shows the points of a reconstruction.

Reconstructions give all photos of a camera the same lens. A phone's or a drone's photos are not of one: the stabiliser
shifts lens and sensor, focusing changes the focal length, and a rolling shutter shears what moves, by up to half a
pixel. Here each photo gets its own pose, focal lengths and principal point: cameras and points in turn, by Gauss-Newton
steps on squares that are reweighted by Cauchy's rule (Triggs et al., Bundle Adjustment: A Modern Synthesis, 2000).

A prior holds cameras to those that were given: a normal distribution of ten parameters, whose covariance is learnt from
all photos by expectation-maximisation. So where one lens is right for all of them, cameras stay what they were, however
few points a photo shows.

All is float64 on the CPU, and the same to the bit in every run, so that a resumed training has the same cameras.

Test photos keep the cameras that they were given, as errors are to be compared with other programs' errors, which are
by the given ones. Beside them they get refined ones, by where they show the points that training starts from: errors by
these are of the model alone, not of the camera.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.scene.scene import Scene
from turbogs_plugin.types import Cameras
from turbogs_plugin.types.cameras import Observations

ROUNDS, CAMERA_STEPS, RESECTION_STEPS = 6, 2, 10
PRIOR = 0.006
"""Standard deviation of every parameter of a camera before any is learnt, in the units of `Pinholes.moved`: four to six
pixels at the edge of a photo of 1200."""
SMALLEST_VARIANCE = 1e-14  # smallest variance in the prior, so that it can be inverted
POINT_DAMPING = 1e-4  # relative damping of a point's normal equations: it stays in a direction that no photo tells
FEWEST_OBSERVATIONS = 30  # a photo with fewer keeps its camera: three a parameter
FINEST = 0.02  # pixels: errors below are not taken for noise of the features, however exact a reconstruction is
FARTHEST_MATCH = 0.02
"""Share of a photo's width: photos are others than the reconstructed ones where half of the points are farther from
where photos show them."""
PARAMETERS = 10


class Pinholes(NamedTuple):
    """V cameras in float64."""

    rotations: np.ndarray  # [V, 3, 3], world to camera
    translations: np.ndarray  # [V, 3]
    focal: np.ndarray  # [V, 2], pixels
    centers: np.ndarray  # [V, 2], principal points, pixels
    half_widths: np.ndarray  # [V], pixels

    @classmethod
    def of(cls, viewmats: np.ndarray, Ks: np.ndarray, sizes: np.ndarray) -> Pinholes:
        """Cameras of viewmats [V, 4, 4], intrinsics [V, 3, 3] in pixels, and sizes [V, 2] (width, height)."""
        return cls(viewmats[:, :3, :3], viewmats[:, :3, 3], Ks[:, [0, 1], [0, 1]], Ks[:, :2, 2], 0.5 * sizes[:, 0])

    def moved(self, by: np.ndarray, depths: np.ndarray) -> Pinholes:
        """The cameras after a step.

        Args:
            by: [V, PARAMETERS]: rotation vector (3), in radians; translation (3), in `depths`; focal lengths (2),
                relative; principal point (2), in half widths.
            depths: [V], of what is before each camera.
        """
        from scipy.spatial.transform import Rotation

        turns = Rotation.from_rotvec(by[:, :3]).as_matrix()
        translations = np.einsum("vij,vj->vi", turns, self.translations) + by[:, 3:6] * depths[:, None]
        focal, centers = self.focal * (1.0 + by[:, 6:8]), self.centers + by[:, 8:] * self.half_widths[:, None]
        return Pinholes(turns @ self.rotations, translations, focal, centers, self.half_widths)


class Refinement(NamedTuple):
    """Cameras and points that agree better with one another."""

    cameras: Pinholes
    points: np.ndarray  # [M, 3]
    spread: np.ndarray  # [PARAMETERS, PARAMETERS], covariance of how far cameras have moved (`Pinholes.moved`)
    changed: int  # cameras that are others than those that were given
    before: float  # median of `reprojection_errors`, pixels
    after: float

    def text(self, called: str) -> str:
        """One line on the refinement. `called` names the cameras."""
        return (
            f"{self.changed} of {len(self.cameras.focal)} {called} refined, each with a lens of its own: points are "
            f"{self.after:.2f} pixels from where photos show them, {self.before:.2f} before (medians)"
        )


def refine_together(cameras: Pinholes, points: np.ndarray, observations: Observations) -> Refinement:
    """Cameras and points [M, 3] float64 that agree better with one another, by observations of the points."""
    adjustment = _Adjustment(cameras, points, observations)
    for _ in range(ROUNDS):
        for _ in range(CAMERA_STEPS):
            adjustment.move_cameras()
            adjustment.learn_spread()
        adjustment.move_points()
    refined, moved = adjustment.agreeing_cameras(), np.ascontiguousarray(adjustment.places.T)
    count = int((refined.focal != cameras.focal).any(axis=1).sum())
    medians = (_median(adjustment.first_errors), _median(reprojection_errors(refined, moved, observations)))
    return Refinement(refined, moved, adjustment.spread, count, *medians)


def refine_alone(
    cameras: Pinholes, points: np.ndarray, observations: Observations, spread: np.ndarray | None = None
) -> Pinholes:
    """Cameras that agree better with points, which stay. `spread`: of a `Refinement` of other photos of the capture;
    None: `PRIOR` of each parameter."""
    adjustment = _Adjustment(cameras, points, observations, spread)
    for _ in range(RESECTION_STEPS):
        adjustment.move_cameras()
    return adjustment.agreeing_cameras()


def _median(errors: np.ndarray) -> float:
    """Median of some errors; 0 where there are none."""
    return float(np.median(errors)) if len(errors) else 0.0


def reprojection_errors(cameras: Pinholes, points: np.ndarray, observations: Observations) -> np.ndarray:
    """[O] pixels between where cameras see points and where photos show them; infinite behind a camera."""
    return _Adjustment(cameras, points, observations).first_errors


def of_these_photos(cameras: Pinholes, points: np.ndarray, observations: Observations) -> bool:
    """True where observations belong to the photos of these cameras, not to others or to another size: half of the
    points are within `FARTHEST_MATCH`."""
    width = 2.0 * float(np.median(cameras.half_widths))
    return _median(reprojection_errors(cameras, points, observations)) <= FARTHEST_MATCH * width


class _Adjustment:
    """Cameras and points on their way. Arrays of observations are [2, O] or [3, O]: rows are read and written whole."""

    def __init__(
        self, cameras: Pinholes, points: np.ndarray, observations: Observations, spread: np.ndarray | None = None
    ) -> None:
        self.given = self.cameras = cameras
        views = len(cameras.focal)
        self.places, self.pixels = (np.array(rows.T, order="C") for rows in (points, observations.pixels))
        self.point_ids = observations.point_ids
        starts = np.searchsorted(observations.view_ids, np.arange(views + 1))
        self.own, self.counts = [slice(*ends) for ends in itertools.pairwise(starts.tolist())], np.diff(starts)
        self.moves = np.zeros((views, PARAMETERS))  # how far each camera has come
        self.spread = PRIOR**2 * np.eye(PARAMETERS) if spread is None else spread  # covariance of these in the prior
        # Covariance of each camera's moves by what its photo shows and the prior; 0 where it shows too little.
        self.doubts = np.zeros((views, PARAMETERS, PARAMETERS))
        (*_, depths), _, self.first_errors = self._seen()
        self.depths = np.array([np.median(depths[own]) if own.stop > own.start else 1.0 for own in self.own])
        self.scale = max(_median(self.first_errors), FINEST)  # pixels; errors far above it count little

    def _seen(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """x / z, y / z and z in the camera [3, O]; residuals [2, O]; their lengths [O], infinite behind the camera."""
        cameras = self.cameras
        sights = np.take(self.places, self.point_ids, axis=1)
        residuals = np.empty((2, sights.shape[1]))
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # what is not finite weighs nothing
            for view, own in enumerate(self.own):
                sights[:, own] = cameras.rotations[view] @ sights[:, own] + cameras.translations[view][:, None]
                sights[:2, own] /= sights[2, own]
                residuals[:, own] = sights[:2, own] * cameras.focal[view][:, None] + cameras.centers[view][:, None]
            np.subtract(self.pixels, residuals, out=residuals)
            errors = np.sqrt((residuals * residuals).sum(axis=0))
        return sights, residuals, np.where((sights[2] > 0) & np.isfinite(errors), errors, math.inf)

    def _counted(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """x / z, y / z and 1 / z in the camera [3, O]; roots of Cauchy's weights [O], in units of the noise; residuals
        [2, O] times these. All are 0 where the error is infinite."""
        sights, residuals, errors = self._seen()
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # what is not finite weighs nothing
            np.divide(1.0, sights[2], out=sights[2])
            roots = 1.0 / np.sqrt(self.scale**2 + errors * errors)
        if (left_out := roots == 0).any():
            sights[:, left_out], residuals[:, left_out] = 0.0, 0.0
        residuals *= roots
        return sights, roots, residuals

    def move_cameras(self) -> None:
        """One step of every camera."""
        sights, roots, residuals = self._counted()
        normals, right = np.zeros_like(self.doubts), np.zeros_like(self.moves)  # of the normal equations
        for view, own in enumerate(self.own):
            p, q, near = sights[:, own]
            near = near * self.depths[view]
            # How x and y of a pixel change by each parameter.
            across, down = slopes = np.zeros((2, PARAMETERS, len(p)))
            across[0], across[1], across[2], across[3], across[5], across[6] = -p * q, 1 + p * p, -q, near, -p * near, p
            down[0], down[1], down[2], down[4], down[5], down[7] = -1 - q * q, p * q, p, near, -q * near, q
            slopes *= self.cameras.focal[view][:, None, None]
            across[8] = down[9] = self.cameras.half_widths[view]
            slopes *= roots[own]
            normals[view] = across @ across.T + down @ down.T
            right[view] = across @ residuals[0, own] + down @ residuals[1, own]
        told, prior = self.counts >= FEWEST_OBSERVATIONS, np.linalg.inv(self.spread)
        self.doubts[told] = np.linalg.inv(normals[told] + prior)
        steps = np.einsum("vab,vb->va", self.doubts, right - self.moves @ prior)
        self.moves += steps
        self.cameras = self.cameras.moved(steps, self.depths)

    def learn_spread(self) -> None:
        """One step of expectation-maximisation of the prior."""
        refined = self.doubts[:, 0, 0] > 0
        if refined.any():
            squares = self.moves[refined].T @ self.moves[refined] + self.doubts[refined].sum(axis=0)
            self.spread = squares / refined.sum() + SMALLEST_VARIANCE * np.eye(PARAMETERS)

    def move_points(self) -> None:
        """One step of every point that two photos show."""
        sights, roots, residuals = self._counted()
        # What each observation adds to its point's normal equations: six entries of a matrix, three of a vector.
        entries, count = np.empty((9, len(roots))), self.places.shape[1]
        for own, rotation, focal in zip(self.own, self.cameras.rotations, self.cameras.focal, strict=True):
            scales = focal[:, None] * (sights[2, own] * roots[own])
            sides, ahead = rotation[:2, :, None], rotation[2][:, None]
            x, y = (sides - sights[:2, None, own] * ahead) * scales[:, None]  # [3, N]: how a pixel changes by the point
            for row, (i, j) in enumerate(itertools.combinations_with_replacement(range(3), 2)):
                entries[row, own] = x[i] * x[j] + y[i] * y[j]
            entries[6:, own] = x * residuals[0, own] + y * residuals[1, own]
        seen = np.bincount(self.point_ids, entries[0] + entries[3] + entries[5] > 0, count)
        sums = np.stack([np.bincount(self.point_ids, values, count) for values in entries])  # [9, M]
        traces = sums[0] + sums[3] + sums[5]
        told = (seen >= 2) & (traces > 0)
        sums = sums[:, told] / traces[told]
        normals = sums[[0, 1, 2, 1, 3, 4, 2, 4, 5]].T.reshape(-1, 3, 3) + POINT_DAMPING * np.eye(3)
        self.places[:, told] += np.linalg.solve(normals, sums[6:].T[:, :, None])[:, :, 0].T

    def agreeing_cameras(self) -> Pinholes:
        """The cameras; the given one where its photo agrees no better."""
        old, new = self.first_errors, self._seen()[2]
        better = np.array([_median(new[own]) < _median(old[own]) for own in self.own])
        pairs = zip(self.cameras, self.given, strict=True)
        return Pinholes(*(np.where(better.reshape(-1, *[1] * (now.ndim - 1)), now, then) for now, then in pairs))


class RefinedCameras(NamedTuple):
    """Cameras and points of a scene by where its photos show its points."""

    train: Cameras  # to train with
    points: Tensor  # [M, 3] float32, to start from
    test: Cameras  # of the test photos beside theirs
    reprojection_error: float  # of the training cameras, as `Scene` has it
    notes: tuple[str, ...]


def find_cameras(scene: Scene, training: bool = True) -> RefinedCameras | None:
    """Cameras that agree better with where photos show the scene's points; None where the capture does not say that, or
    says it of other photos. Without `training`, training cameras and points stay, and only the test photos get cameras
    beside theirs."""
    places = scene.points.double().numpy()
    given, tested = _pinholes(scene.train.cameras), _pinholes(scene.test.cameras)
    shown, seen = scene.train.observations, scene.test.observations
    if not (shown and seen and of_these_photos(given, places, shown) and of_these_photos(tested, places, seen)):
        return None
    together = refine_together(given, places, shown)
    train, points, error = scene.train.cameras, scene.points, together.before
    notes: tuple[str, ...] = ()
    if training and together.changed:
        places, error, notes = together.points, together.after, (together.text("training cameras"),)
        train, points = _cameras(together.cameras, train), torch.from_numpy(places).float()
    beside = refine_alone(tested, places, seen, together.spread)
    return RefinedCameras(train, points, _cameras(beside, scene.test.cameras), error, notes)


def with_cameras(scene: Scene, found: RefinedCameras | None) -> Scene:
    """The scene with these cameras; as it is where none were found."""
    if found is None:
        return scene
    train, test = replace(scene.train, cameras=found.train), replace(scene.test, refined=found.test)
    error, notes = found.reprojection_error, (*scene.notes, *found.notes)
    return replace(scene, train=train, test=test, points=found.points, reprojection_error=error, notes=notes)


def refine_cameras(scene: Scene, training: bool = True) -> Scene:
    """The scene with the cameras of `find_cameras`, whose argument `training` is."""
    return with_cameras(scene, find_cameras(scene, training))


def _pinholes(cameras: Cameras) -> Pinholes:
    """Cameras as float64 arrays."""
    return Pinholes.of(cameras.viewmats.cpu().double().numpy(), cameras.Ks.cpu().double().numpy(), cameras.sizes)


def _cameras(pinholes: Pinholes, like: Cameras) -> Cameras:
    """The pinholes, of the images, type and device of other cameras."""
    viewmats, Ks = (matrices.cpu().double().numpy().copy() for matrices in (like.viewmats, like.Ks))
    viewmats[:, :3, :3], viewmats[:, :3, 3] = pinholes.rotations, pinholes.translations
    Ks[:, [0, 1], [0, 1]], Ks[:, :2, 2] = pinholes.focal, pinholes.centers
    return Cameras(torch.from_numpy(viewmats).to(like.viewmats), torch.from_numpy(Ks).to(like.Ks), like.sizes)
