"""Algorithm 1 of the paper: one iteration of training. `turbogs_plugin.train.loop` is the loop over iterations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from turbogs_plugin.engine.exposures import exposure_rate
from turbogs_plugin.engine.protocol import MapUpdate
from turbogs_plugin.engine.render_pass import RenderOptions, ScreenGradients
from turbogs_plugin.engine.rules import Dropout
from turbogs_plugin.errors import TrainingStopped
from turbogs_plugin.model.limits import RESTRAIN_EVERY, restrain_distant
from turbogs_plugin.model.row_order import in_order_of_space
from turbogs_plugin.scene.depths import DepthPair
from turbogs_plugin.scene.photos import PhotoSamples
from turbogs_plugin.strategies.returned import require_output, require_rows, require_samples, require_stats
from turbogs_plugin.train.training_state import TrainingState
from turbogs_plugin.types import GaussianStats, LossOutput, PixelSamples, RowUpdate, Step

DROPOUT_UNTIL = 0.95
"""Share of a run after which no Gaussian is left out any more, so that the model is fitted as it is drawn."""


class Trainer(TrainingState):
    """The iterations of one run. Arguments as of `TrainingState`."""

    on_samples: Callable[[PixelSamples], None] | None = None
    """Called with the samples of each iteration, if anything; it must be cheap, and change nothing."""

    def step(self) -> None:
        """One iteration, in the paper's order."""
        self.repeat_lost()
        step = self.now
        view_errors = self.maps.view_means()

        # 1) Sampling parameters: how many views, and which share of their pixels
        mean_error = float(view_errors.sum()) / len(view_errors)  # as numpy's mean, in less than half of its time
        budget = self.schedule.query(step, mean_error, self.initial_error, len(self.views))

        # 2) View selection
        view_ids = self.view_sampler.select(budget.views, view_errors, step)

        # 3) Pixel sampling
        samples = self.pixel_sampler.sample(self.maps, view_ids, budget.rate, step)
        require_samples(samples, view_ids, self.maps.sizes[list(view_ids)], self.pixel_sampler)
        if self.maps.masks is not None and not self.pixel_sampler.heeds_masks:
            samples = self.maps.masks.strip(samples)
        if self.on_samples is not None:
            self.on_samples(samples)

        # 4) Ground truth at the samples
        background = self.background.at(step)
        truth = self.views.photos.at(samples, background)

        # 5) Sparse forward rendering
        cameras = self.views.cameras.select(view_ids)
        share = float(self.config.train.dropout) if self.iteration < DROPOUT_UNTIL * self.iterations else 0.0
        dropout = Dropout(share, step.seed, self.iteration)
        options = RenderOptions(self.sh_degree, self.config.raster, self.depths is not None, background, dropout)
        rendered = self.engine.render(self.gaussians, cameras, samples, options)

        # 6) Sparse loss and its gradients, and 7) EMA update of the error maps
        if self.depths is not None and rendered.depths is not None:
            truth = replace(truth, depths=DepthPair(rendered.depths, self.depths))
        loss = self.supervise(rendered.colors, truth, step)

        # 8) Backward to the screen, summing for each Gaussian what step 11 needs (errors, weights, squares)
        stats = self.density.stats
        screen = rendered.backward(
            loss.color_gradients,
            loss.pixel_errors if self.density.uses_errors else None,
            with_statistics=stats is not None,
            depth_gradients=loss.depth_gradients,
        )

        # 9) and 10) Backward to the parameters, solve for their updates and apply them; adds to `stats`
        self.update(screen, stats, step)
        del rendered, screen  # they hold the model, which may be replaced now

        # 11) Density control (the paper's: error-driven)
        self.follow(self.refine(step))

        self.iteration += 1
        if self.parameter_mean is not None and self.parameter_mean.due(self.iteration, self.iterations):
            self.parameter_mean.add(self.learnt())

    def supervise(self, colors: Tensor, truth: PhotoSamples, step: Step) -> LossOutput:
        """Loss and error maps, in one step if the loss is a rule, and the exposures of the photos where these are
        learnt."""
        samples, update = truth.samples, MapUpdate(self.maps, step, self.nonfinite_losses)
        shown, terms = self.shown(colors, samples), self.loss.terms
        if terms is not None:
            loss = self.engine.supervise(terms, shown, truth, update)
        else:
            loss = self.loss(shown, truth.colors(), samples)
            require_output(loss, shown, self.loss)
            self.engine.learn(samples, shown, loss, update)
        if self.exposures is None:
            return loss
        rate = exposure_rate(step)
        gradients = self.engine.learn_exposures(self.exposures, colors, loss.color_gradients, samples, rate)
        return replace(loss, color_gradients=gradients)

    def update(self, screen: ScreenGradients, stats: GaussianStats | None, step: Step) -> None:
        """Gradients, statistics and update: in one step if the optimizer has a rule, else by its own code."""
        rule, moments = self.optimizer.rule(step), self.optimizer.moments
        if rule is not None:
            self.engine.update(rule, screen, self.gaussians, moments, stats)
        else:
            gradients = screen.parameter_gradients(self.optimizer.per_view, stats)
            self.optimizer.step(self.gaussians, gradients, step)

    def refine(self, step: Step) -> RowUpdate | None:
        """The change of the set of Gaussians that density control proposes, if any. What changes the model without one
        (mcmc's noise) is taken back in a skipped iteration, which is made again (`Engine.overflow`)."""
        due, overflow = self.density.event_due(step), self.engine.overflow
        if due:
            self.engine.complete()
        before = self.gaussians.map(Tensor.clone) if overflow is not None and self.density.moves_model else None
        update = self.density.update(self.gaussians, step)
        if overflow is not None and before is not None and update is None:
            for name, value in self.gaussians.items():
                value.copy_(torch.where(overflow.eq(0), value, getattr(before, name)))
        return self.engine.agreed(update) if due else update

    def follow(self, update: RowUpdate | None) -> None:
        """Apply the change of the set of Gaussians that density control proposed, if any, with its rows sorted in space
        until `refine_until`. Not in the paper: what stands right before a camera goes with any change; and the size of
        distant Gaussians is limited, every `RESTRAIN_EVERY` iterations, also without a change."""
        if update is not None:
            require_rows(update, self.density, self.gaussians)
            if self.clearance is not None:
                update = self.clearance.clear(update, self.gaussians)
            if len(update.source) == 0:
                raise TrainingStopped(f"iteration {self.iteration}: every Gaussian was removed")
            update = in_order_of_space(update, self.gaussians, self.now)
            self.change_rows(update)
            require_stats(self.density, len(self.gaussians))
        if self.config.train.distant_size > 0 and self.iteration % RESTRAIN_EVERY == 0:
            restrain_distant(self.gaussians, self.extent, self.config.train.distant_size)
