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
DERIVATIVES = (
    ((0, 4, -1), (1, 0, 1), (1, 3, 1), (2, 2, -1), (3, 6, 1), (5, 7, -1), (6, 1, 1)),
    ((0, 0, -1), (0, 5, -1), (1, 4, 1), (2, 1, 1), (4, 6, 1), (5, 8, -1), (7, 2, 1)),
)
"""Derivatives of a pixel's x and y by parameters of `Pinholes.moved` but the principal point: (parameter, function of
`_Adjustment.move_cameras`, sign), in units of the focal length, and from function 6 on of the depth."""
UPPER = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])  # rows and columns of the entries of a symmetric 3x3 matrix


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
        turns = _rotations(by[:, :3])
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


def farthest_match(cameras: Pinholes) -> float:
    """`FARTHEST_MATCH` in pixels."""
    return FARTHEST_MATCH * 2.0 * float(np.median(cameras.half_widths))


def of_these_photos(cameras: Pinholes, points: np.ndarray, observations: Observations) -> bool:
    """True where observations belong to the photos of these cameras, not to others or to another size: half of the
    points are within `farthest_match`."""
    return _median(reprojection_errors(cameras, points, observations)) <= farthest_match(cameras)


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
        """x / z, y / z and 1 / z in the camera [3, O]; residuals [2, O]; Cauchy's weights [O], in units of the noise.
        All are 0 where the error is infinite."""
        sights, residuals, errors = self._seen()
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # what is not finite weighs nothing
            np.divide(1.0, sights[2], out=sights[2])
            weights = 1.0 / (self.scale**2 + errors * errors)
        if (left_out := weights == 0).any():
            sights[:, left_out], residuals[:, left_out] = 0.0, 0.0
        return sights, residuals, weights

    def move_cameras(self) -> None:
        """One step of every camera, by sums over its observations of products of nine functions of the point with each
        other and with the residuals: 1, p, q, pp, pq, qq, 1 / z, p / z and q / z, where p is x / z and q is y / z."""
        (p, q, near), residuals, weights = self._counted()
        roots = np.sqrt(weights)
        functions = np.stack([np.ones_like(p), p, q, p * p, p * q, q * q, near, near * p, near * q])
        functions *= roots
        residuals *= roots
        products = np.array([functions[:, own] @ functions[:, own].T for own in self.own])  # [V, 9, 9]
        slopes = np.array([functions[:, own] @ residuals[:, own].T for own in self.own])  # [V, 9, 2]
        factors, prior = self._camera_factors(), np.linalg.inv(self.spread)
        normals = (factors @ products[:, None] @ factors.swapaxes(2, 3)).sum(axis=1) + prior
        told = self.counts >= FEWEST_OBSERVATIONS
        self.doubts[told] = np.linalg.inv(normals[told])
        right = np.einsum("vcai,vic->va", factors, slopes) - self.moves @ prior  # of the normal equations
        steps = np.einsum("vab,vb->va", self.doubts, right)
        self.moves += steps
        self.cameras = self.cameras.moved(steps, self.depths)

    def _camera_factors(self) -> np.ndarray:
        """[V, 2, PARAMETERS, 9]: how x and y of a pixel change by each parameter of its camera, in factors of functions
        of the point, listed at `move_cameras`."""
        factors = np.zeros((len(self.depths), 2, PARAMETERS, 9))
        for axis, (derivatives, focal) in enumerate(zip(DERIVATIVES, self.cameras.focal.T, strict=True)):
            for parameter, function, sign in derivatives:
                factors[:, axis, parameter, function] = sign * focal * (self.depths if function >= 6 else 1.0)
            factors[:, axis, 8 + axis, 0] = self.cameras.half_widths
        return factors

    def learn_spread(self) -> None:
        """One step of expectation-maximisation of the prior."""
        refined = self.doubts[:, 0, 0] > 0
        if refined.any():
            squares = self.moves[refined].T @ self.moves[refined] + self.doubts[refined].sum(axis=0)
            self.spread = squares / refined.sum() + SMALLEST_VARIANCE * np.eye(PARAMETERS)

    def move_points(self) -> None:
        """One step of every point that two photos show."""
        count, entries = self.places.shape[1], self._point_entries()
        seen = np.bincount(self.point_ids, entries[0] + entries[3] + entries[5] > 0, count)
        sums = np.stack([np.bincount(self.point_ids, values, count) for values in entries])  # [9, M]
        traces = sums[0] + sums[3] + sums[5]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # what is not finite weighs nothing
            sums = sums / traces
            sums[[0, 3, 5]] += POINT_DAMPING
            self.places += np.where((seen >= 2) & (traces > 0), _solved(*sums), 0.0)

    def _point_entries(self) -> np.ndarray:
        """[9, O]: what each observation adds to its point's normal equations in the world: six entries of a symmetric
        matrix and three of a vector."""
        (p, q, near), (across, down), weights = self._counted()
        weights *= near
        across, down = across * weights, down * weights
        weights *= near
        functions = np.stack([weights, weights * p, weights * q, weights * p * p, weights * q * q, across, down,
                              across * p, down * q])  # fmt: skip
        for own, factors in zip(self.own, self._point_factors(), strict=True):
            functions[:, own] = factors @ functions[:, own]
        return functions

    def _point_factors(self) -> np.ndarray:
        """[V, 9, 9]: these entries in factors of functions of what a photo shows of the point, listed above."""
        across, down, ahead = self.cameras.rotations.swapaxes(0, 1)  # [V, 3] each
        (fx, fy), (i, j) = self.cameras.focal.T[:, :, None], UPPER
        factors = np.zeros((len(fx), 9, 9))
        factors[:, :6, 0] = fx**2 * across[:, i] * across[:, j] + fy**2 * down[:, i] * down[:, j]
        for column, axis, focal in ((1, across, fx), (2, down, fy)):
            factors[:, :6, column] = -(focal**2) * (axis[:, i] * ahead[:, j] + ahead[:, i] * axis[:, j])
            factors[:, :6, column + 2] = focal**2 * ahead[:, i] * ahead[:, j]
            factors[:, 6:, column + 4] = focal * axis
            factors[:, 6:, column + 6] = -focal * ahead
        return factors

    def agreeing_cameras(self) -> Pinholes:
        """The cameras; the given one where its photo agrees no better."""
        old, new = self.first_errors, self._seen()[2]
        better = np.array([own.stop > own.start and np.median(new[own]) < np.median(old[own]) for own in self.own])
        pairs = zip(self.cameras, self.given, strict=True)
        return Pinholes(*(np.where(better.reshape(-1, *[1] * (now.ndim - 1)), now, then) for now, then in pairs))


def _solved(a, b, c, d, e, f, x, y, z) -> np.ndarray:
    """[3, M]: the solutions of M systems ((a, b, c), (b, d, e), (c, e, f)) s = (x, y, z), by Cramer's rule."""
    aa, ab, ac, bb, bc, cc = d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * aa + b * ab + c * ac
    return np.stack([aa * x + ab * y + ac * z, ab * x + bb * y + bc * z, ac * x + bc * y + cc * z]) / determinant


def _rotations(vectors: np.ndarray) -> np.ndarray:
    """[V, 3, 3] of rotation vectors [V, 3] (Rodrigues)."""
    angles = np.linalg.norm(vectors, axis=1)[:, None, None]
    cross = np.cross(np.eye(3), vectors[:, None])  # `cross @ a` is the cross product with `a`
    return np.eye(3) + np.sinc(angles / np.pi) * cross + 0.5 * np.sinc(angles / (2 * np.pi)) ** 2 * (cross @ cross)


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
