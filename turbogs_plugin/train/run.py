"""Training: in memory, by `fit`; or as a run in a folder, new or resumed, with checkpoints, up to a saved model."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from turbogs_plugin.captures.bundle_adjustment import refine_cameras
from turbogs_plugin.captures.load import holds_photos_alone
from turbogs_plugin.config.components import KINDS, completed
from turbogs_plugin.config.configuration import DEFAULT_CONFIG, Config, load_config, resolve
from turbogs_plugin.config.scaling import with_iterations
from turbogs_plugin.device import cpu_note, free_bytes
from turbogs_plugin.distributed.ranks import ONE, Ranks
from turbogs_plugin.engine.layout import MAX_VIEWS
from turbogs_plugin.errors import InputError, nearest
from turbogs_plugin.files import require_writable, write_text_atomically
from turbogs_plugin.model.ply import save_ply
from turbogs_plugin.plan import Plan, make_plan
from turbogs_plugin.plan.memory import hold_to_limit, most_views, room_note, within_memory
from turbogs_plugin.plan.photo_gains import PhotoGains
from turbogs_plugin.scene import Scene
from turbogs_plugin.scene.offload import place_views
from turbogs_plugin.strategies.protocols import Strategies
from turbogs_plugin.train.checkpoint import latest_checkpoint, load_checkpoint
from turbogs_plugin.train.history import Evaluation, rewind_history
from turbogs_plugin.train.inputs import open_scene, open_started, require_device, resolve_device
from turbogs_plugin.train.loop import TrainingLoop
from turbogs_plugin.train.metrics import Evaluations, Metrics
from turbogs_plugin.train.pace import Pace, fitted_to_time
from turbogs_plugin.train.run_files import RunFolder
from turbogs_plugin.train.saved_model import require_model
from turbogs_plugin.train.session import Report, RunSession, TrainingProgress, Watch
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.train.wall import WallClock
from turbogs_plugin.types import Gaussians

if TYPE_CHECKING:
    from typing_extensions import Unpack


def plan_run(config: Config, processes: int = 1) -> Plan:
    """The plan that `train` would make now, with this number of processes. The capture's notes are printed."""
    device = resolve_device(config.train.device)
    scene = open_scene(config.scene, config.train.refine_cameras)
    plan = make_plan(config, scene, device, processes)
    print("\n".join(scene.notes), file=sys.stderr)  # last, as an error is one line alone
    return plan


def new_loop(
    config: Config, scene: Scene, device: torch.device, ranks: Ranks = ONE, gains: PhotoGains | None = None
) -> TrainingLoop:
    """A training that has not begun, within its budgets.

    Args:
        config: decided (`Plan.apply`). The trainer gets it with the cap and the iterations that keep the budgets.
        ranks: the processes that train this model together; each calls this.
        gains: the photos', from the facts of the plan.

    Raises:
        InputError: a limit of memory is too small, or the schedule has more views an iteration than a GPU takes.
    """
    views, on_gpu = most_views(config, len(scene.train)), device.type == "cuda"
    if on_gpu and views > MAX_VIEWS:
        raise InputError(f"schedule: {views} views an iteration, and a GPU takes at most {MAX_VIEWS}: ask for fewer")
    hold_to_limit(config, device)
    if ranks.count > 1:  # the first process's plan: plans look at the machine's free memory, which differs
        config = resolve(ranks.agree(config.to_mapping()))
    config = within_memory(config, scene)
    if on_gpu and ranks.first and (note := room_note(config, scene, free_bytes(device))):
        print(note, file=sys.stderr)
    config, seconds = fitted_to_time(config, scene, device, ranks, gains)
    trainer = Trainer(config, scene, device, ranks.engine(device), gains)
    return TrainingLoop(trainer, Pace(config.train, config.budget.seconds()), seconds=seconds, ranks=ranks)


