"""Bundle adjustment: each photo's own pinhole camera, from where the photo shows the points of a reconstruction.

Reconstructions give all photos of a camera the same lens. A phone's or a drone's photos are not of one: the stabiliser
shifts lens and sensor, focusing changes the focal length, and a rolling shutter shears what moves. The errors are up to
half a pixel and systematic across a photo, so photos contradict one another, and a model of them is blurred. Here each
photo gets its own pose, focal lengths and principal point: cameras and points in turn, by Gauss-Newton steps on squares
that are reweighted by Cauchy's rule (Triggs et al., Bundle Adjustment: A Modern Synthesis, 2000).

A prior holds cameras to those that were given: a normal distribution of ten parameters, whose covariance is learnt from
all photos by expectation-maximisation. So where one lens is right for all of them, cameras stay what they were, however
few points a photo shows.

All is float64 on the CPU, and the same to the bit in every run, so that a resumed training has the same cameras.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace

import numpy as np

from turbogs_plugin.scene.observations import Observations

ROUNDS, CAMERA_STEPS, POINT_STEPS = 6, 2, 1
RESECTION_STEPS = 10
PRIOR = 0.006
"""Standard deviation of every parameter of a camera before any is learnt, in the units of `Pinholes.moved`: four to six
pixels at the edge of a photo of 1200."""
SMALLEST_VARIANCE = 1e-14
"""Of the prior, so that it can be inverted."""
POINT_DAMPING = 1e-4
"""Of a point's normal equations, relative to their trace: in a direction that no photo tells, a point stays."""
FEWEST_OBSERVATIONS = 30
"""A photo with fewer keeps its camera: three a parameter."""
FINEST = 0.02
"""Pixels: errors below are not taken for noise of the features, however exact a reconstruction is."""
FARTHEST_MATCH = 0.02
"""Of a photo's width: where half of the points are farther than that from where photos show them, the photos are not
those that were reconstructed."""
PARAMETERS = 10
UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Of a symmetric 3x3 matrix, the entries that are computed."""
CHUNK = 30_000
"""Observations at once."""


@dataclass(frozen=True)
class Pinholes:
    """V cameras in float64.

    Args:
        rotations: [V, 3, 3], world to camera.
        translations: [V, 3].
        focal: [V, 2], pixels.
        centers: [V, 2], principal points, pixels.
        half_widths: [V], pixels.
    """

    rotations: np.ndarray
    translations: np.ndarray
    focal: np.ndarray
    centers: np.ndarray
    half_widths: np.ndarray

    @classmethod
    def of(cls, viewmats: np.ndarray, Ks: np.ndarray, sizes: np.ndarray) -> Pinholes:
        """From world to camera [V, 4, 4], intrinsics [V, 3, 3] in pixels, and sizes [V, 2] (width, height)."""
        return cls(viewmats[:, :3, :3], viewmats[:, :3, 3], Ks[:, [0, 1], [0, 1]], Ks[:, :2, 2], 0.5 * sizes[:, 0])

    def where(self, kept: np.ndarray, others: Pinholes) -> Pinholes:
        """These where `kept` [V] bool, elsewhere the others."""
        pairs = ((getattr(self, field.name), getattr(others, field.name)) for field in fields(Pinholes))
        return Pinholes(*(np.where(kept.reshape(-1, *[1] * (own.ndim - 1)), own, other) for own, other in pairs))

    def moved(self, by: np.ndarray, depths: np.ndarray) -> Pinholes:
        """The cameras after a step.

        Args:
            by: [V, PARAMETERS]: rotation vector (3), in radians; translation (3), in `depths`; focal lengths (2),
                relative; principal point (2), in half widths.
            depths: [V], of what is before each camera.
        """
        turns = _rotations(by[:, :3])
        translations = np.einsum("vij,vj->vi", turns, self.translations) + by[:, 3:6] * depths[:, None]
        return replace(
            self,
            rotations=turns @ self.rotations,
            translations=translations,
            focal=self.focal * (1.0 + by[:, 6:8]),
            centers=self.centers + by[:, 8:] * self.half_widths[:, None],
        )


@dataclass(frozen=True)
class Refinement:
    """Cameras and points that agree better with one another.

    Args:
        cameras, points: of the same photos, and [M, 3].
        spread: [PARAMETERS, PARAMETERS] covariance of how cameras differ from those that were given, in the units of
            `Pinholes.moved`.
        count: how many cameras are others than those that were given.
        before, after: medians of `reprojection_errors`, in pixels.
    """

    cameras: Pinholes
    points: np.ndarray
    spread: np.ndarray
    count: int
    before: float
    after: float

    def text(self, called: str) -> str:
        """What was done, in a line. `called`: what the cameras are."""
        return (
            f"{self.count} of {len(self.cameras.focal)} {called} refined, each with a lens of its own: points are "
            f"{self.after:.2f} pixels from where photos show them, {self.before:.2f} before (medians)"
        )


def refine_together(cameras: Pinholes, points: np.ndarray, observations: Observations) -> Refinement:
    """Cameras and points that agree better with one another.

    Args:
        cameras: as they were given.
        points: [M, 3] float64.
        observations: of these points by these cameras.
    """
    adjustment = _Adjustment(cameras, points, observations)
    with ThreadPoolExecutor() as pool:
        for _ in range(ROUNDS):
            for _ in range(CAMERA_STEPS):
                adjustment.move_cameras(pool)
                adjustment.learn_spread()
            for _ in range(POINT_STEPS):
                adjustment.move_points(pool)
    refined, moved = adjustment.agreeing_cameras(), adjustment.points
    count = int((refined.focal != cameras.focal).any(axis=1).sum())
    medians = (_median(adjustment.first_errors), _median(reprojection_errors(refined, moved, observations)))
    return Refinement(refined, moved, adjustment.spread, count, *medians)


def refine_alone(
    cameras: Pinholes, points: np.ndarray, observations: Observations, spread: np.ndarray | None = None
) -> Pinholes:
    """Cameras that agree better with points, which stay.

    Args:
        cameras, points, observations: as in `refine_together`.
        spread: of a `Refinement` of other photos of the capture; None: `PRIOR` of each parameter.
    """
    adjustment = _Adjustment(cameras, points, observations, spread)
    with ThreadPoolExecutor() as pool:
        for _ in range(RESECTION_STEPS):
            adjustment.move_cameras(pool)
    return adjustment.agreeing_cameras()


def _median(errors: np.ndarray) -> float:
    """0 where there are none."""
    return float(np.median(errors)) if len(errors) else 0.0


def reprojection_errors(cameras: Pinholes, points: np.ndarray, observations: Observations) -> np.ndarray:
    """[O] pixels between where cameras see points and where photos show them; infinite behind a camera."""
    return _Adjustment(cameras, points, observations).first_errors


def farthest_match(cameras: Pinholes) -> float:
    """`FARTHEST_MATCH` in pixels."""
    return FARTHEST_MATCH * 2.0 * float(np.median(cameras.half_widths))


def of_these_photos(cameras: Pinholes, points: np.ndarray, observations: Observations) -> bool:
    """Whether observations are of the photos of these cameras, and not of others or in another size: half of the points
    are within `farthest_match`."""
    return _median(reprojection_errors(cameras, points, observations)) <= farthest_match(cameras)


def _quietly(function: Callable) -> Callable:
    """Without numpy's warnings: what is not finite gets a weight of zero. Threads of a pool have settings of their own,
    so it is for what they run."""

    @functools.wraps(function)
    def quiet(*arguments):
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return function(*arguments)

    return quiet


class _Adjustment:
    """Cameras and points on their way. What observations have is coordinate by coordinate, [2, O] or [3, O]: a row is
    read and written in one go.

    Attributes:
        places: [3, M], the points.
        pixels: [2, O], where photos show them.
        moves: [V, PARAMETERS], how far each camera has come.
        spread: [PARAMETERS, PARAMETERS], the prior's covariance of these.
        doubts: [V, PARAMETERS, PARAMETERS], the covariance of each camera's moves that is left by what the photo shows
            and the prior; zero where the photo shows too little to be refined.
        depths: [V], medians of the points before each camera.
        first_errors: [O] pixels, before the first step.
        scale: pixels, the median of these: errors far above it count little.
    """

    def __init__(
        self, cameras: Pinholes, points: np.ndarray, observations: Observations, spread: np.ndarray | None = None
    ) -> None:
        self.given = self.cameras = cameras
        views = len(cameras.focal)
        self.places, self.pixels = (np.array(rows.T, order="C") for rows in (points, observations.pixels))
        self.point_ids = observations.point_ids
        self.starts = np.searchsorted(observations.view_ids, np.arange(views + 1))
        self.moves = np.zeros((views, PARAMETERS))
        self.spread = PRIOR**2 * np.eye(PARAMETERS) if spread is None else spread
        self.doubts = np.zeros((views, PARAMETERS, PARAMETERS))
        bounds = [0]  # of views together, so that a step has few large operations
        for view in range(views):
            if self.starts[view + 1] - self.starts[bounds[-1]] > CHUNK and view > bounds[-1]:
                bounds.append(view)
        self.chunks = list(zip(bounds, [*bounds[1:], views], strict=True))
        seen = [self._seen(*chunk) for chunk in self.chunks]
        depths = self._by_view(np.concatenate([in_camera[2] for in_camera, _, _ in seen]))
        self.depths = np.array([np.median(part) if len(part) else 1.0 for part in depths])
        self.first_errors = np.concatenate([errors for _, _, errors in seen])
        self.scale = max(_median(self.first_errors), FINEST)

    @property
    def points(self) -> np.ndarray:
        """[M, 3]."""
        return np.ascontiguousarray(self.places.T)

    def _by_view(self, values: np.ndarray) -> list[np.ndarray]:
        return np.split(values, self.starts[1:-1])

    def _each(self, values: np.ndarray, first: int, last: int) -> np.ndarray:
        """[..., n]: of each observation of views `first` to `last`, what [V, ...] `values` have of its view."""
        counts = np.diff(self.starts[first : last + 1])
        return np.repeat(np.moveaxis(values[first:last], 0, -1), counts, axis=-1)

    @_quietly
    def _seen(self, first: int, last: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of the observations of views: points in the camera [3, n]; residuals [2, n]; their lengths [n], infinite
        behind the camera."""
        part, cameras = slice(self.starts[first], self.starts[last]), self.cameras
        in_camera = np.take(self.places, self.point_ids[part], axis=1)
        for view, (begin, end) in enumerate(itertools.pairwise(self.starts[first : last + 1] - part.start), first):
            own = in_camera[:, begin:end]
            own[:] = cameras.rotations[view] @ own + cameras.translations[view][:, None]
        slopes = in_camera[:2] / in_camera[2]
        seen_at = slopes * self._each(cameras.focal, first, last) + self._each(cameras.centers, first, last)
        residuals = self.pixels[:, part] - seen_at
        errors = np.sqrt((residuals * residuals).sum(axis=0))
        return in_camera, residuals, np.where((in_camera[2] > 0) & np.isfinite(errors), errors, math.inf)

    def _weights(self, errors: np.ndarray) -> np.ndarray:
        """[n] Cauchy's, in units of the noise; 0 where the error is infinite."""
        return 1.0 / (self.scale**2 + errors * errors)

    def move_cameras(self, pool: ThreadPoolExecutor) -> None:
        """One step of every camera."""
        steps = np.concatenate(list(pool.map(self._camera_steps, *zip(*self.chunks, strict=True))))
        self.moves += steps
        self.cameras = self.cameras.moved(steps, self.depths)

    @_quietly
    def _camera_steps(self, first: int, last: int) -> np.ndarray:
        """[last - first, PARAMETERS]."""
        in_camera, residuals, errors = self._seen(first, last)
        weights = self._weights(errors)
        (p, q), z = in_camera[:2] / in_camera[2], in_camera[2]
        (fx, fy), half, depth = (
            self._each(values, first, last) for values in (self.cameras.focal, self.cameras.half_widths, self.depths)
        )
        depth /= z
        zero = np.zeros_like(p)
        # d pixel / d parameter [PARAMETERS, n], of its x and of its y.
        across = np.stack([-fx * p * q, fx * (1 + p * p), -fx * q, fx * depth, zero, -fx * p * depth, fx * p, zero,
                           half, zero])  # fmt: skip
        down = np.stack([-fy * (1 + q * q), fy * p * q, fy * p, zero, fy * depth, -fy * q * depth, zero, fy * q, zero,
                         half])  # fmt: skip
        left_out = weights == 0
        across[:, left_out], down[:, left_out], residuals[:, left_out] = 0.0, 0.0, 0.0
        weighted_across, weighted_down = across * weights, down * weights
        steps = np.zeros((last - first, PARAMETERS))
        starts = self.starts[first : last + 1] - self.starts[first]
        prior = np.linalg.inv(self.spread)
        for view, (begin, end) in enumerate(itertools.pairwise(starts)):
            if end - begin < FEWEST_OBSERVATIONS:
                continue
            part = slice(begin, end)
            normal = across[:, part] @ weighted_across[:, part].T + down[:, part] @ weighted_down[:, part].T + prior
            slope = weighted_across[:, part] @ residuals[0, part] + weighted_down[:, part] @ residuals[1, part]
            self.doubts[first + view] = np.linalg.inv(normal)
            steps[view] = self.doubts[first + view] @ (slope - prior @ self.moves[first + view])
        return steps

    def learn_spread(self) -> None:
        """One step of expectation-maximisation of the prior."""
        refined = self.doubts[:, 0, 0] > 0
        if refined.any():
            squares = self.moves[refined].T @ self.moves[refined] + self.doubts[refined].sum(axis=0)
            self.spread = squares / refined.sum() + SMALLEST_VARIANCE * np.eye(PARAMETERS)

    def move_points(self, pool: ThreadPoolExecutor) -> None:
        """One step of every point that two photos show."""
        entries = np.concatenate(list(pool.map(self._point_entries, *zip(*self.chunks, strict=True))), axis=1)
        count = self.places.shape[1]
        sums = np.stack(list(pool.map(self._sum_by_point, entries)))  # [9, M]
        normal = sums[[0, 1, 2, 1, 3, 4, 2, 4, 5]].T.reshape(count, 3, 3)
        traces = np.trace(normal, axis1=1, axis2=2)
        told = (np.bincount(self.point_ids, entries[0] > 0, count) >= 2) & (traces > 0)
        normal = normal[told] + (POINT_DAMPING * traces[told])[:, None, None] * np.eye(3)
        self.places[:, told] += np.linalg.solve(normal, sums[6:].T[told][:, :, None])[:, :, 0].T

    @_quietly
    def _point_entries(self, first: int, last: int) -> np.ndarray:
        """[9, n]: six of a symmetric matrix and three of a vector, of each observation's normal equations."""
        in_camera, residuals, errors = self._seen(first, last)
        weights = self._weights(errors)
        slopes, scales = in_camera[:2] / in_camera[2], self._each(self.cameras.focal, first, last) / in_camera[2]
        rotations = self._each(self.cameras.rotations, first, last)  # [3, 3, n]
        across, down = (scales[axis] * (rotations[axis] - slopes[axis] * rotations[2]) for axis in range(2))  # [3, n]
        left_out = weights == 0
        across[:, left_out], down[:, left_out], residuals[:, left_out] = 0.0, 0.0, 0.0
        weighted_across, weighted_down = across * weights, down * weights
        entries = np.empty((9, len(weights)))
        for row, (i, j) in enumerate(UPPER):
            entries[row] = weighted_across[i] * across[j] + weighted_down[i] * down[j]
        entries[6:] = weighted_across * residuals[0] + weighted_down * residuals[1]
        return entries

    def agreeing_cameras(self) -> Pinholes:
        """The cameras; the given one where its photo agrees no better."""
        pairs = zip(self._by_view(self.first_errors), self._by_view(self.errors()), strict=True)
        better = np.array([len(new) > 0 and np.median(new) < np.median(old) for old, new in pairs])
        return self.cameras.where(better, self.given)

    def errors(self) -> np.ndarray:
        """[O] pixels between where points are seen and where photos show them; infinite behind a camera."""
        return np.concatenate([self._seen(*chunk)[2] for chunk in self.chunks])

    def _sum_by_point(self, values: np.ndarray) -> np.ndarray:
        return np.bincount(self.point_ids, values, self.places.shape[1])


def _rotations(vectors: np.ndarray) -> np.ndarray:
    """[V, 3, 3] of rotation vectors [V, 3] (Rodrigues)."""
    angles = np.linalg.norm(vectors, axis=1)[:, None, None]
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    return np.eye(3) + np.sinc(angles / np.pi) * cross + 0.5 * np.sinc(angles / (2 * np.pi)) ** 2 * (cross @ cross)
