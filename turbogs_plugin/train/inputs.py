"""Device and capture of a configuration, and what can be refused before a photo is decoded."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import torch

from turbogs_plugin.captures.camera_refinement import load_and_find, with_cameras
from turbogs_plugin.config.configuration import Config
from turbogs_plugin.device import synchronize
from turbogs_plugin.distributed.ranks import ONE, Ranks
from turbogs_plugin.engine import compiled_kernels
from turbogs_plugin.errors import InputError
from turbogs_plugin.model.initial import BACKDROP_COUNT
from turbogs_plugin.plan.caps import cap_of, chosen_points, require_room
from turbogs_plugin.plan.memory import require_gpu_memory
from turbogs_plugin.scene import Scene
from turbogs_plugin.train.given_model import read_given
from turbogs_plugin.train.progress import LoadingProgress
from turbogs_plugin.train.run_files import RunFolder


def resolve_device(name: str, remedy: str = "use --device cpu, or see 'turbogs doctor'") -> torch.device:
    """The device of ``auto``, ``cpu`` or ``cuda``. Raises `InputError` if CUDA is asked for and absent."""
    if name == "cuda" and not torch.cuda.is_available():
        build = "this PyTorch is built without CUDA" if torch.version.cuda is None else "no GPU answers"
        raise InputError(f"CUDA was asked for and is absent ({build}): {remedy}")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def require_possible(config: Config) -> None:
    """Refuse what can be refused before the cameras of photos are found, or any photo is decoded.

    Raises:
        InputError: a device or a limit of its memory that this machine does not have; a model to start from that cannot
            be read; more Gaussians to start from than are allowed.
    """
    train, cap = config.train, cap_of(config)
    if train.device == "cuda":
        resolve_device("cuda")
    if config.budget.max_memory:
        require_gpu_memory(resolve_device(train.device))
    backdrop = BACKDROP_COUNT if train.backdrop is True else 0
    if train.starts_from_model:
        require_room(train.init, len(read_given(train.init)), cap, backdrop)
    else:
        chosen_points(1, cap, backdrop)


@contextmanager
def starting(resolve: Callable[[], torch.device], ranks: Ranks = ONE) -> Iterator[Future[torch.device]]:
    """While entered, a thread starts a device and loads its kernels: CUDA takes a second or more until it answers.

    Args:
        resolve: says which device; what it raises is raised by the future.
        ranks: the processes that train together; each calls this. Where one ends before, the others wait until their
            launcher ends them.

    Yields:
        The device, started.
    """

    def start() -> torch.device:
        device = resolve()
        ranks.meet(device)
        synchronize(device)  # makes CUDA's context, and takes no memory through torch
        if device.type == "cuda":
            compiled_kernels()
        return device

    with ThreadPoolExecutor(1) as pool:
        yield pool.submit(start)


def open_scene(config: Config, folder: RunFolder | None = None, ranks: Ranks = ONE) -> Scene:
    """The capture of a configuration.

    Args:
        folder: of the run with this configuration; None if the user names the capture.
        ranks: the processes that train together; each calls this.

    Raises:
        InputError: there is no usable capture.
    """
    settings = config.scene
    if folder is not None and not Path(settings.path).exists():
        raise InputError(
            f"capture '{settings.path}' of the run in '{folder.path}' is not there: bring it back, or edit scene.path "
            f"in {folder.config}"
        )
    return read_scene(settings.path, config, LoadingProgress() if ranks.first else None, ranks)


def read_scene(
    path: str | Path, config: Config, progress: Callable[[int, int], None] | None = None, ranks: Ranks = ONE
) -> Scene:
    """A capture as a configuration trains on it.

    Args:
        progress: as of `load_scene`.
        ranks: the processes that train together; each calls this. The first one refines cameras for all: machines
            differ in their last digits, and replicas may not.

    Raises:
        InputError: as `load_scene`.
    """
    settings = config.scene
    scene, cameras = load_and_find(path, settings.factor, settings.test_every, progress, find=ranks.first)
    return with_cameras(scene, ranks.agree(cameras), config.train.refine_cameras)