@dataclass(repr=False)
class Fit:
    """A finished training.

    Args:
        gaussians: the model, on the device of the training and in the scene's coordinates.
        config: what the training went by, decided by the plan.
        history: the evaluations on the test views, the last one at the end.
        metrics: errors of each test view at the end.
    """

    gaussians: Gaussians
    scene: Scene
    config: Config
    history: list[Evaluation]
    metrics: Metrics

    def save(self, path: Path | str) -> None:
        """Write the model as a .ply in the capture's own coordinates."""
        save_ply(self.gaussians, Path(path), self.scene.frame)

    def __repr__(self) -> str:
        end = self.history[-1]
        return f"Fit of {self.scene!r}: {self.gaussians!r}, {end.psnr:.2f} dB after {end.train_seconds:.1f} s"


def fit(
    scene: Scene | Path | str,
    *overrides: str,
    config: str | Path | Mapping[str, Any] = DEFAULT_CONFIG,
    iterations: int | None = None,
    callback: Callable[[Evaluation], object] | None = None,
    progress: bool = False,
    **strategies: Unpack[Strategies],
) -> Fit:
    """Train in memory: nothing is written.

    Args:
        scene: a loaded one, its photos in host memory; or the folder of a capture, which the section `scene` of the
            configuration says how to read.
        overrides: changes of the configuration, ``section.key=value``, as ``"train.iterations=500"``.
        config: name of a packaged configuration, a YAML file, or a mapping like that of a YAML.
        iterations: in the place of `train.iterations`, with all that counts them.
        callback: called with each evaluation (`train.evaluate_at`).
        progress: show a line for each evaluation on stderr, and on a terminal the seconds left.
        strategies: objects in the place of those that the configuration names, by kind: ``pixel_sampler=MySampler()``.

    Raises:
        InputError: anything wrong with the input.
        TrainingStopped: the training cannot go on.
    """
    for kind, strategy in strategies.items():
        if kind not in KINDS:
            known = (*KINDS, "callback", "config", "iterations", "progress")
            raise InputError(f"fit: there is no '{kind}': {nearest(kind, known)}")
        if isinstance(strategy, type):
            raise InputError(f"fit: {kind}={strategy.__name__} is a class: give an object, {strategy.__name__}(...)")
    settings = load_config(config if isinstance(config, Mapping) else str(config), overrides)
    settings = settings if iterations is None else with_iterations(settings, iterations)
    device, refine = resolve_device(settings.train.device), settings.train.refine_cameras
    if isinstance(scene, Scene):
        scene = refine_cameras(scene, refine)
    else:
        scene = open_scene(replace(settings.scene, path=str(scene)), refine)
    plan = make_plan(settings, scene, device)
    loop = new_loop(plan.apply(settings), scene, device, gains=plan.facts.gains)
    for kind, strategy in strategies.items():
        loop.trainer.take(kind, completed(kind, strategy, f"fit: {type(strategy).__name__}"))
    trained = loop.trainer.config
    evaluations = Evaluations(place_views(scene.test, device, trained.train.pixels_place), callback)
    loop.listeners = [evaluations]
    with closing(TrainingProgress()) as shown:
        if progress:
            loop.listeners.append(shown)
        loop.run()
    assert evaluations.metrics is not None
    return Fit(loop.trainer.gaussians, scene, trained, evaluations.history, evaluations.metrics)


