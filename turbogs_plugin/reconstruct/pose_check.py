"""Wrong poses of a capture without points, which train to the end and show nothing: matches of its photos tell them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from turbogs_plugin.captures.matches import EPIPOLAR_SHARE, Pair, epipolar_distances, matches, rigid
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.agreement import likely_poses
from turbogs_plugin.scene.geometry import camera_centers, evenly
from turbogs_plugin.scene.scene import Scene
from turbogs_plugin.scene.sequence import neighbours

NEAR, SUCCESSIVE = 5, 8  # pairs of photos by their poses, and by their names, at most
FEWEST_MATCHES, SHARE, FACTOR = 40, 0.5, 3
"""Matches that tell; the share of them that agrees with other poses, and its ratio to the share that agrees with the
given ones, where these are wrong. Of seven captures .77 to .99 agree with the right poses, at most .29 with others."""
FEWEST_PAIRS, FEWEST_RIGID, RIGID_SHARE = 4, 30, 0.5
"""Pairs that tell, and their matches that two cameras in some place agree with: number, and share of the pair's."""
FAR, CONTRADICTED = 0.03, 0.4
"""Distance from epipolar lines, at a focal length of 1, and the share of rigid matches that are nearer, in the upper
quartile of the pairs, below which poses are of other photos. On five captures it is 1 with the right poses, .87 or more
where each is turned by 2 degrees and moved by 1 % of the extent (150 draws); below .4 in 139 of 150 shuffles."""


def require_poses(scene: Scene) -> None:
    """Refuse a scene whose photos contradict its poses: `InputError` with the likely cause and the remedy."""
    views, poses = scene.train, scene.frame.restore_poses(scene.train.cameras.viewmats.cpu().numpy())
    pairs = [matches(views, *pair) for pair in _near(poses)]
    count, given = votes(pairs, poses)
    if count >= FEWEST_MATCHES and given > SHARE * count:
        return
    pairs += [matches(views, *pair) for pair in _successive(views.names)]
    count, given = votes(pairs, poses)
    for other, remedy in likely_poses(poses) if count >= FEWEST_MATCHES else ():
        _, agreeing = votes(pairs, other)
        if agreeing > SHARE * count and agreeing > FACTOR * given:
            told = f"{agreeing} of {count} matches of photos agree with other poses, {given} with these"
            raise InputError(f"'{scene.name}': {told}: {remedy}; scene.force=true trains all the same")
    shares = [share for pair in pairs for share in _share_near_lines(pair, poses)]
    if len(shares) >= FEWEST_PAIRS and np.quantile(shares, 0.75) < CONTRADICTED:
        told = f"in {len(shares)} pairs of photos the matches contradict the poses"
        remedy = "give each photo its own pose and intrinsics, and leave photos as they were when these were found"
        raise InputError(f"'{scene.name}': {told}: {remedy}; scene.force=true trains all the same")


def votes(pairs: Sequence[Pair], poses: np.ndarray) -> tuple[int, int]:
    """Matches, and how many of them two cameras of these poses ([V, 4, 4] world to camera) see as one point."""
    agreeing = 0
    for one, other, first, second in pairs:
        relative = poses[other] @ np.linalg.inv(poses[one])
        turned, shift = first @ relative[:3, :3].T, relative[:3, 3]
        # Depths a and b with a turned + shift = b second, by least squares; of parallel rays neither is positive.
        aa, ab, bb = (turned**2).sum(axis=1), (turned * second).sum(axis=1), (second**2).sum(axis=1)
        a, b = (second @ shift) * ab - (turned @ shift) * bb, (second @ shift) * aa - (turned @ shift) * ab
        agreeing += int(((a > 0) & (b > 0) & (epipolar_distances(relative, first, second) < EPIPOLAR_SHARE)).sum())
    return sum(len(pair[2]) for pair in pairs), agreeing


def _near(poses: np.ndarray) -> list[tuple[int, int]]:
    """Pairs of photos whose cameras are near to each other and look the same way."""
    centers, pairs = camera_centers(poses), []
    for first in evenly(len(poses), NEAR):
        distances = np.linalg.norm(centers - centers[first], axis=1)
        same_way = poses[:, 2, :3] @ poses[first, 2, :3] > 0.8  # 37 degrees
        distances[~same_way | (distances <= 1e-6 * distances.max())] = np.inf
        if np.isfinite(distances.min()):
            pairs.append((first, int(distances.argmin())))
    return pairs


def _successive(names: Sequence[str]) -> list[tuple[int, int]]:
    """Pairs of photos that follow each other by their names."""
    before = neighbours(names, names, names).rows[:, 0].tolist()
    return [(before[view], view) for view in evenly(len(names), SUCCESSIVE + 1) if before[view] != view]


def _share_near_lines(pair: Pair, poses: np.ndarray) -> list[float]:
    """The share of a pair's rigid matches that is near the epipolar lines of its poses; none where they do not tell."""
    one, other, first, second = pair
    if len(first) < FEWEST_RIGID or (keep := rigid(pair)).sum() < max(FEWEST_RIGID, RIGID_SHARE * len(first)):
        return []
    relative = poses[other] @ np.linalg.inv(poses[one])
    return [float((epipolar_distances(relative, first[keep], second[keep]) < FAR).mean())]
