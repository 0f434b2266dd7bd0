"""The interface of an engine, which does all computation of a training on its device.

A trainer needs no more than `Engine`. `engine.shared` has the defaults, `engine.reference` the definition of every
result, `engine.cuda` its twin; `distributed.ranks_engine` is an engine of several GPUs around one of these.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from torch import Tensor

from turbogs_plugin.engine.moments import GaussianMoments
from turbogs_plugin.engine.render_pass import DEFAULT_OPTIONS, Rendered, RenderOptions, ScreenGradients
from turbogs_plugin.engine.rules import DrawRule, LossTerms, UpdateRule
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.types import (
    Cameras,
    Color,
    Gaussians,
    GaussianStats,
    LossOutput,
    PixelSamples,
    RowUpdate,
    Step,
)


@dataclass(frozen=True)
class MapUpdate:
    """The error maps, and the counter that the losses of an iteration are added to.

    Args:
        maps: of all views; updated in place.
        step: gives the stamp.
        nonfinite_losses: [] int64 on the device; 1 is added if the loss is not finite.
    """

    maps: ErrorMaps
    step: Step
    nonfinite_losses: Tensor | None = None


class StoredPhotos(Protocol):
    """Photos as they are stored."""

    @property
    def colors(self) -> Tensor:
        """[X, 3 or 4] uint8, the pixels of all training views, one view after the other."""


class GroundTruth(Protocol):
    """The photos at the samples of an iteration, which an engine may gather itself (`scene.photos.PhotoSamples`)."""

    @property
    def samples(self) -> PixelSamples: ...

    @property
    def photos(self) -> StoredPhotos: ...

    @property
    def background(self) -> Color:
        """Colour that shows through photos with an alpha."""

    @property
    def starts(self) -> np.ndarray:
        """[K] int64: the first row of `photos.colors` of each view of the batch."""

    def colors(self) -> Tensor:
        """[P, 3] float32, 0 .. 1: the colours at the samples, 0 in empty slots."""


class Engine(Protocol):
    """Does all computation, on the device of the given tensors.

    An engine knows rules, never strategies. `ReferenceEngine` defines every result; any other engine gives the same up
    to rounding. `supervise`, `evaluate_and_learn` and `update` each consist of two operations, which an engine may fuse
    into one. With an engine made for training the host does not wait for the device (see `settle`), and a pass may
    overwrite the tensors of the one before: all but samples and the value of the loss.
    """

    @property
    def overflow(self) -> Tensor | None:
        """[1] int32 on the device, never read on the host. While it is not 0, iterations are *skipped*: they change
        nothing, because a buffer was too small. None if that cannot happen."""

    @property
    def bytes_held(self) -> int:
        """Bytes of memory kept from one iteration to the next."""

    @abstractmethod
    def draw(self, rule: DrawRule, maps: ErrorMaps, view_ids: tuple[int, ...], rate: float, step: Step) -> PixelSamples:
        """Draw the samples of an iteration.

        Args:
            maps: of all views.
            view_ids: K training views.
            rate: r, the fraction of units to draw, above 0.
            step: gives seed and iteration, which decide the random numbers, and the ages.
        """

    @abstractmethod
    def render(
        self, gaussians: Gaussians, cameras: Cameras, samples: PixelSamples, options: RenderOptions = DEFAULT_OPTIONS
    ) -> Rendered:
        """Render samples of K views with gsplat's conventions.

        Args:
            cameras: the K views of the batch, in the order of `samples.view_ids`.
        """

    @abstractmethod
    def evaluate(self, terms: LossTerms, colors: Tensor, targets: Tensor, samples: PixelSamples) -> LossOutput:
        """The loss of rendered samples and its gradient. `colors`, `targets`: [P, 3]."""

    def learn(self, samples: PixelSamples, colors: Tensor, output: LossOutput, update: MapUpdate) -> None:
        """Update the error maps (nothing is trained here) with the errors of an iteration, from any loss.

        A sample with a non-finite rendered colour (of `colors` [P, 3]) or error counts as not sampled: the error and
        the stamp of its pixel stay. A skipped iteration (see `overflow`) changes nothing here.
        """

    def evaluate_and_learn(
        self, terms: LossTerms, colors: Tensor, targets: Tensor, samples: PixelSamples, update: MapUpdate
    ) -> LossOutput:
        """`evaluate`, then `learn`."""

    def supervise(self, terms: LossTerms, colors: Tensor, truth: GroundTruth, update: MapUpdate) -> LossOutput:
        """`evaluate` against the photos at the samples, then `learn`. `colors`: [P, 3], on the engine's device."""

    def update(
        self,
        rule: UpdateRule,
        screen: ScreenGradients,
        gaussians: Gaussians,
        moments: GaussianMoments,
        stats: GaussianStats | None,
    ) -> None:
        """Take gradients from the screen to the parameters, and make one step with them.

        Args:
            rule: which step.
            screen: from a backward pass of this engine; it cannot be used again.
            gaussians: the model that was rendered; changed in place, as is `moments`.
            stats: the statistics of density control, to which this pass is added; None if not needed.
        """

    def settle(self, wait: bool = False) -> int:
        """How many of the latest iterations were skipped for lack of device memory, and must be done again.

        Until this is called, iterations after such a one are skipped, too: no map, parameter, moment or statistic
        changes. A trainer calls it before each iteration.

        Args:
            wait: wait for the device, to know of all; else only what is known already counts.

        Raises:
            InputError: an iteration has more intersections of a tile and a splat than a pass can have.
        """

    # What follows is done at once on one device. An engine of several devices spreads work and state over them.

    def place(self, gaussians: Gaussians) -> Gaussians:
        """The model where the engine's steps change it: the given one, or a copy over the one placed before."""

    def each_view(self, errors_of: Callable[[int], Tensor], pixels: Sequence[int]) -> Iterator[Tensor]:
        """The errors [pixels] of one training view after the other, which `errors_of` renders. `pixels`: of each."""

    def complete(self, moments: GaussianMoments | None, stats: GaussianStats | None) -> None:
        """Make every row of the moments and the statistics valid, before they are read: after `update` some may not be.

        Args:
            moments: None where the statistics alone will be read, and more updates follow.
        """

    def agreed(self, update: RowUpdate | None) -> RowUpdate | None:
        """The change of the set of Gaussians that is made, where density control proposes this one."""

    def verify(self, state: Callable[[], dict[str, Any]]) -> None:
        """Check a complete state before it is evaluated or saved.

        Args:
            state: gives it as nested dicts of tensors and numbers; ``iteration`` is among them.

        Raises:
            TrainingStopped: devices hold different states.
        """
