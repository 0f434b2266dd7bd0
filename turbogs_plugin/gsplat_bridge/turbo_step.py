"""The whole step of training in a gsplat trainer: which pixels, rendering, loss, update and density control are ours,
everything around the step is the host's."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping, MutableMapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from gsplat.strategy import DefaultStrategy
from torch import Tensor

from turbogs_plugin.config.configuration import DEFAULT_CONFIG, Config, load_config, refuse_overrides
from turbogs_plugin.config.scaling import with_iterations
from turbogs_plugin.error_maps import LaggedCopy
from turbogs_plugin.errors import InputError, is_number, require
from turbogs_plugin.gsplat_bridge.density_swap import apply_row_update
from turbogs_plugin.gsplat_bridge.host import (
    IN_IMAGES,
    Optimizers,
    Parameters,
    host_gaussians,
    require_keys,
    require_one_process,
    require_options,
    role_of,
)
from turbogs_plugin.gsplat_bridge.host_views import posed_images
from turbogs_plugin.model.initial import BACKDROP_COUNT
from turbogs_plugin.model.limits import RESTRAIN_EVERY
from turbogs_plugin.model.torch_file import BANDS
from turbogs_plugin.plan import SceneFacts, make_plan
from turbogs_plugin.plan.decisions import decide
from turbogs_plugin.scene import Frame, PosedImages, Scene
from turbogs_plugin.scene.photos import PhotoSamples
from turbogs_plugin.strategies.learning_rates import LearningRates
from turbogs_plugin.train.checkpoint import require_like
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import PARAMETER_NAMES, Gaussians, LossOutput, RowUpdate, Step

_STEP = "app_opt pose_opt pose_noise with_eval3d antialiased random_bkgd sparse_grad visible_adam opacity_reg scale_reg"
WITHOUT_EFFECT: dict[str, Any] = {**IN_IMAGES, **dict.fromkeys(_STEP.split(" "), False), "batch_size": 1}
"""Options of gsplat's trainer that change its own step alone, and the value that asks for nothing."""
_START = "train.init train.init_world train.sh_degree train.initial_opacity train.initial_size train.device"
_AROUND = "scene train.seed train.refine_cameras train.evaluate_at train.checkpoint_every budget.time"
OWN_SETTINGS: dict[str, str] = {
    "train.exposure": "TurboStep's own: a host's evaluation has no exposures",
    **dict.fromkeys(_START.split(" "), "TurboStep's own: splats decide"),
    **dict.fromkeys(_AROUND.split(" "), "TurboStep's own: views, torch.manual_seed and all around it are the host's"),
}
"""Settings, or whole sections, that no override can change, and why."""
LAG = 16
"""Steps after which a loss has reached the host. Trainers show it at every step, and would wait for the GPU there."""


@dataclass(frozen=True)
class StepInfo:
    """What a step gives. The host waits for a GPU where `psnr` is read, and nowhere else."""

    loss: Tensor  # [] float32 on the host, before the update; on a GPU that of a step 16 to 31 before
    num_gaussians: int  # after the step
    num_samples: int  # pixels of the step, empty slots among them
    _colors: Tensor = field(repr=False)
    _truth: PhotoSamples = field(repr=False)

    @property
    def psnr(self) -> float:
        """PSNR of the samples in dB, before the step's update; to be read before the next step."""
        filled = self._truth.samples.filled
        return -10.0 * float((self._colors - self._truth.colors())[filled].square().mean().log10())