def train(
    config: Config,
    out: Path,
    report: Report | None = None,
    clock: WallClock | None = None,
    ranks: Ranks = ONE,
    watch: Watch = (),
    overwrite: bool = False,
) -> RunSession:
    """Train from the start into a new folder. The plan is printed first. Photos alone are reconstructed before.

    Args:
        report: called with the finished run; `turbogs_plugin.report.run_report.write_report` writes its page.
        clock: of the wall; None: it begins now.
        ranks: the processes that train this model together; each calls this, and the first one writes and prints.
        overwrite: a run that the folder holds is `RunFolder.replaced`.

    Raises:
        InputError: anything wrong with the input; then nothing was written.
        TrainingStopped: the run cannot go on; the files that it saved stay.
    """
    clock = clock or WallClock()
    folder = RunFolder(out)
    require_device(config.train.device)
    if ranks.first:
        folder.require_new(overwrite)
    if config.train.starts_from_model:
        require_model(config.train.init)  # before minutes of photos
    posed = ranks.agree(_posed_capture(config, out) if ranks.first else "")
    if posed != config.scene.path:
        clock.mark("cameras of photos alone")
        config = replace(config, scene=replace(config.scene, path=posed))
    scene, device = open_started(config, clock, ranks)
    plan = make_plan(config, scene, device, ranks.count)
    clock.mark("plan")
    with _fitting(scene):
        loop = new_loop(_independent(plan.apply(config), device), scene, device, ranks, plan.facts.gains)
        session = RunSession(folder, scene, loop, clock)
    with ExitStack() as held:
        if overwrite:
            held.enter_context(folder.replaced())
        if ranks.first:
            held.enter_context(folder.owned(new=True))
            resolved, told = loop.trainer.config, [*scene.notes, plan.text()]
            if seconds := resolved.budget.seconds():
                told.append(f"{seconds:g} s of training: about {resolved.train.iterations} iterations")
            if device.type == "cpu":
                told.append(cpu_note())
            print("\n".join(told), file=sys.stderr)
            write_text_atomically(folder.asked, config.to_yaml())  # first: it tells a run that has begun
            write_text_atomically(folder.plan, plan.text() + "\n")
            write_text_atomically(folder.config, resolved.to_yaml())
        return session.run(report, watch)


def resume(
    path: Path,
    report: Report | None = None,
    clock: WallClock | None = None,
    ranks: Ranks = ONE,
    watch: Watch = (),
    trusted: bool = False,
) -> RunSession:
    """Go on with a stopped run from its newest checkpoint, with its own configuration, in which nothing is `auto`. On a
    CPU, the result is bit for bit that of a run never stopped; `TrainingState.state_dict` says why. Arguments as of
    `train` and `resolve_complete`; the number of processes may be another than before.

    Raises:
        InputError: no run there, a finished one without checkpoints, an unusable checkpoint, a changed capture, or a
            machine without what the run needs; then nothing was changed.
        TrainingStopped: the run cannot go on.
    """
    clock = clock or WallClock()
    folder = RunFolder(path)
    config = folder.read_config(True, trusted)
    require_device(config.train.device)
    require_writable(folder.path, f"what --resume {folder.path} writes")
    with folder.owned() if ranks.first else nullcontext():
        checkpoint, model = latest_checkpoint(folder.checkpoints), folder.model
        if checkpoint is None and model.is_file():
            raise InputError(f"'{folder.path}' is finished and has no checkpoint to go on from: use its {model.name}")
        state = None if checkpoint is None else load_checkpoint(checkpoint)
        scene, device = open_started(config, clock, ranks, trained=folder.config)
        hold_to_limit(config, device)
        with _fitting(scene):
            trainer = Trainer(config, scene, device, ranks.engine(device), resuming=state is not None)
            loop = TrainingLoop(trainer, Pace(config.train, config.budget.seconds()), ranks=ranks)
            session = RunSession(folder, scene, loop, clock)
            if state is not None:
                session.load_state_dict(state, str(checkpoint))
        if ranks.first:
            session.history += rewind_history(folder.history, trainer.iteration if session.resumed else -1)
        return session.run(report, watch)


def _posed_capture(config: Config, out: Path) -> str:
    """The path of the capture; for photos alone, the path of their reconstruction, which is made."""
    if not holds_photos_alone(Path(config.scene.path)):
        return config.scene.path
    from turbogs_plugin.reconstruct.run import reconstruct_beside  # no other run needs that room

    return str(reconstruct_beside(Path(config.scene.path), out))


@contextmanager
def _fitting(scene: Scene) -> Iterator[None]:
    """Turn a lack of device memory before training into an `InputError` that names a remedy."""
    remedy = "use train.pixels_place=host, --max-gaussians or a larger --factor, or end what else is in that memory"
    try:
        yield
    except torch.cuda.OutOfMemoryError:
        raise InputError(f"'{scene.name}' does not fit into the device's memory: {remedy}") from None


def _independent(config: Config, device: torch.device) -> Config:
    """The configuration with absolute paths and the device in use, so that a resume finds the same from any folder."""
    config.scene.path = str(Path(config.scene.path).resolve())
    if config.train.starts_from_model:
        config.train.init = str(Path(config.train.init).resolve())
    config.train.device = device.type
    return config
