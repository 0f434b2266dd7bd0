"""What iterations of training change: the model, the error maps and the state of the strategies."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.captures.depth_maps import depth_maps
from turbogs_plugin.captures.starting_points import colors_in_photos, plain_cloud, starting_points
from turbogs_plugin.config.configuration import Config
from turbogs_plugin.engine import Engine, engine_of
from turbogs_plugin.engine.exposures import Exposures
from turbogs_plugin.engine.render import dense_samples, rasterize
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.errors import InputError, TrainingStopped
from turbogs_plugin.model.initial import BACKDROP_COUNT, backdrop_gaussians, gaussians_from_points, with_degree
from turbogs_plugin.model.limits import Clearance
from turbogs_plugin.model.torch_file import read_gsplat
from turbogs_plugin.plan.memory import cap_of
from turbogs_plugin.plan.photo_gains import PhotoGains, compare_exposures
from turbogs_plugin.scene import PosedImages, Scene
from turbogs_plugin.scene.agreement import require_agreement
from turbogs_plugin.scene.depths import InverseDepths
from turbogs_plugin.scene.geometry import evenly
from turbogs_plugin.scene.offload import OffloadedErrorMaps, place_views
from turbogs_plugin.train.look import Background, Look, interpolated_exposures
from turbogs_plugin.train.parameter_mean import ParameterMean
from turbogs_plugin.train.saved_model import load_given
from turbogs_plugin.types import Gaussians, PixelSamples, RowUpdate, Step

STATEFUL = ("view_sampler", "optimizer", "density")
"""Strategies that have a state of their own."""
COLOR_STRIDE = 97
"""Pixels from one that counts to the next in the mean colour of the photos; coprime to usual widths."""


class TrainingState:
    """The state of one run, on one device.

    Args:
        config: the run's, in which nothing is ``auto`` any more.
        scene: on any device.
        device: where everything is computed and kept.
        engine: does the computation; None: the device's own (`engine_of`).
        gains: the photos', as a plan has compared them; None: compared here, where exposures are learnt.
        resuming: a state is loaded next, so that the model of `train.init` need not be there.

    Attributes:
        gaussians: the model; iterations change it in place, so clone what is to be kept.
        maps: the error maps of the training views, `views`.
        iteration: how many are finished; `iterations` is T, and `refine_until` the last one of densification.
    """

    def __init__(
        self,
        config: Config,
        scene: Scene,
        device: torch.device,
        engine: Engine | None = None,
        gains: PhotoGains | None = None,
        resuming: bool = False,
    ) -> None:
        config.require_decided()
        train = config.train
        self.config, self.extent = config, scene.extent
        self.engine = engine or engine_of(device, for_training=True)
        self.views = place_views(scene.train, device, train.pixels_place)
        kind = OffloadedErrorMaps if train.pixels_place == "host" else ErrorMaps
        self.maps: ErrorMaps = kind(scene.train.cameras.sizes, device, config.maps.beta, masks=self.views.masks)
        self.background = Background.of(train.background, self.views.photos.transparent)
        self.exposures: Exposures | None = None
        if train.exposure:
            self.exposures = Exposures.identity(len(self.views), device)
            if not resuming:
                set_gains(self.exposures, gains or compare_exposures(scene.train, scene.points))
        self.view_sampler, self.pixel_sampler = config.build("view_sampler"), config.build("pixel_sampler")
        self.optimizer, self.density = config.build("optimizer"), config.build("density")
        self.schedule, self.loss = config.build("schedule"), config.build("loss")
        self.view_sampler.setup(self.views.cameras, scene.extent)
        self.depths: InverseDepths | None = None
        if self.loss.terms is not None and self.loss.terms.depth_weight > 0:
            maps = depth_maps(Path(config.scene.path), scene.train, scene.frame.scale)
            self.depths = InverseDepths.of(scene.train.cameras, scene.train.observations, scene.points, maps).to(device)
        self.clearance: Clearance | None = None
        if train.camera_clearance and not scene.drawn_points:
            self.clearance = Clearance.of(scene.points, self.views.cameras.centers)
        gaussians = initial_gaussians(scene, config, "points" if resuming else train.init)
        self.begin_with(gaussians.map(lambda tensor: tensor.to(device)))
        self.parameter_mean = ParameterMean(train.average_last, self.learnt()) if train.average_last else None
        self.set_length(int(train.iterations), train.refine_until)
        self.iteration = 0
        self.initial_error = 0.0
        self.nonfinite_losses = torch.zeros((), dtype=torch.int64, device=device)
        self._earliest = 0  # the iteration after the latest change of the set of Gaussians: see `repeat_lost`

    def take(self, kind: str, strategy: Any) -> None:
        """Put a strategy in the place of the present one of its kind, before the first iteration."""
        if kind == "loss" and strategy.terms is not None and strategy.terms.depth_weight and self.depths is None:
            raise InputError("loss: depths are read for the setting loss.depth_weight alone: set that")
        setattr(self, kind, strategy)
        if kind == "view_sampler":
            strategy.setup(self.views.cameras, self.extent)
        elif kind in ("density", "optimizer"):
            strategy.setup(self.gaussians)

    def begin_with(self, gaussians: Gaussians) -> None:
        """Train this model from now on, with optimizer and density control as at the start."""
        self.place(gaussians)
        self.optimizer.setup(self.gaussians)
        self.density.setup(self.gaussians)

    def place(self, gaussians: Gaussians) -> None:
        """Take this model, where the engine wants it."""
        self.gaussians = gaussians  # the present one is let go before memory for the new one is taken
        self.gaussians = self.engine.place(gaussians)

    def change_rows(self, update: RowUpdate) -> None:
        """Make this change of the set of Gaussians: model, optimizer and density control follow it, row by row."""
        if self.parameter_mean is not None:
            self.parameter_mean.restart()
        self.place(update.apply(self.gaussians))
        self.optimizer.apply(update)
        self.density.apply(update)
        self._earliest = self.iteration + 1

    def set_length(self, iterations: int, refine_until: int) -> None:
        """Set T and tau_until, the last iteration of densification. A time budget changes them during a run."""
        self.iterations, self.refine_until = iterations, refine_until

    @property
    def now(self) -> Step:
        """The present state of training, as strategies see it."""
        return Step(self.iteration, self.iterations, self.refine_until, self.config.train.seed, self.extent)

    @property
    def device(self) -> torch.device:
        """Where everything is computed and kept."""
        return self.gaussians.device

    @property
    def sh_degree(self) -> int:
        """Highest degree of spherical harmonics in use."""
        return self.config.train.sh_degree_at(self.iteration)

    def initialise_maps(self) -> None:
        """Set the maps to the errors of a dense render of the initial Gaussians, Algorithm 1's initialization."""
        for view_id in range(len(self.maps.sizes)):
            self.maps.initialise(view_id, self.dense_errors(view_id))
        self.initial_error = float(self.maps.view_means().mean())

    def dense_errors(self, view_id: int) -> Tensor:
        """[H * W] the errors of a dense render of one view; 0 at masked pixels."""
        background, masks = self.background.at(self.now), self.maps.masks
        samples = dense_samples(self.views.cameras, [view_id]) if masks is None else masks.pixels([view_id])
        options = {"sh_degree": self.sh_degree, "settings": self.config.raster, "background": background}
        rendered = rasterize(self.gaussians, self.views.cameras.select([view_id]), samples, **options)
        truth = self.views.photos.at(samples, background).colors()  # [P, 3]
        errors = truth.new_zeros(int(self.maps.sizes[view_id].prod()))
        errors[samples.pixel_ids.long()] = (self.shown(rendered.colors, samples) - truth).abs().sum(dim=-1)
        return errors

    def shown(self, colors: Tensor, samples: PixelSamples) -> Tensor:
        """[P, 3]: the model's colours at samples [P, 3], with the exposures of their photos where there are any."""
        return colors if self.exposures is None else self.engine.expose(self.exposures, colors, samples)

    def learnt(self) -> dict[str, Tensor]:
        """All tensors that iterations learn, by name: the model's, and the exposures of the photos."""
        exposures = {} if self.exposures is None else {"exposures": self.exposures.offsets}
        return {**dict(self.gaussians.items()), **exposures}

    def conclude(self) -> None:
        """End a run: the model becomes the mean of the last iterations, if there is one."""
        if self.parameter_mean is not None:
            self.parameter_mean.overwrite(self.learnt())

    def look(self, photos: Sequence[str]) -> Look:
        """How the present model is shown beside photos that are not trained, by their names."""
        exposures = None
        if self.exposures is not None:
            exposures = interpolated_exposures(self.exposures.offsets, self.views.names, photos)
        return Look(self.sh_degree, self.config.raster, self.background.evaluated, exposures)

    def repeat_lost(self, wait: bool = False) -> None:
        """Go back by the iterations that were skipped: where the engine has too little memory for an iteration, that
        one and those after it change nothing until the engine is settled. They are made again, with views chosen anew,
        but for those before a change of the set of Gaussians, which would then be made twice. `wait`: for the GPU, to
        know of all. Raises `InputError` where an iteration has more intersections than a pass can have."""
        lost, last = self.engine.settle(wait), self.iteration
        self.iteration = max(last - lost, min(self._earliest, last))

    def complete(self) -> None:
        """Make the whole state valid, before it is evaluated or saved. Raises `TrainingStopped` as `Engine.verify`."""
        self.engine.complete()
        self.engine.verify(self.state_dict)

    def require_finite(self) -> None:
        """Raise `TrainingStopped` where a parameter is not finite, or no loss so far was: later ones would not be."""
        if bad := int((~self.gaussians.finite_rows()).sum()):
            share = f"{bad} of {len(self.gaussians)}"
            raise TrainingStopped(f"iteration {self.iteration}: {share} Gaussians are not finite")
        if 0 < self.iteration == int(self.nonfinite_losses):
            raise TrainingStopped(f"iteration {self.iteration}: no loss was finite: see {type(self.loss).__name__}")

    def state_dict(self, ended: bool = False) -> dict[str, Any]:
        """Everything that iterations change, as plain tensors and numbers. A resume from it is bit for bit the same on
        a CPU: all randomness is a function of (seed, iteration, place) (`turbogs_plugin.engine.reference.philox`). Of a
        run that has `ended`: without what further iterations alone would read, moments and the maps' pixels."""
        return {
            "iteration": self.iteration,
            "initial_error": self.initial_error,
            "nonfinite_losses": int(self.nonfinite_losses),
            "gaussians": dict(self.gaussians.items()),
            **({} if self.exposures is None else {"exposures": self.exposures.state_dict()}),
            **({} if self.parameter_mean is None else {"parameter_mean": self.parameter_mean.state_dict()}),
            "maps": self.maps.state_dict(pixels=not ended),
            **{name: None if ended else getattr(self, name).state_dict() for name in STATEFUL},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load what `state_dict` gave, of the same configuration and scene, after `set_length`; from a file, after
        `checkpoint.require_like`. Raises `ValueError` where its parts do not fit each other, or not this trainer."""
        if not 0 <= state["iteration"] <= self.iterations or state["nonfinite_losses"] < 0:
            raise ValueError(f"iteration {state['iteration']} with {state['nonfinite_losses']} non-finite losses")
        if state["maps"]["stamp_base"] > state["iteration"]:
            raise ValueError(f"its error maps begin at iteration {state['maps']['stamp_base']}")
        if (ended := state["optimizer"] is None) and state["iteration"] < self.iterations:
            raise ValueError("it lacks what further iterations read")
        self.iteration = self._earliest = state["iteration"]
        self.initial_error = state["initial_error"]
        self.nonfinite_losses.fill_(state["nonfinite_losses"])
        saved = read_gsplat({"splats": state["gaussians"]}, "the checkpoint")
        self.begin_with(saved.map(lambda value: value.float().to(self.device)))
        if self.exposures is not None:
            self.exposures.load_state_dict(state["exposures"])
        if self.parameter_mean is not None:
            self.parameter_mean.load_state_dict(state["parameter_mean"], self.device)
        self.maps.load_state_dict(state["maps"], pixels=not ended)
        for name in () if ended else STATEFUL:
            getattr(self, name).load_state_dict(state[name])


def set_gains(exposures: Exposures, gains: PhotoGains) -> None:
    """Begin with the gains by which photos differ where they show the same; their mean is the identity."""
    factors = 2.0 ** torch.from_numpy(gains.gains).double()  # [V, 3]
    exposures.offsets[:, range(3), range(3)] = (factors / factors.mean(dim=0) - 1.0).to(exposures.offsets)


def initial_gaussians(scene: Scene, config: Config, init: str) -> Gaussians:
    """The model, on the CPU, that training starts from by `init`, which is as `train.init`: a given one, or one of
    points, of which as many as the cap allows are taken, evenly in their order; and a backdrop if one is wanted.
    Raises `InputError`: `init` cannot be read or is of another capture, or the cap has no room.
    """
    train, cap = config.train, cap_of(config)
    others = BACKDROP_COUNT if train.backdrop else 0
    if cap and cap <= others:
        remedy = "allow more, or leave the backdrop out by train.backdrop=false"
        raise InputError(f"density.max_gaussians {cap} leaves no room beside the {others} of the backdrop: {remedy}")
    if cloud := _cloud(scene, config, init):
        points, colors = cloud
        rows = torch.tensor(evenly(len(points), cap - others if cap else len(points)))
        settings = (train.sh_degree, scene.extent, train.initial_opacity, train.initial_size)
        gaussians = gaussians_from_points(points[rows], colors[rows], *settings)
    else:
        gaussians, antialiased = load_given(init, scene, train.init_world)
        gaussians = with_degree(gaussians, train.sh_degree)
        if antialiased:
            warnings.warn(f"'{init}' is of antialiased training: it goes on without, thicker at first", stacklevel=2)
        if cap and len(gaussians) + others > cap:
            said = f"'{init}' has {len(gaussians)} Gaussians, more than density.max_gaussians {cap} allows"
            raise InputError(f"{said} beside {others} of a backdrop: allow more, or start from points")
    if not train.backdrop:
        return gaussians
    backdrop = backdrop_gaussians(_mean_color(scene.train), train.sh_degree, scene.extent)
    return Gaussians(**{name: torch.cat([tensor, getattr(backdrop, name)]) for name, tensor in gaussians.items()})


def _cloud(scene: Scene, config: Config, init: str) -> tuple[Tensor, Tensor] | None:
    """Points [M, 3] float32 and their colours [M, 3] uint8 to start from; None where `init` is a model."""
    if init == "points":
        return scene.points, scene.point_colors
    views = scene.train
    if init == "random":
        viewmats, Ks = (each.cpu().double().numpy() for each in (views.cameras.viewmats, views.cameras.Ks))
        points = torch.from_numpy(starting_points(viewmats, Ks, views.cameras.sizes)[0]).float()
        return points, colors_in_photos(points, views.cameras, views.photos, views.masks)
    if (cloud := plain_cloud(init)) is None:
        return None
    points, colors = torch.from_numpy(scene.frame.normalise_points(cloud[0])).float(), torch.from_numpy(cloud[1])
    if not config.scene.force:
        require_agreement(replace(scene, points=points, point_colors=colors, drawn_points=False))
    return points, colors


def _mean_color(views: PosedImages) -> Tensor:
    """[3] float32, 0 .. 1: the mean of every `COLOR_STRIDE`-th pixel that is not masked; transparent ones on black."""
    pixels, masks = views.photos.stored[::COLOR_STRIDE, :3].float().cpu(), views.masks
    if masks is not None:
        kept = torch.cat([masks.image(view).reshape(-1) for view in range(len(views))])[::COLOR_STRIDE]
        pixels = pixels[kept] if kept.any() else pixels
    return pixels.mean(dim=0) / 255.0
