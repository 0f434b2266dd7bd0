"""The defaults of an engine, in torch: what an engine on one device does where it has no way of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.engine.exposures import Exposures
from turbogs_plugin.engine.moments import GaussianMoments
from turbogs_plugin.engine.protocol import GroundTruth, MapUpdate
from turbogs_plugin.engine.reference.exposed_colors import expose, exposure_gradients, step_exposures
from turbogs_plugin.engine.reference.records import collect_records, gather_colors
from turbogs_plugin.engine.reference.update import apply_update
from turbogs_plugin.engine.render_pass import ScreenGradients, ScreenRecords
from turbogs_plugin.engine.rules import LossTerms, UpdateRule
from turbogs_plugin.engine.shared import ModelCopies, PassMemory, SharedEngine
from turbogs_plugin.types import Gaussians, GaussianStats, LossOutput, PixelSamples, RowUpdate


class BaseEngine(SharedEngine):
    """An engine on one device, without what each engine does in its own way: draw, render, evaluate, go back from the
    screen (`screen_gradients`), and recover."""

    @property
    def overflow(self) -> Tensor | None:
        return None

    @property
    def bytes_held(self) -> int:
        return 0

    def supervise(self, terms: LossTerms, colors: Tensor, truth: GroundTruth, update: MapUpdate) -> LossOutput:
        return self.evaluate_and_learn(terms, colors, truth.colors(), truth.samples, update)

    def evaluate_and_learn(
        self, terms: LossTerms, colors: Tensor, targets: Tensor, samples: PixelSamples, update: MapUpdate
    ) -> LossOutput:
        output = self.evaluate(terms, colors, targets, samples)
        self.learn(samples, colors, output, update)
        return output

    def learn(self, samples: PixelSamples, colors: Tensor, output: LossOutput, update: MapUpdate) -> None:
        drawn, nonfinite = torch.isfinite(colors).all(dim=1), ~output.loss.isfinite()
        if self.overflow is not None:
            drawn, nonfinite = drawn & (self.overflow == 0), nonfinite & (self.overflow[0] == 0)
        update.maps.update(samples, torch.where(drawn, output.pixel_errors, torch.nan), update.step)
        if update.nonfinite_losses is not None:
            update.nonfinite_losses.add_(nonfinite)

    def expose(self, exposures: Exposures, colors: Tensor, samples: PixelSamples) -> Tensor:
        return expose(exposures, colors, samples)

    def learn_exposures(
        self, exposures: Exposures, colors: Tensor, gradients: Tensor, samples: PixelSamples, rate: float
    ) -> Tensor:
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
        apply_update(rule, gaussians, screen.parameter_gradients(rule.per_view, stats), moments)
        for copy in copies.copies if copies else ():
            for name, value in copy.items():
                value.copy_(getattr(gaussians, name))

    def settle(self, wait: bool = False) -> int:
        return 0

    def place(self, gaussians: Gaussians) -> Gaussians:
        return gaussians

    def each_view(self, errors_of: Callable[[int], Tensor], pixels: Sequence[int]) -> Iterator[Tensor]:
        return map(errors_of, range(len(pixels)))

    def complete(self, moments: GaussianMoments | None, stats: GaussianStats | None) -> None:
        """Every row is always valid here."""

    def agreed(self, update: RowUpdate | None) -> RowUpdate | None:
        return update

    def verify(self, state: Callable[[], dict[str, Any]]) -> None:
        """There is one state."""

    def collect(self, sources: Sequence[ScreenRecords], views: Sequence[int], target: ScreenRecords, row: int) -> None:
        collect_records(sources, views, target, row)

    def lend(self, memory: PassMemory | None) -> bool:
        """No memory is kept from pass to pass here."""
        return False

    def gather(self, parts: Sequence[Tensor], first: int, counts: Sequence[int], seen: Tensor) -> Tensor:
        colors = gather_colors(parts, first, counts, seen)
        if self.overflow is not None:
            self.overflow.copy_(seen[:1])
        return colors
