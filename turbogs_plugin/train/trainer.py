"""Algorithm 1 of the paper: one iteration of training, and the state that iterations change.

The loop over iterations is in `turbogs_plugin.train.loop`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol

import torch
from torch import Tensor

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.distributed.exchange import exchange_of
from turbogs_plugin.distributed.ranks import ONE, Ranks
from turbogs_plugin.engine import engine_of
from turbogs_plugin.engine.exposures import exposure_rate
from turbogs_plugin.engine.protocol import MapUpdate
from turbogs_plugin.engine.rendered import RenderOptions, ScreenGradients
from turbogs_plugin.engine.rendering import dense_samples, rasterize
from turbogs_plugin.engine.rules import Dropout
from turbogs_plugin.errors import TrainingStopped
from turbogs_plugin.model.limits import RESTRAIN_EVERY, Clearance, restrain_distant
from turbogs_plugin.model.row_order import in_order_of_space
from turbogs_plugin.model.torch_file import leaves
from turbogs_plugin.scene import Scene
from turbogs_plugin.scene.offload import place_maps, place_views
from turbogs_plugin.scene.photos import PhotoSamples
from turbogs_plugin.train.checkpoint import gaussians_of_state
from turbogs_plugin.train.initial_state import first_exposures, initial_gaussians
from turbogs_plugin.train.look import Background, Look, interpolated_exposures
from turbogs_plugin.train.parameter_mean import ParameterMean
from turbogs_plugin.train.strategy_results import require_output, require_samples
from turbogs_plugin.types import Gaussians, GaussianStats, LossOutput, PixelSamples, RowUpdate, Step

REPEATED_AT_MOST = 32
"""More iterations than an engine ever skips before it says so."""

DROPOUT_UNTIL = 0.95
"""Share of a run after which no Gaussian is left out any more, so that the model is fitted as it is drawn."""

STATEFUL = ("maps", "view_sampler", "optimizer", "density")
"""Attributes of a trainer that have a state of their own."""


class IterationObserver(Protocol):
    """Is told what an iteration does that is stored nowhere else. It must change nothing, and be cheap."""

    def sampled(self, samples: PixelSamples) -> None:
        """These pixels were sampled."""

    def changing(self, gaussians: Gaussians, update: RowUpdate, step: Step) -> None:
        """Density control is about to change the model in this way."""


class Trainer:
    """The Gaussians, the error maps and the strategies of one run.

    Args:
        config: that of the run, in which nothing is ``auto`` any more.
        scene: on any device.
        device: where everything is computed and kept.
        resuming: a state is loaded next, so that the model of `train.init` need not be there.
        ranks: the processes that train this model; each has such a trainer.

    Attributes:
        observer: who is told of each iteration, if anybody.
    """

    def __init__(
        self, config: Config, scene: Scene, device: torch.device, resuming: bool = False, ranks: Ranks = ONE
    ) -> None:
        config.require_decided()
        self.config = config
        self.ranks = ranks
        self.exchange = exchange_of(ranks)
        self.views = place_views(scene.train, device, config.train.photos_place)
        self.extent = scene.extent
        self.schedule = config.build("schedule")
        self.view_sampler = config.build("view_sampler")
        self.pixel_sampler = config.build("pixel_sampler")
        self.loss = config.build("loss")
        self.optimizer = config.build("optimizer")
        self.density = config.build("density")
        self.maps = place_maps(
            self.views.cameras.sizes, device, config.train.maps_place, config.maps.beta, self.views.masks
        )
        self.background = Background.of(config.train.background, self.views.photos.transparent)
        self.exposures = first_exposures(scene, resuming, device) if config.train.exposure else None
        self.clearance = None
        if config.train.camera_clearance and not scene.drawn_points:
            self.clearance = Clearance.of(scene.points.to(device), self.views.cameras.centers)
        init = "points" if resuming else config.train.init
        self.gaussians = initial_gaussians(scene, config, init).map(lambda tensor: tensor.to(device))
        self.view_sampler.setup(self.views.cameras, scene.extent)
        self.optimizer.setup(self.gaussians)
        self.density.setup(self.gaussians)
        share = config.train.average_last
        self.parameter_mean = ParameterMean(share, self.learnt()) if share else None
        self.engine = engine_of(device, for_training=True)
        self.set_length(config.train.iterations, config.train.refine_until)
        self.iteration = 0
        self.observer: IterationObserver | None = None
        self.first_repeatable = 0  # the iteration after the latest change of the set of Gaussians: see `repeat_lost`
        self._before_views: deque[tuple[int, dict[str, Any]]] = deque(maxlen=REPEATED_AT_MOST)  # the view sampler's
        self.initial_error = 0.0
        self.nonfinite_losses = torch.zeros((), dtype=torch.int64, device=device)

    def initialise_maps(self) -> None:
        """Set the maps to the errors of a dense render of the initial Gaussians, Algorithm 1's initialization."""
        pixels = self.maps.sizes.prod(axis=1).tolist()
        for view_id, errors in enumerate(self.exchange.initial_errors(pixels, self.dense_errors, self.device)):
            self.maps.initialise(view_id, errors)
        self.initial_error = self.maps.mean()

    def dense_errors(self, view_id: int) -> Tensor:
        """[H * W] the errors of a dense render of one view; 0 at masked pixels."""
        background, masks = self.background.at(self.now), self.maps.masks
        samples = dense_samples(self.views.cameras, [view_id]) if masks is None else masks.pixels([view_id])
        rendered = rasterize(
            self.gaussians,
            self.views.cameras.select([view_id]),
            samples,
            sh_degree=self.sh_degree,
            settings=self.config.raster,
            background=background,
        )
        truth = self.views.photos.at(samples, background).colors()  # [P, 3]
        errors = truth.new_zeros(int(self.maps.sizes[view_id].prod()))
        errors[samples.pixel_ids.long()] = (self.shown(rendered.colors, samples) - truth).abs().sum(dim=-1)
        return errors

    def step(self) -> None:
        """One iteration, in the paper's order."""
        self.repeat_lost()
        step = self.now
        view_errors = self.maps.view_means()

        # 1) Sampling parameters: how many views, and which share of their pixels
        mean_error = float(view_errors.sum()) / len(view_errors)  # as numpy's mean, in less than half of its time
        budget = self.schedule.query(step, mean_error, self.initial_error, len(self.views))

        # 2) View selection
        self._before_views.append((self.iteration, self.view_sampler.state_dict()))
        view_ids = self.view_sampler.select(budget.views, view_errors, step)

        # 3) Pixel sampling
        samples = self.pixel_sampler.sample(self.maps, view_ids, budget.rate, step)
        require_samples(samples, view_ids, self.config.pixel_sampler["type"])
        if self.maps.masks is not None and not getattr(self.pixel_sampler, "heeds_masks", False):
            samples = self.maps.masks.strip(samples)
        if self.observer is not None:
            self.observer.sampled(samples)

        # 4) Ground truth at the samples
        background = self.background.at(step)
        truth = self.views.photos.at(samples, background)

        # 5) Sparse forward rendering
        cameras = self.views.cameras.select(view_ids)
        options = RenderOptions(self.sh_degree, self.config.raster, background=background, dropout=self.dropout)
        rendered = self.exchange.render(self.engine, self.gaussians, cameras, samples, options)

        # 6) Sparse loss and its gradients, and 7) EMA update of the error maps
        loss = self.supervise(rendered.colors, truth, step)

        # 8) Backward to the screen, summing for each Gaussian what step 11 needs (errors, weights, squares)
        stats = self.density.stats
        screen = rendered.backward(loss.color_gradients, loss.pixel_errors, with_statistics=stats is not None)

        # 9) and 10) Backward to the parameters, solve for their updates and apply them; adds to `stats`
        self.update(screen, stats, step)
        del rendered, screen  # they hold the model, which may be replaced now

        # 11) Density control (the paper's: error-driven)
        self.follow(self.refine(step))

        self.iteration += 1
        if self.parameter_mean is not None and self.parameter_mean.due(self.iteration, self.iterations):
            self.parameter_mean.add(self.learnt())

    def supervise(self, colors: Tensor, truth: PhotoSamples, step: Step) -> LossOutput:
        """Loss and error maps, and the exposures of the photos where they are learnt.

        Loss and maps are one step if the loss is a rule, else the loss's own code comes first.
        """
        samples, update = truth.samples, MapUpdate(self.maps, step, self.nonfinite_losses)
        shown = self.shown(colors, samples)
        terms = getattr(self.loss, "terms", None)
        if terms is not None:
            loss = self.engine.supervise(terms, shown, truth, update)
        else:
            loss = self.loss(shown, truth.colors(), samples)
            require_output(loss, shown, self.config.loss["type"])
            self.engine.learn(samples, shown, loss, update)
        if self.exposures is None:
            return loss
        rate, gradients = exposure_rate(step), loss.color_gradients
        gradients = self.engine.learn_exposures(self.exposures, colors, gradients, samples=samples, rate=rate)
        return replace(loss, color_gradients=gradients)

    def shown(self, colors: Tensor, samples: PixelSamples) -> Tensor:
        """[P, 3]: the model's colours at samples [P, 3], with the exposures of their photos where there are any."""
        return colors if self.exposures is None else self.engine.expose(self.exposures, colors, samples)

    def update(self, screen: ScreenGradients, stats: GaussianStats | None, step: Step) -> None:
        """Gradients, statistics and update: in one step if the optimizer has a rule, else by its own code."""
        rule = self.optimizer.rule(step)
        if rule is not None:
            self.exchange.update(self.engine, rule, screen, self.gaussians, self.optimizer.moments, stats)
        else:
            gradients = screen.parameter_gradients(self.optimizer.per_view, stats)
            self.optimizer.step(self.gaussians, gradients, step)

    def refine(self, step: Step) -> RowUpdate | None:
        """The change of the set of Gaussians that density control proposes, if any.

        What changes the model without such a change (mcmc's noise) is taken back in a skipped iteration, which is made
        again (`Engine.overflow`).
        """
        overflow, before = self.engine.overflow, None
        if overflow is not None and "model" in self.density.watched:
            self.exchange.finish()
            before = self._gaussians.map(Tensor.clone)
        update = self.exchange.refine(self.density, self._gaussians, step, self.complete)
        if before is not None and update is None:
            for name, value in self._gaussians.items():
                value.copy_(torch.where(overflow == 0, value, getattr(before, name)))
        return update

    def complete(self) -> None:
        """Gather the complete moments and statistics on every process. Every process must call this."""
        self.exchange.complete(self.optimizer.moments, self.density.stats)

    def compare_replicas(self) -> None:
        """Where several processes train, see that all have the same state, to the bit.

        Raises:
            TrainingStopped: they do not.
        """
        self.complete()
        self.exchange.compare(lambda: dict(leaves(self.state_dict(), "state")), self.iteration)

    def follow(self, update: RowUpdate | None) -> None:
        """Apply the change of the set of Gaussians that density control proposed, if any.

        Model, optimizer and controller follow the change, with its rows sorted in space until `refine_until`. Not in
        the paper: what stands right before a camera goes with any change; and the size of distant Gaussians is limited,
        every `RESTRAIN_EVERY` iterations, also without a change.
        """
        if update is not None:
            if self.clearance is not None:
                update = self.clearance.clear(update, self.gaussians)
            if len(update.source) == 0:
                raise TrainingStopped(f"iteration {self.iteration}: every Gaussian was removed")
            update = in_order_of_space(update, self.gaussians, self.now)
            if self.observer is not None:
                self.observer.changing(self.gaussians, update, self.now)
            if self.parameter_mean is not None:
                self.parameter_mean.restart()
            self.gaussians = update.apply(self.gaussians)
            self.optimizer.apply(update)
            self.density.apply(update)
            self.first_repeatable = self.iteration + 1
        if self.config.train.distant_size > 0 and self.iteration % RESTRAIN_EVERY == 0:
            restrain_distant(self.gaussians, self.extent, self.config.train.distant_size)

    def learnt(self) -> dict[str, Tensor]:
        """All tensors that iterations learn, by name: the model's, and the exposures of the photos."""
        exposures = {} if self.exposures is None else {"exposures": self.exposures.offsets}
        return {**dict(self.gaussians.items()), **exposures}

    def conclude(self) -> None:
        """At the end of a run: the model becomes the mean of the last iterations, if there is one."""
        if self.parameter_mean is not None:
            self.parameter_mean.overwrite(self.learnt())

    def set_length(self, iterations: int, refine_until: int) -> None:
        """Set T and tau_until, the last iteration of densification. A time budget changes them during a run."""
        self.iterations, self.refine_until = iterations, refine_until

    def repeat_lost(self, wait: bool = False) -> None:
        """Go back by the iterations that were skipped: where the engine has too little memory for an iteration, that
        one and those after it change nothing until the engine is settled. They are made again with the same views: or
        views that take much memory would be looked at less often.

        It never goes back past a change of the set of Gaussians, which would then be made twice: iterations skipped
        just before such a change are lost.

        Args:
            wait: wait for the GPU, to know of all of them.

        Raises:
            InputError: an iteration has more intersections of a tile and a splat than a pass can have.
        """
        lost = self.exchange.settle(self.engine, wait)
        earliest, last = min(self.first_repeatable, self.iteration), self.iteration
        self.iteration = max(self.iteration - lost, earliest)
        if lost and self.parameter_mean is not None:
            self.parameter_mean.take_back(self.learnt(), self.iteration + 1, last, self.iterations)
        while lost and self._before_views and self._before_views[-1][0] >= self.iteration:
            _, state = self._before_views.pop()
            self.view_sampler.load_state_dict(state)

    @property
    def now(self) -> Step:
        """The present state of training, as strategies see it."""
        return Step(self.iteration, self.iterations, self.refine_until, self.config.train.seed, self.extent)

    @property
    def dropout(self) -> Dropout:
        """What this iteration leaves out of the model."""
        share = self.config.train.dropout if self.iteration < DROPOUT_UNTIL * self.iterations else 0.0
        return Dropout(share, self.config.train.seed, self.iteration)

    @property
    def gaussians(self) -> Gaussians:
        """The model. With several processes, GPU work enqueued after this waits until every update has arrived, and
        the next model may overwrite these tensors: clone what is to be kept."""
        self.exchange.finish()
        return self._gaussians

    @gaussians.setter
    def gaussians(self, gaussians: Gaussians) -> None:
        self.exchange.finish()
        self._gaussians = None  # memory that several processes share lets go of it where it has to grow
        self._gaussians = self.exchange.place(gaussians)

    @property
    def device(self) -> torch.device:
        """Where everything is computed and kept."""
        return self._gaussians.device

    @property
    def sh_degree(self) -> int:
        """Highest degree of spherical harmonics in use."""
        return self.config.train.sh_degree_at(self.iteration)

    def look(self, photos: Sequence[str]) -> Look:
        """How the present model is shown beside photos that are not trained, by their names."""
        exposures = None
        if self.exposures is not None:
            exposures = interpolated_exposures(self.exposures.offsets, self.views.names, photos)
        return Look(self.sh_degree, self.config.raster, self.background.evaluated, exposures)

    def require_finite(self) -> None:
        """Stop a run whose model is lost.

        Raises:
            TrainingStopped: a parameter is not finite, which later iterations would not repair.
        """
        for name, tensor in self.gaussians.items():
            bad = int((~tensor.isfinite()).reshape(len(tensor), -1).any(dim=1).sum()) if tensor.numel() else 0
            if bad:
                raise TrainingStopped(
                    f"iteration {self.iteration}: {name} of {bad} of {len(tensor)} Gaussians are not finite"
                )

    def state_dict(self) -> dict[str, Any]:
        """Everything that iterations change, as plain tensors and numbers.

        A resume from it is bit for bit the same on a CPU: there is no generator to save, as all randomness is a
        function of (seed, iteration, place) (`turbogs_plugin.engine.reference.philox`).
        """
        return {
            "iteration": self.iteration,
            "initial_error": self.initial_error,
            "nonfinite_losses": int(self.nonfinite_losses),
            "gaussians": dict(self.gaussians.items()),
            **({} if self.exposures is None else {"exposures": self.exposures.state_dict()}),
            **({} if self.parameter_mean is None else {"parameter_mean": self.parameter_mean.state_dict()}),
            **{name: getattr(self, name).state_dict() for name in STATEFUL},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load what `state_dict` gave, into a trainer of the same configuration and scene.

        An untrusted state must first be compared with the present one (`checkpoint.require_like`). In a run with a time
        budget, call `set_length` before.

        Raises:
            ValueError: the parts of the state do not fit each other, or not this trainer.
        """
        if not 0 <= state["iteration"] <= self.iterations or state["nonfinite_losses"] < 0:
            raise ValueError(f"iteration {state['iteration']} with {state['nonfinite_losses']} non-finite losses")
        self.iteration = state["iteration"]
        self._before_views.clear()
        self.initial_error = state["initial_error"]
        self.nonfinite_losses.fill_(state["nonfinite_losses"])
        self.gaussians = gaussians_of_state(state, self.device)
        if self.exposures is not None:
            self.exposures.load_state_dict(state["exposures"])
        if self.parameter_mean is not None:
            self.parameter_mean.load_state_dict(state["parameter_mean"], self.learnt())
        self.optimizer.setup(self.gaussians)
        self.density.setup(self.gaussians)
        for name in STATEFUL:
            getattr(self, name).load_state_dict(state[name])
