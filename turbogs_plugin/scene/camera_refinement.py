"""Each photo's own pinhole camera, from where the photo shows the points of a reconstruction.

Reconstructions give all photos of a camera the same lens. A phone's or a drone's photos are not of one: the stabiliser
shifts lens and sensor, focusing changes the focal length, and a rolling shutter shears what moves. The errors are up to
half a pixel and systematic across a photo, so photos contradict one another, and a model of them is blurred. Here each
photo gets its own pose, focal lengths and principal point, by bundle adjustment: cameras and points in turn, by
Gauss-Newton steps on reweighted squares (Cauchy), with a prior that holds cameras to those that were given.
"""

from __future__ import annotations

import itertools
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace

import numpy as np
import torch

from turbogs_plugin.scene.load import Scene
from turbogs_plugin.scene.observations import Observations
from turbogs_plugin.types import Cameras

ROUNDS, CAMERA_STEPS, POINT_STEPS = 6, 2, 1
RESECTION_STEPS = 10
PRIOR = 0.003
"""Standard deviation of every parameter of a camera, in half widths of the photo by which it moves a pixel at the edge:
1.8 pixels of a photo of 1200."""
POINT_DAMPING = 1e-4
"""Of a point's normal equations, relative to their trace: in a direction that no photo tells, a point stays."""
FEWEST_OBSERVATIONS = 30
"""A photo with fewer keeps its camera: three a parameter."""
FINEST = 0.02
"""Pixels: errors below are not taken for noise of the features, however exact a reconstruction is."""
PARAMETERS = 10
CHUNK = 100_000
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

    def like(self, cameras: Cameras) -> Cameras:
        """These as float32, for the images and on the device of other cameras."""
        viewmats, Ks = cameras.viewmats.cpu().double().numpy().copy(), cameras.Ks.cpu().double().numpy().copy()
        viewmats[:, :3, :3], viewmats[:, :3, 3] = self.rotations, self.translations
        Ks[:, [0, 1], [0, 1]], Ks[:, :2, 2] = self.focal, self.centers
        matrices = (torch.from_numpy(each).to(cameras.viewmats) for each in (viewmats, Ks))
        return Cameras(*matrices, cameras.sizes)

    def where(self, kept: np.ndarray, others: Pinholes) -> Pinholes:
        """These where `kept` [V] bool, elsewhere the others."""
        pairs = ((getattr(self, field.name), getattr(others, field.name)) for field in fields(Pinholes))
        return Pinholes(*(np.where(kept.reshape(-1, *[1] * (own.ndim - 1)), own, other) for own, other in pairs))

    def moved(self, by: np.ndarray, depths: np.ndarray) -> Pinholes:
        """The cameras after a step.

        Args:
            by: [V, PARAMETERS]: rotation (3), translation (3), focal lengths (2), principal point (2), in half widths
                by which a pixel at the edge moves.
            depths: [V] of the points before each camera.
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


def refine_cameras(scene: Scene) -> Scene:
    """A scene whose training photos have cameras of their own.

    Cameras and points are refined by what training photos show. The test photos keep their cameras, as errors are to be
    compared with those of other programs. They get others beside them (`PosedImages.refined`), found by where the photo
    shows the points.

    Args:
        scene: as it was loaded.

    Returns:
        The same scene, where its capture does not say where photos show the points.
    """
    train, test = scene.train, scene.test
    if train.observations is None or test.observations is None:
        return scene
    given = pinholes_of(train.cameras)
    cameras, points = refine_together(given, scene.points.double().numpy(), train.observations)
    tested = refine_alone(pinholes_of(test.cameras), points, test.observations)
    count = int((cameras.focal != given.focal).any(axis=1).sum())
    if not count:
        return scene
    before = median_error(given, scene.points.double().numpy(), train.observations)
    after = median_error(cameras, points, train.observations)
    note = (
        f"{count} of {len(train)} training cameras refined, each with a lens of its own: points are {after:.2f} pixels "
        f"from where photos show them, {before:.2f} before (medians)"
    )
    return replace(
        scene,
        train=replace(train, cameras=cameras.like(train.cameras)),
        test=replace(test, refined=tested.like(test.cameras)),
        points=torch.from_numpy(points).float(),
        notes=(*scene.notes, note),
    )


def pinholes_of(cameras: Cameras) -> Pinholes:
    """The same cameras."""
    viewmats, Ks = (matrices.cpu().double().numpy() for matrices in (cameras.viewmats, cameras.Ks))
    half_widths = 0.5 * cameras.sizes[:, 0]
    return Pinholes(viewmats[:, :3, :3], viewmats[:, :3, 3], Ks[:, [0, 1], [0, 1]], Ks[:, :2, 2], half_widths)


def median_error(cameras: Pinholes, points: np.ndarray, observations: Observations) -> float:
    """How far points are from where photos show them, in pixels; NaN where photos show none."""
    errors = _Problem(cameras, points, observations).errors()
    return float(np.median(errors)) if len(errors) else math.nan


def refine_together(cameras: Pinholes, points: np.ndarray, observations: Observations) -> tuple[Pinholes, np.ndarray]:
    """Cameras and points that agree better with one another.

    Args:
        cameras: as they were given.
        points: [M, 3] float64.
        observations: of these points by these cameras.

    Returns:
        The cameras, and points [M, 3].
    """
    problem = _Problem(cameras, points, observations)
    with ThreadPoolExecutor() as pool:
        for _ in range(ROUNDS):
            for _ in range(CAMERA_STEPS):
                problem.move_cameras(pool)
            for _ in range(POINT_STEPS):
                problem.move_points(pool)
    return problem.result()


def refine_alone(cameras: Pinholes, points: np.ndarray, observations: Observations) -> Pinholes:
    """Cameras that agree better with points, which stay.

    Args:
        cameras, points, observations: as in `refine_together`.
    """
    problem = _Problem(cameras, points, observations)
    with ThreadPoolExecutor() as pool:
        for _ in range(RESECTION_STEPS):
            problem.move_cameras(pool)
    return problem.result()[0]


class _Problem:
    """Cameras and points on their way. `moves` [V, PARAMETERS] is how far each camera has come, for the prior."""

    def __init__(self, cameras: Pinholes, points: np.ndarray, observations: Observations) -> None:
        views = len(cameras.focal)
        self.given = self.cameras = cameras
        self.given_points, self.points, self.observations = points, points.copy(), observations
        self.starts = np.searchsorted(observations.view_ids, np.arange(views + 1))
        self.counts = np.diff(self.starts)
        self.moves = np.zeros((views, PARAMETERS))
        bounds = [0]  # of views together, so that a step has few large operations
        for view in range(views):
            if self.starts[view + 1] - self.starts[bounds[-1]] > CHUNK and view > bounds[-1]:
                bounds.append(view)
        self.chunks = list(zip(bounds, [*bounds[1:], views], strict=True))
        self.depths = np.ones(views)
        for chunk in self.chunks:
            depths = np.split(self._seen(*chunk)[0][:, 2], self.starts[chunk[0] + 1 : chunk[1]] - self.starts[chunk[0]])
            self.depths[slice(*chunk)] = [np.median(part) if len(part) else 1.0 for part in depths]
        self.first_errors = self.errors()
        self.scale = max(float(np.median(self.first_errors)) if len(observations) else 0.0, FINEST)

    def _by_view(self, values: np.ndarray) -> list[np.ndarray]:
        return np.split(values, self.starts[1:-1])

    def _seen(self, first: int, last: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of the observations of views: points in the camera [n, 3], residuals [n, 2] and their lengths [n]."""
        part, cameras = slice(self.starts[first], self.starts[last]), self.cameras
        views = self.observations.view_ids[part]
        in_camera = self.points[self.observations.point_ids[part]]
        in_camera = np.einsum("nij,nj->ni", cameras.rotations[views], in_camera) + cameras.translations[views]
        slopes = in_camera[:, :2] / in_camera[:, 2:]
        residuals = self.observations.pixels[part] - (slopes * cameras.focal[views] + cameras.centers[views])
        return in_camera, residuals, np.hypot(residuals[:, 0], residuals[:, 1])

    def _weights(self, in_camera: np.ndarray, errors: np.ndarray) -> np.ndarray:
        """[n] Cauchy's, in units of the noise; none behind the camera."""
        weights = 1.0 / (self.scale**2 + errors**2)
        weights[~(in_camera[:, 2] > 0) | ~np.isfinite(errors)] = 0.0
        return weights

    def move_cameras(self, pool: ThreadPoolExecutor) -> None:
        steps = np.concatenate(list(pool.map(lambda chunk: self._camera_steps(*chunk), self.chunks)))
        self.moves += steps
        self.cameras = self.cameras.moved(steps, self.depths)

    def _camera_steps(self, first: int, last: int) -> np.ndarray:
        """[last - first, PARAMETERS]."""
        in_camera, residuals, errors = self._seen(first, last)
        weights = self._weights(in_camera, errors)
        views = self.observations.view_ids[self.starts[first] : self.starts[last]]
        focal, half = self.cameras.focal[views], self.cameras.half_widths[views]
        x, y, z = in_camera.T
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            p, q, depth = x / z, y / z, self.depths[views] / z
        zero = np.zeros_like(p)
        fx, fy = focal.T
        # d pixel / d parameter, a row for x and one for y.
        across = np.stack([-fx * p * q, fx * (1 + p * p), -fx * q, fx * depth, zero, -fx * p * depth, fx * p, zero,
                           half, zero], axis=1)  # fmt: skip
        down = np.stack([-fy * (1 + q * q), fy * p * q, fy * p, zero, fy * depth, -fy * q * depth, zero, fy * q, zero,
                         half], axis=1)  # fmt: skip
        across[weights == 0], down[weights == 0], residuals[weights == 0] = 0.0, 0.0, 0.0
        weights = weights[:, None]
        steps = np.zeros((last - first, PARAMETERS))
        starts = self.starts[first : last + 1] - self.starts[first]
        prior = np.eye(PARAMETERS) / PRIOR**2
        for view, (begin, end) in enumerate(itertools.pairwise(starts)):
            if end - begin < FEWEST_OBSERVATIONS:
                continue
            part = slice(begin, end)
            weighted_across, weighted_down = across[part] * weights[part], down[part] * weights[part]
            normal = across[part].T @ weighted_across + down[part].T @ weighted_down + prior
            slope = weighted_across.T @ residuals[part, 0] + weighted_down.T @ residuals[part, 1]
            steps[view] = np.linalg.solve(normal, slope - self.moves[first + view] / PRIOR**2)
        return steps

    def move_points(self, pool: ThreadPoolExecutor) -> None:
        entries = np.concatenate(list(pool.map(lambda chunk: self._point_entries(*chunk), self.chunks)), axis=1)
        ids, count = self.observations.point_ids, len(self.points)
        sums = np.stack([self._sum_by_point(row) for row in entries])  # [9, M]
        normal = sums[[0, 1, 2, 1, 3, 4, 2, 4, 5]].T.reshape(count, 3, 3)
        traces = np.trace(normal, axis1=1, axis2=2)
        told = (np.bincount(ids, entries[0] > 0, count) >= 2) & (traces > 0)
        normal = normal[told] + (POINT_DAMPING * traces[told])[:, None, None] * np.eye(3)
        self.points[told] += np.linalg.solve(normal, sums[6:].T[told][:, :, None])[:, :, 0]

    def _point_entries(self, first: int, last: int) -> np.ndarray:
        """[9, n]: six of a symmetric matrix and three of a vector, of each observation's normal equations."""
        in_camera, residuals, errors = self._seen(first, last)
        weights = self._weights(in_camera, errors)
        views = self.observations.view_ids[self.starts[first] : self.starts[last]]
        rotations = self.cameras.rotations[views]
        scales = self.cameras.focal[views] / in_camera[:, 2:]  # [n, 2]
        slopes = in_camera[:, :2] / in_camera[:, 2:]
        rows = scales[:, :, None] * (rotations[:, :2] - slopes[:, :, None] * rotations[:, 2:])  # [n, 2, 3]
        rows[weights == 0], residuals[weights == 0] = 0.0, 0.0
        entries = [(rows[:, :, i] * rows[:, :, j]).sum(axis=1) for i in range(3) for j in range(i, 3)]
        entries += [(rows[:, :, i] * residuals).sum(axis=1) for i in range(3)]
        return np.stack(entries) * weights

    def result(self) -> tuple[Pinholes, np.ndarray]:
        """Cameras and points; given ones where that agrees no better, or a photo shows too few points."""
        before, now = self.first_errors, self.errors()
        pairs = zip(self._by_view(before), self._by_view(now), strict=True)
        better = np.array([len(new) >= FEWEST_OBSERVATIONS and np.median(new) < np.median(old) for old, new in pairs])
        costs = [self._sum_by_point(np.log1p((errors / self.scale) ** 2)) for errors in (before, now)]
        moved = (costs[1] < costs[0])[:, None]
        return self.cameras.where(better, self.given), np.where(moved, self.points, self.given_points)

    def errors(self) -> np.ndarray:
        """[O] pixels between where points are seen and where photos show them; infinite behind a camera."""
        chunks = [self._seen(*chunk) for chunk in self.chunks]
        return np.concatenate([np.where(seen[:, 2] > 0, errors, math.inf) for seen, _, errors in chunks])

    def _sum_by_point(self, values: np.ndarray) -> np.ndarray:
        return np.bincount(self.observations.point_ids, values, len(self.points))


def _rotations(vectors: np.ndarray) -> np.ndarray:
    """[V, 3, 3] of rotation vectors [V, 3] (Rodrigues)."""
    angles = np.linalg.norm(vectors, axis=1)[:, None, None]
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    return np.eye(3) + np.sinc(angles / np.pi) * cross + 0.5 * np.sinc(angles / (2 * np.pi)) ** 2 * (cross @ cross)
