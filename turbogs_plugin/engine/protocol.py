"""The interface of an engine, which does all computation of a training on its device.

A trainer needs no more than `Engine`. `engine.reference` has the definition of every result, `engine.cuda` its twin,
`engine.shared` what both offer to `distributed.ranks_engine`, an engine of several GPUs around one of these.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from turbogs_plugin.engine.exposures import Exposures, expose, exposure_gradients, step_exposures
from turbogs_plugin.engine.moments import GaussianMoments
from turbogs_plugin.engine.render_pass import DEFAULT_OPTIONS, Rendered, RenderOptions, ScreenGradients
from turbogs_plugin.engine.rules import DrawRule, LossTerms, UpdateRule
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.scene.depths import DepthPair
from turbogs_plugin.scene.photos import PhotoSamples
from turbogs_plugin.types import Cameras, Gaussians, GaussianStats, LossOutput, PixelSamples, RowUpdate, Step


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
        return None

    @abstractmethod
    def draw(self, rule: DrawRule, maps: ErrorMaps, view_ids: tuple[int, ...], rate: float, step: Step) -> PixelSamples:
        """Draw the samples of an iteration in K training views. `maps`: of all views; `rate`: r, the fraction of units
        to draw, above 0; `step` gives the ages, and seed and iteration, which decide the random numbers."""

    @abstractmethod
    def render(
        self, gaussians: Gaussians, cameras: Cameras, samples: PixelSamples, options: RenderOptions = DEFAULT_OPTIONS
    ) -> Rendered:
        """Render samples of K views with gsplat's conventions. `cameras`: in the order of `samples.view_ids`."""

    @abstractmethod
    def evaluate(
        self, terms: LossTerms, colors: Tensor, targets: Tensor, samples: PixelSamples, depths: DepthPair | None = None
    ) -> LossOutput:
        """The loss of rendered samples and its gradient. `colors`, `targets`: [P, 3]; `depths`: for a depth term."""

    def learn(self, samples: PixelSamples, colors: Tensor, output: LossOutput, update: MapUpdate) -> None:
        """Update the error maps (nothing is trained here) with the errors of an iteration, from any loss.

        A sample with a non-finite rendered colour (of `colors` [P, 3]) or error counts as not sampled: the error and
        the stamp of its pixel stay. A skipped iteration (see `overflow`) changes nothing here.
        """
        drawn, nonfinite = torch.isfinite(colors).all(dim=1), ~output.loss.isfinite()
        if self.overflow is not None:
            drawn, nonfinite = drawn & (self.overflow == 0), nonfinite & (self.overflow[0] == 0)
        update.maps.update(samples, torch.where(drawn, output.pixel_errors, torch.nan), update.step)
        if update.nonfinite_losses is not None:
            update.nonfinite_losses.add_(nonfinite)

    def evaluate_and_learn(
        self, terms: LossTerms, colors: Tensor, targets: Tensor, samples: PixelSamples, update: MapUpdate
    ) -> LossOutput:
        """`evaluate`, then `learn`."""
        output = self.evaluate(terms, colors, targets, samples)
        self.learn(samples, colors, output, update)
        return output

    def supervise(self, terms: LossTerms, colors: Tensor, truth: PhotoSamples, update: MapUpdate) -> LossOutput:
        """`evaluate` against the truth at the samples, then `learn`. `colors`: [P, 3], on the engine's device."""
        output = self.evaluate(terms, colors, truth.colors(), truth.samples, truth.depths)
        self.learn(truth.samples, colors, output, update)
        return output

    def expose(self, exposures: Exposures, colors: Tensor, samples: PixelSamples) -> Tensor:
        """[P, 3] float32: rendered colours [P, 3] as the exposure of each sample's photo shows them."""
        return expose(exposures, colors, samples)

    def learn_exposures(
        self, exposures: Exposures, colors: Tensor, gradients: Tensor, samples: PixelSamples, rate: float
    ) -> Tensor:
        """[P, 3] float32, d loss / d colours: takes gradients back through `expose`, and makes one step of Adam with
        the exposures of the batch, in place. A skipped iteration (see `overflow`) changes no exposure.

        Args:
            colors: [P, 3], as given to `expose`.
            gradients: [P, 3], d loss / d exposed colours; it cannot be used again.
            rate: Adam's.
        """
        of_colors, sums = exposure_gradients(exposures, colors, gradients, samples)
        step_exposures(exposures, sums, samples.view_ids, rate, self.overflow)
        return of_colors

    @abstractmethod
    def update(
        self,
        rule: UpdateRule,
        screen: ScreenGradients,
        gaussians: Gaussians,
        moments: GaussianMoments,
        stats: GaussianStats | None,
    ) -> None:
        """Take gradients from the screen to the parameters, and make the rule's step with them.

        Args:
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
        return 0

    # What follows is done at once on one device. An engine of several devices spreads work and state over them.

    def place(self, gaussians: Gaussians) -> Gaussians:
        """The model where the engine's steps change it: the given one, or a copy over the one placed before."""
        return gaussians

    def complete(self) -> None:
        """Make every row of the moments and the statistics that `update` was given valid, before they are read."""
        return

    def agreed(self, update: RowUpdate | None) -> RowUpdate | None:
        """The change of the set of Gaussians that is made, where density control proposes this one."""
        return update

    def verify(self, state: Callable[[], dict[str, Any]]) -> None:
        """Check a complete state before it is evaluated or saved.

        Args:
            state: gives it as nested dicts of tensors and numbers; ``iteration`` is among them.

        Raises:
            TrainingStopped: devices hold different states.
        """
        return
