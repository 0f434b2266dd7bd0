"""A tiny capture and a tiny configuration for tests of whole runs."""

import shutil
import signal
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
import torch

from turbogs_plugin.captures import load_scene, write_demo_capture
from turbogs_plugin.captures.undistort import load_pycolmap
from turbogs_plugin.config.configuration import Config, load_config
from turbogs_plugin.engine import Engine
from turbogs_plugin.scene import Scene
from turbogs_plugin.train.checkpoint import latest_checkpoint, load_checkpoint
from turbogs_plugin.train.trainer import Trainer

TINY = (
    *("train.iterations=14", "train.refine_until=9", "train.sh_degree=2", "train.sh_interval=4"),
    *("train.evaluate_at=[0.5]", "train.checkpoint_every=5"),
    *("schedule.min_views=2", "schedule.max_views=4", "schedule.pixel_budget=0.3"),
    *("density.refine_from=2", "density.refine_every=3", "density.final_every=2", "density.grad_threshold=1e-6"),
    *("density.top_fraction=0.3", "density.opacity_decay=0.2"),
)

ENDLESS = ("train.iterations=100000", "train.refine_until=9", "train.checkpoint_every=3", "train.evaluate_at=[]")
"""After `TINY`: a run that no test waits for."""


def without_replaced(settings: Sequence[str], overrides: Sequence[str]) -> list[str]:
    """Settings without those of sections whose type an override changes: these start afresh."""
    replaced = tuple(text.partition("type=")[0] for text in overrides if ".type=" in text)
    return [text for text in settings if not text.startswith(replaced)]


def tiny_capture(folder: Path) -> Path:
    """8 photos of 40x24, of which 7 train, and some 70 points: every sixteenth of the demo capture's."""
    return Path(shutil.copytree(_tiny_capture().name, folder / "capture"))


@cache
def _tiny_capture() -> TemporaryDirectory:
    """Made once in a process; gone with it."""
    folder = TemporaryDirectory(prefix="tiny-capture-")
    Path(folder.name).rmdir()
    thin_out_points(write_demo_capture(Path(folder.name), views=8, width=40, height=24), 16)
    return folder


def thin_out_points(capture: Path, every: int) -> Path:
    """The capture with a share of its points: 1 of `every`."""
    reconstruction = load_pycolmap().Reconstruction(capture / "sparse/0")
    for point in [point for point in reconstruction.points3D if point % every]:
        reconstruction.delete_point3D(point)
    reconstruction.write_binary(capture / "sparse/0")
    return capture


def tiny_config(capture: Path | str, *overrides: str) -> Config:
    """14 iterations with three densifications, two final prunings and three SH degrees; an override may change the type
    of a strategy."""
    config = load_config("turbogs", [*without_replaced(TINY, overrides), "train.device=cpu", *overrides])
    config.scene.path = str(capture)
    return config


def tiny_trainer(scene: Scene | Path, *overrides: str, engine: Engine | None = None) -> Trainer:
    """A trainer on the CPU, on a scene or a capture, with its first maps."""
    scene = scene if isinstance(scene, Scene) else load_scene(scene)
    trainer = Trainer(tiny_config("capture", *overrides).without_plan(), scene, torch.device("cpu"), engine=engine)
    trainer.initialise_maps()
    return trainer


def saved(run: Path) -> dict:
    """The state of the trainer in the newest checkpoint of a run's folder."""
    return load_checkpoint(latest_checkpoint(run / "checkpoints"))["trainer"]


def interrupt(trainer: Trainer) -> None:
    """Ctrl-C."""
    signal.raise_signal(signal.SIGINT)


def stop_after(
    monkeypatch: pytest.MonkeyPatch, iteration: int, action: Callable[[Trainer], object] = interrupt
) -> None:
    """Run `action` within the step that finishes this many iterations."""
    step = Trainer.step

    def stepping(trainer: Trainer) -> None:
        step(trainer)
        if trainer.iteration == iteration:
            action(trainer)

    monkeypatch.setattr(Trainer, "step", stepping)


def assert_identical(a, b, place: str = "state") -> None:
    """Nested states, to the last bit and type."""
    if isinstance(a, dict):
        assert a.keys() == b.keys(), place
        for key in a:
            assert_identical(a[key], b[key], f"{place}.{key}")
    elif isinstance(a, torch.Tensor):
        assert a.dtype == b.dtype and torch.equal(a, b), place
    else:
        assert a == b, place


def assert_iterations_wait_for_nothing(trainer: Trainer) -> None:
    """After some iterations, further ones never make the host wait for the GPU, and none of them is lost."""
    trainer.initialise_maps()
    for _ in range(5):
        trainer.step()
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(3):
            trainer.step()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert int(trainer.nonfinite_losses) == int(trainer.optimizer.skipped) == 0
