"""Samplers of the training views of an iteration (paper section 3.4)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from turbogs_plugin.engine.reference.philox import PURPOSE_STACK, PURPOSE_VIEWS, host_words
from turbogs_plugin.errors import require
from turbogs_plugin.strategies.checks import require_settings
from turbogs_plugin.types import Cameras, Step

DOUBTED_FROM = 0.2
"""Share of densification after which photos are doubted: before, the model says little about them."""
DOUBT_SPREADS, DOUBT_RATIO = 6.0, 2.5
"""Robust standard deviations of the logarithms of all photos' errors, and times their median, that the error of a
doubted photo exceeds."""
DOUBTED_SHARE = 0.2
"""Share of the rounds through all photos that a doubted photo takes part in, so that its error stays known."""


def doubted(view_errors: np.ndarray) -> np.ndarray:
    """[V] bool: photos that the model does not explain as it does the others, such as photos with a wrong pose.

    Their error is far above all others': by `DOUBT_SPREADS` of the spread of the errors and `DOUBT_RATIO` times the
    median.

    Args:
        view_errors: [V] float64, mean error of each view.
    """
    logarithms = np.log(np.maximum(view_errors, 1e-12))
    middle = np.median(logarithms)
    spread = 1.4826 * np.median(np.abs(logarithms - middle))  # of a normal distribution, its standard deviation
    return logarithms > middle + max(np.log(DOUBT_RATIO), DOUBT_SPREADS * spread)


def _uniforms(purpose: int, num_views: int, step: Step) -> np.ndarray:
    """[V] float64 in (0, 1) with 52 random bits, a function of (seed, iteration, view) alone."""
    high, low, *_ = host_words(purpose, num_views, step)
    return (high * 2.0**20 + (low >> 12) + 0.5) / 2.0**52


@dataclass
class RandomViewSampler:
    """Uniformly random views, none twice until nearly all have been seen, as in 3DGS.

    Views come from a shuffled stack. Drawn views leave it, and it is filled again when fewer than K are left. Doubted
    photos (`doubted`) come onto it in one of five rounds, which 3DGS has not: four wrong poses among 37 cost 1.31 dB
    without that, .31 with it, one costs .10 and nothing (fox, two seeds, doubted from 1.5 times and 5 spreads on).
    """

    stack: np.ndarray = field(init=False, repr=False, compare=False)  # the views left, int64
    num_views: int = field(init=False, repr=False)  # V

    def setup(self, cameras: Cameras, scene_extent: float) -> None:
        """Begin with an empty stack for the V training cameras."""
        self.stack, self.num_views = np.zeros(0, dtype=np.int64), len(cameras)

    def select(self, count: int, view_errors: np.ndarray, step: Step) -> tuple[int, ...]:
        """`count` distinct views, or all V where `count` is more. `view_errors`: [V] float64, by which some wait."""
        count = self._fill(count, step, view_errors if step.progress >= DOUBTED_FROM else None)
        taken, self.stack = self.stack[:count], self.stack[count:]
        return tuple(taken.tolist())

    def _fill(self, count: int, step: Step, view_errors: np.ndarray | None = None) -> int:
        """Fill the stack again if it holds fewer than `count` views. Returns `count`, at most V.

        Args:
            view_errors: [V] by which views are doubted, and come in one of some rounds, where enough others are there;
                None: no view is doubted.
        """
        count = min(count, self.num_views)
        if len(self.stack) < count:
            uniforms = _uniforms(PURPOSE_STACK, self.num_views, step)
            self.stack = order = np.argsort(uniforms, kind="stable")
            if view_errors is not None:
                kept = order[~(doubted(view_errors) & (uniforms > DOUBTED_SHARE))[order]]
                self.stack = kept if len(kept) >= count else order
        return count

    def state_dict(self) -> dict[str, Any]:
        return {"stack": torch.from_numpy(self.stack.copy())}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load a saved stack. Raises `ValueError` if it does not hold distinct views of this scene."""
        views = state["stack"].cpu().numpy().copy()
        if len(np.unique(views)) != len(views) or not np.isin(views, np.arange(self.num_views)).all():
            raise ValueError(f"the saved stack does not hold distinct ones of {self.num_views} views")
        self.stack = views


@dataclass
class GeometryAwareViewSampler(RandomViewSampler):
    """The view with the largest mean error, and views near it with a similar direction (equation of section 3.4).

    The anchor a is the view with the largest mean error on the stack. (Among all views it would be the same one until
    its error falls.) The K - 1 others are drawn from the stack without replacement, view u with a probability
    proportional to ``exp(-lambda_d |c_u - c_a| / extent - lambda_theta (1 - <d_u, d_a>))``. The draw adds Gumbel noise
    to the logarithms and takes the largest sums: this equals the sequential draw, and no weight underflows. The drawn
    views leave the stack.

    Args:
        distance_weight: lambda_d, weight of the distance between cameras, in scene extents; the paper gives no value.
        direction_weight: lambda_theta, weight of the turn between cameras; the paper gives no value.
    """

    distance_weight: float = 2.0
    direction_weight: float = 2.0
    centers: np.ndarray = field(init=False, repr=False)  # [V, 3] float64, scene extents
    directions: np.ndarray = field(init=False, repr=False)  # [V, 3] float64

    def __post_init__(self) -> None:
        require_settings(self)

    def setup(self, cameras: Cameras, scene_extent: float) -> None:
        """Take the training cameras. With an extent of 0 (all cameras in one place) only the directions count."""
        require(math.isfinite(scene_extent) and scene_extent >= 0, "scene_extent", scene_extent, "finite and 0 or more")
        super().setup(cameras, scene_extent)
        self.centers = cameras.centers.double().cpu().numpy() / (scene_extent or 1.0)
        self.directions = cameras.directions.double().cpu().numpy()

    def log_weights(self, anchor: int) -> np.ndarray:
        """[V] float64: logarithm of the weight of each view, given the anchor."""
        distances = np.linalg.norm(self.centers - self.centers[anchor], axis=1)
        turns = 1.0 - self.directions @ self.directions[anchor]
        return -self.distance_weight * distances - self.direction_weight * turns

    def select(self, count: int, view_errors: np.ndarray, step: Step) -> tuple[int, ...]:
        """`count` distinct views (all V where `count` is more), the anchor first.

        Args:
            view_errors: [V] float64; among equal ones the stack's random order decides the anchor.
        """
        count = self._fill(count, step)
        anchor = int(np.argmax(view_errors[self.stack]))
        gumbel = -np.log(-np.log(_uniforms(PURPOSE_VIEWS, self.num_views, step)))
        scores = (self.log_weights(int(self.stack[anchor])) + gumbel)[self.stack]
        scores[anchor] = np.inf
        best = np.argsort(-scores, kind="stable")[:count]
        taken, self.stack = self.stack[best], np.delete(self.stack, best)
        return tuple(taken.tolist())