class TurboStep:
    """One training step after another on the parameters of a gsplat trainer, by Algorithm 1.

    The host's parameters are the model: after a step, ``splats`` holds its present values under the host's names. Their
    memory is shared, so what the host writes into them is trained on. Where a step changes the number of Gaussians,
    ``splats`` gets new Parameters, as by gsplat's operations, and the `optimizers` are told, which are not stepped.

    The first step appends a backdrop of `BACKDROP_COUNT` Gaussians where the plan wants one. The last of
    `max_steps` steps ends with the mean of the last tenth. All randomness follows from ``torch.initial_seed()``.

    Args:
        splats: gsplat's parameters, float32: means [N, 3], scales [N, 3] (log), quats [N, 4], opacities [N] (logit),
            sh0 [N, 1, 3], shN [N, B, 3]; or splatfacto's layout and names. More parameters of N rows may be there:
            a new Gaussian takes its parent's row, one of the backdrop the first row.
        views: V training photos, as gsplat's `Dataset` has them: items by number with "image" [H, W, 3], 0 .. `white`,
            undistorted, "K" [3, 3], "camtoworld" [4, 4] and perhaps "mask" [H, W], True where a pixel counts. Sizes may
            differ. All are read once, by several threads.
        scene_scale: 1.1 times the largest distance of a camera from their mean; None: that is computed.
        max_steps: length of the training; None: as many as `proposed_steps` says.
        optimizers: the host's, by the names of the parameters.
        rates: names of the parameters whose learning rate is the present ``lr`` of the host's optimizer.
        options: the host's, as gsplat's `Config`: those that would have no effect here are refused, and its
            `DefaultStrategy` is laid to rest (refine_stop_iter = 0).
        scene: of gsplat from 1.6 on, a container with more arrays over Gaussians, whose rows follow.
        config: name of a packaged configuration, or a YAML file. overrides: ``section.key=value`` on top, one or
            several, of any setting but `OWN_SETTINGS`.

    Raises:
        InputError: several processes; an option, override or parameter without support; or an argument of another form.
    """

    def __init__(
        self,
        splats: Parameters,
        views: Any,
        scene_scale: float | None = None,
        max_steps: int | None = None,
        optimizers: Optimizers | None = None,
        *,
        rates: Collection[str] = (),
        options: Any = None,
        scene: Any = None,
        white: float = 255.0,
        config: str = DEFAULT_CONFIG,
        overrides: Sequence[str] = (),
    ) -> None:
        require_one_process("TurboStep")
        require_options(options, WITHOUT_EFFECT, "TurboStep, whose step is its own")
        strategy = getattr(options, "strategy", None)
        if isinstance(strategy, DefaultStrategy):
            strategy.refine_stop_iter = 0
        elif strategy is not None:
            name = type(strategy).__name__
            raise InputError(f"strategy {name} would change the Gaussians beside TurboStep: use DefaultStrategy")
        require(isinstance(splats, MutableMapping | torch.nn.ParameterDict), "type of splats", type(splats), "a dict")
        require(isinstance(optimizers, Mapping | None), "type of optimizers", type(optimizers), "a dict or None")
        require(scene is None or hasattr(scene, "on_remove"), "type of scene", type(scene), "gsplat's Scene, or None")
        require(isinstance(rates, Collection | None), "rates", rates, "names of parameters")
        self.splats, self.optimizers, self.scene = splats, {} if optimizers is None else optimizers, scene
        gaussians = self._checked()
        given = OWN_SETTINGS if max_steps is None else OWN_SETTINGS | {"train.iterations": "max_steps here"}
        device, settings = gaussians.device, host_settings(config, overrides, given)
        settings.train.sh_degree = gaussians.sh_degree
        if max_steps is not None:
            require(is_number(max_steps, whole=True) and max_steps >= 1, "max_steps", max_steps, "a whole number >= 1")
            settings = with_iterations(settings, int(max_steps))
        world = scene_of(posed_images(views, white), gaussians, scene_scale)
        settings = make_plan(settings, world, device).apply(settings)
        settings.train.seed = torch.initial_seed() % 2**31
        self.trainer = HostTrainer(self, settings, world, device)
        rates = [rates] if isinstance(rates, str) else rates
        if rates:
            require_keys(self.optimizers, rates, "optimizers", "rates are of parameters whose optimizer is given")
            kind, known = settings.optimizer["type"], "learning_rates" in settings.optimizer
            require(known, "rates", rates, f"left out, as optimizer.type '{kind}' has no learning rates")
            mixed = HostRates(**settings.optimizer["learning_rates"])
            mixed.host = {role_of(name, self.splats): self.optimizers[name] for name in rates}
            self.trainer.optimizer.learning_rates = mixed
        self.steps, self.max_steps, self._begun = 0, self.trainer.iterations, False
        self._losses = LaggedCopy(torch.zeros(1, dtype=torch.float64, device=device), LAG)

    @staticmethod
    def proposed_steps(num_views: int, config: str = DEFAULT_CONFIG, overrides: Sequence[str] = ()) -> int:
        """The length that we propose for this number of training views."""
        require(is_number(num_views, whole=True) and num_views >= 1, "num_views", num_views, "a whole number >= 1")
        facts = SceneFacts(num_views, 0.0, 0, 0, "cpu", 0, 0)
        return int(decide("iterations", facts, host_settings(config, overrides)).value)

    def step(self, step: int) -> StepInfo:
        """Make the step of this number, `steps`. Raises `InputError` for another, or another number of Gaussians."""
        require_one_process("TurboStep")
        if step != self.steps:
            raise InputError(f"step is {step}: expected {self.steps}, the next one")
        if step >= self.max_steps:
            raise InputError(f"step is {step}: all {self.max_steps} steps are made (max_steps)")
        trainer = self.trainer
        if self._begun:
            self._take_changes()
        else:
            self._begin()
        self.steps = step + 1
        while trainer.iteration < self.steps:
            trainer.step()
        if self.steps == self.max_steps:
            self._catch_up()
            trainer.conclude()
        output, colors, truth = trainer.seen
        if step == 0 and not colors.any():  # the only step for which the host waits
            remedy = "camtoworld must be camera to world, x right, y down, z forward, in the world of the splats"
            warnings.warn(f"no sample of the first step shows a Gaussian: {remedy}", stacklevel=2)
        self._losses.source.copy_(output.loss)  # an engine may use the memory of its own again
        loss = torch.tensor(self._losses.read()[0], dtype=torch.float32)
        return StepInfo(loss, len(trainer.gaussians), len(truth.samples), colors, truth)

    def state_dict(self) -> dict[str, Any]:
        """Tensors and numbers for the host's checkpoint, beside its own parameters. A resume is exact on a CPU."""
        if not self._begun:
            self._begin()
        self._take_changes()
        self._catch_up()
        self.trainer.complete()
        return self._state()

    def _state(self) -> dict[str, Any]:
        numbers = {"steps": self.steps, "max_steps": self.max_steps, "seed": self.trainer.config.train.seed}
        radii = self.trainer.clearance and self.trainer.clearance.radii  # by the splats at the start
        return {**numbers, "radii": radii, "trainer": self.trainer.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from a state. `splats` gets its values; parameters that are the host's alone must be loaded before.
        Raises `InputError`: it is of another training, or not of this form."""
        try:
            require_like(dict(state), self._state(), "state")
            require(state["max_steps"] == self.max_steps, "state.max_steps", state["max_steps"], f"{self.max_steps}")
            count = len(state["trainer"]["gaussians"]["means"])
            for name, parameter in self.splats.items():
                followed = role_of(name, self.splats) in PARAMETER_NAMES or len(parameter) == count
                allowed = f"{count} as in the state: load them before"
                require(followed, f"rows of splats['{name}']", len(parameter), allowed)
            self.trainer.load_state_dict(state["trainer"])
            if self.trainer.clearance is not None:
                self.trainer.clearance = replace(self.trainer.clearance, radii=state["radii"].to(self.trainer.device))
        except (KeyError, TypeError, IndexError, RuntimeError, ValueError) as error:
            raise InputError(f"the state does not fit this TurboStep: {error}") from None
        self.trainer.config.train.seed, self.steps, self._begun = state["seed"], state["steps"], True
        self._losses.restart()
        before = len(self.splats["means"])
        for name in self.optimizers if before != count else ():
            self.optimizers[name].state.clear()
        source = torch.arange(count, device=self.trainer.device).clamp(max=before - 1)
        self._follow(RowUpdate(source, torch.zeros_like(source, dtype=torch.bool), {}))

    def _catch_up(self) -> None:
        """Make iterations that had too little memory again, until none is missing."""
        self.trainer.repeat_lost(wait=True)
        while self.trainer.iteration < self.steps:
            self.trainer.step()
            self.trainer.repeat_lost(wait=True)

    def _begin(self) -> None:
        """Begin with the host's present Gaussians, and a backdrop behind them if one is wanted."""
        trainer, host = self.trainer, self._checked()
        kept = BACKDROP_COUNT if trainer.config.train.backdrop else 0
        backdrop = trainer.gaussians.map(lambda value: value[len(trainer.gaussians) - kept :].clone())
        backdrop.means += trainer.center
        trainer.begin_with(Gaussians(**{name: torch.cat([v, getattr(backdrop, name)]) for name, v in host.items()}))
        source = torch.arange(len(trainer.gaussians), device=trainer.device)
        fresh = source >= len(host)
        self._follow(RowUpdate(source.masked_fill(fresh, 0), fresh, {}))
        trainer.initialise_maps()
        self._begun = True

    def _follow(self, update: RowUpdate) -> None:
        """Carry a change of rows that the trainer has made over to the host."""
        now = replace(update, values=dict(self.trainer.gaussians.items()))
        apply_row_update(now, self.splats, self.optimizers, {}, self.scene)

    def _take_changes(self) -> None:
        """Take over values of parameters that the host replaced since the last step."""
        for name, parameter in self.splats.items():
            ours = dict(self.trainer.gaussians.items()).get(role_of(name, self.splats))
            if ours is None or parameter.data_ptr() == ours.data_ptr():
                continue
            if len(parameter) != len(ours):
                remedy = "TurboStep adds and removes Gaussians itself; leave density control out, or begin a new one"
                raise InputError(f"splats['{name}'] has {len(parameter)} rows, not {len(ours)} as before: {remedy}")
            ours.copy_(parameter.detach().reshape(ours.shape))
            parameter.data = ours.view(parameter.shape)

    def _checked(self) -> Gaussians:
        """The host's parameters, of a form that can be trained."""
        gaussians = host_gaussians(self.splats)
        for name, parameter in self.splats.items():
            role = role_of(name, self.splats)
            if parameter.dtype != torch.float32 and role in PARAMETER_NAMES:
                raise InputError(f"splats['{name}'] is of {parameter.dtype}: expected torch.float32")
            if parameter.dim() == 0 or len(parameter) != len(gaussians):
                expected = f"{len(gaussians)} rows, one a Gaussian; keep other parameters elsewhere"
                raise InputError(f"splats['{name}'] has shape {tuple(parameter.shape)}: expected {expected}")
            lost = int((~parameter.isfinite())[:, None].flatten(1).any(dim=1).sum())
            if lost and role in PARAMETER_NAMES:
                remedy = "mend or remove them"
                raise InputError(f"splats['{name}']: {lost} of {len(gaussians)} Gaussians are not finite: {remedy}")
            if parameter.requires_grad and role not in {*self.optimizers, *PARAMETER_NAMES}:
                remedy = "give optimizers, whose rows then follow"
                raise InputError(f"splats['{name}'] is trained by an optimizer of the host: {remedy}")
        require(gaussians.shN.shape[1] in BANDS, "bands of shN", gaussians.shN.shape[1], f"among {BANDS}")
        require(len(gaussians) >= 2, "number of Gaussians", len(gaussians), "2 or more")
        return gaussians


class HostTrainer(Trainer):
    """`Trainer` in a host's world, whose origin may be anywhere: density control and limits see the model with the
    cameras' centre as origin, where they expect it. `seen`: loss, colours and truth of the latest iteration."""

    _world: Gaussians

    def __init__(self, host: TurboStep, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.host, self.center = host, self.views.cameras.centers.mean(dim=0)
        if self.clearance is not None:
            self.clearance = replace(self.clearance, centers=self.clearance.centers - self.center)

    def supervise(self, colors: Tensor, truth: PhotoSamples, step: Step) -> LossOutput:
        output = super().supervise(colors, truth, step)
        self.seen = output, colors, truth
        return output

    def refine(self, step: Step) -> RowUpdate | None:
        with self._centred(self.density.event_due(step)):
            return super().refine(step)

    def follow(self, update: RowUpdate | None) -> None:
        with self._centred(update is not None or self.iteration % RESTRAIN_EVERY == 0):
            super().follow(update)

    def change_rows(self, update: RowUpdate) -> None:
        if "means" in update.values:
            update = replace(update, values=update.values | {"means": update.values["means"] + self.center})
        self.gaussians = self._world
        super().change_rows(update)
        self._world = self.gaussians
        self.host._follow(update)
        self.gaussians = replace(self._world, means=self._world.means - self.center)

    @contextmanager
    def _centred(self, wanted: bool) -> Iterator[None]:
        self._world = self.gaussians
        if wanted:
            self.gaussians = replace(self._world, means=self._world.means - self.center)
        try:
            yield
        finally:
            self.gaussians = self._world


class HostRates(LearningRates):
    """Learning rates, some of which are those of a host's optimizers, by the names of the parameters."""

    host: Mapping[str, torch.optim.Optimizer] = {}

    def at(self, step: Step) -> Any:
        rates = {name: float(optimizer.param_groups[0]["lr"]) for name, optimizer in self.host.items()}
        return replace(super().at(step), **rates)


def host_settings(config: str, overrides: Sequence[str], given: Mapping[str, str] = OWN_SETTINGS) -> Config:
    """The settings of a training in a host. Raises `InputError` for an override of one that is `given`, and why."""
    overrides = list(overrides) if isinstance(overrides, Iterable) and not isinstance(overrides, str) else [overrides]
    for override in overrides:
        require(isinstance(override, str), "an override", override, "text of the form section.key=value")
    refuse_overrides(overrides, given)
    return load_config(config, (*overrides, "train.exposure=false", "train.init=points"))


def scene_of(images: PosedImages, gaussians: Gaussians, scale: float | None) -> Scene:
    """A scene of a host's views, in the host's world, with its Gaussians as points and no test views."""
    points = gaussians.means.cpu()
    frame = Frame.around(images.cameras.centers.double().numpy(), points.double().numpy())
    extent = frame.scale if scale is None else scale.item() if isinstance(scale, Tensor) else scale
    require(is_number(extent) and 0 < extent < float("inf"), "scene_scale", scale, "above 0 and finite")
    nothing = replace(images, cameras=images.cameras.select(()), names=(), masks=None)
    colors = torch.zeros(len(points), 3, dtype=torch.uint8)
    return Scene("host", images, nothing, points, colors, frame, float(extent))
