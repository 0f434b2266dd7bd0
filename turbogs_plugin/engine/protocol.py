"""The interface of an engine: what is to be done, whatever device does it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from turbogs_plugin.engine.exposures import Exposures
from turbogs_plugin.engine.layout import PassStatus
from turbogs_plugin.engine.moments import GaussianMoments
from turbogs_plugin.engine.reference.exposure import expose, exposure_gradients, step_exposures
from turbogs_plugin.engine.reference.records import collect_records, gather_colors
from turbogs_plugin.engine.reference.update import apply_update
from turbogs_plugin.engine.rendered import DEFAULT_OPTIONS, Rendered, RenderOptions, ScreenGradients, ScreenRecords
from turbogs_plugin.engine.rules import DrawRule, LossTerms, UpdateRule
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.photos import PhotoSamples
from turbogs_plugin.types import Cameras, Gaussians, GaussianStats, LossOutput, PixelSamples, Step


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


@dataclass
class PassMemory:
    """Memory of the caller, which others read, for what passes leave. Contiguous, aligned to 16 bytes.

    Args:
        status: [3] int32, `layout.PassStatus`.
        colors, radii, records: flat float32, int32 and float32, from whose start on a pass keeps as many as it has.
    """

    status: Tensor
    colors: Tensor
    radii: Tensor
    records: Tensor

    @cached_property
    def overflow(self) -> Tensor:
        """[1] int32 of `status`."""
        return self.status[PassStatus.OVERFLOW :][:1]

    @cached_property
    def stop(self) -> Tensor:
        """[1] int32 of `status`."""
        return self.status[PassStatus.STOP :][:1]


@dataclass
class ModelCopies:
    """Copies of Gaussians, maybe in other devices' memory, that a step changes alike.

    Args:
        gaussians: those that the step changes.
        copies: of the same Gaussians. The parameters of a copy are as far from each other as those of `gaussians`.
    """

    gaussians: Gaussians
    copies: Sequence[Gaussians]

    @cached_property
    def distances(self) -> tuple[int, ...]:
        """Bytes from each parameter to that of each copy.

        Raises:
            InputError: a copy lies otherwise.
        """
        filled = [(name, value) for name, value in self.gaussians.items() if value.numel()]
        found = [{getattr(copy, name).data_ptr() - value.data_ptr() for name, value in filled} for copy in self.copies]
        if any(len(each) != 1 for each in found):
            raise InputError("a copy of a model must lie as the model does: its parameters as far from each other")
        return tuple(distance for each in found for distance in each)


class Engine(ABC):
    """Does all computation, on the device of the given tensors.

    It knows rules, never strategies. `ReferenceEngine` defines every result; any other engine gives the same up to
    rounding. `supervise`, `evaluate_and_learn` and `update` each consist of two operations, which an engine may fuse
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
    def screen_gradients(
        self,
        gaussians: Gaussians,
        cameras: Cameras,
        samples: PixelSamples,
        options: RenderOptions,
        plain: ScreenRecords,
    ) -> ScreenGradients:
        """Screen gradients of K views from plain tensors, which several passes of engines of this kind gave.

        Args:
            gaussians: N of those that were rendered, as they were then: all, or rows of them.
            cameras, samples, options: of all K views, as the passes had them together.
            plain: of these views and Gaussians.
        """

    def collect(self, sources: Sequence[ScreenRecords], views: Sequence[int], target: ScreenRecords, row: int) -> None:
        """Collect the records of all K views for some rows. What several processes have of one view is added up, in
        their order.

        Args:
            sources: of each process with views, in their order: of V views and N Gaussians; maybe other devices'
                memory, read in place.
            views: first view of each, in the batch: the last one of the process before, or the next.
            target: of K views and M Gaussians; overwritten, but for records that are off screen.
            row: first of the M among the N.
        """
        collect_records(sources, views, target, row)

    def lend(self, memory: PassMemory | None) -> None:
        """Let the following passes keep in this memory what it is for, if the engine keeps memory from pass to pass,
        and as far as it fits in. None: in the engine's own."""
        return

    def gather(self, parts: Sequence[Tensor], first: int, counts: Sequence[int], seen: Tensor) -> Tensor:
        """Put the colours of all processes together. If one has set `PassStatus.OVERFLOW`, so does `overflow` here.

        Args:
            parts: [.] float32 of each process, memory that begins with the bits of its `PassStatus`; maybe other
                devices' memory, read in place.
            first: number at which its colours begin, in each.
            counts: samples of each.
            seen: [2] int32, written: the largest `PassStatus.OVERFLOW` of all, and the largest `PassStatus.STOP`.

        Returns:
            [P, 3] float32, one process's after the other's; valid until the next call.
        """
        colors = gather_colors(parts, first, counts, seen)
        if self.overflow is not None:
            self.overflow.copy_(seen[:1])
        return colors

    @abstractmethod
    def evaluate(self, terms: LossTerms, colors: Tensor, targets: Tensor, samples: PixelSamples) -> LossOutput:
        """The loss of rendered samples and its gradient. `colors`, `targets`: [P, 3]."""

    def supervise(self, terms: LossTerms, colors: Tensor, truth: PhotoSamples, update: MapUpdate) -> LossOutput:
        """`evaluate` against the photos at the samples, then `learn`. `colors`: [P, 3], on the engine's device."""
        return self.evaluate_and_learn(terms, colors, truth.colors(), truth.samples, update)

    def evaluate_and_learn(
        self, terms: LossTerms, colors: Tensor, targets: Tensor, samples: PixelSamples, update: MapUpdate
    ) -> LossOutput:
        """`evaluate`, then `learn`."""
        output = self.evaluate(terms, colors, targets, samples)
        self.learn(samples, colors, output, update)
        return output

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

    def expose(self, exposures: Exposures, colors: Tensor, samples: PixelSamples) -> Tensor:
        """[P, 3] float32: rendered colours [P, 3] as the exposure of each sample's photo shows them."""
        return expose(exposures, colors, samples)

    def learn_exposures(
        self, exposures: Exposures, colors: Tensor, gradients: Tensor, samples: PixelSamples, rate: float
    ) -> Tensor:
        """Take gradients back through `expose`, and make one step of Adam with the exposures of the batch.

        A skipped iteration changes no exposure.

        Args:
            exposures: those that the colours were exposed with; changed in place.
            colors: [P, 3], as given to `expose`.
            gradients: [P, 3], d loss / d exposed colours; it cannot be used again.
            rate: Adam's.

        Returns:
            [P, 3] float32, d loss / d colours.
        """
        of_colors, sums = exposure_gradients(exposures, colors, gradients, samples)
        step_exposures(exposures, sums, samples.view_ids, rate, self.overflow)
        return of_colors

    def update(
        self,
        rule: UpdateRule,
        screen: ScreenGradients,
        gaussians: Gaussians,
        moments: GaussianMoments,
        stats: GaussianStats | None,
        copies: ModelCopies | None = None,
    ) -> None:
        """Take gradients from the screen to the parameters, and make one step with them.

        Args:
            rule: which step.
            screen: from a backward pass of this engine; it cannot be used again.
            gaussians: the model that was rendered; changed in place, as is `moments`.
            stats: the statistics of density control, to which this pass is added; None if not needed.
            copies: of `gaussians`, to be changed alike.
        """
        apply_update(rule, gaussians, screen.parameter_gradients(rule.per_view, stats), moments)
        for copy in copies.copies if copies else ():
            for name, value in copy.items():
                value.copy_(getattr(gaussians, name))

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

    @abstractmethod
    def recover(self) -> None:
        """Prepare to repeat iterations that were skipped because another process's memory was too small: waits for the
        device, takes in what it learned of the memory needed, and clears `overflow`."""

    @property
    def bytes_held(self) -> int:
        """Bytes of memory kept from one iteration to the next."""
        return 0
