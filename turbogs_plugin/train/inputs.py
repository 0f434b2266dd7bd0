"""Device and capture of a configuration."""

from __future__ import annotations

import importlib
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import torch

from turbogs_plugin.captures.bundle_adjustment import RefinedCameras, find_cameras, with_cameras
from turbogs_plugin.captures.load import load_scene, unseeing_note
from turbogs_plugin.config.configuration import Config
from turbogs_plugin.config.sections import SceneConfig
from turbogs_plugin.device import synchronize
from turbogs_plugin.distributed.ranks import ONE, Ranks
from turbogs_plugin.engine import library
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene import Scene
from turbogs_plugin.scene.agreement import require_agreement
from turbogs_plugin.train.wall import WallClock


def resolve_device(name: str) -> torch.device:
    """The device of ``auto``, ``cpu`` or ``cuda``. Raises `InputError` if CUDA is asked for and absent."""
    there = name != "cpu" and torch.cuda.is_available()
    if name == "cuda" and not there:
        why = "this PyTorch is built without CUDA" if torch.version.cuda is None else "no GPU answers"
        raise InputError(f"CUDA was asked for and is absent ({why}): see 'turbogs doctor', or begin with --device cpu")
    return torch.device("cuda" if there else "cpu")


def require_device(name: str) -> None:
    """`resolve_device`, for its error alone: by the driver's list, as CUDA itself starts while photos are decoded."""
    if name == "cuda" and torch.cuda.device_count() == 0:
        resolve_device(name)


def show_loading(loaded: int, total: int) -> None:
    """Count decoded photos in a terminal line, which goes when all are there; nothing where stderr is no terminal."""
    if sys.stderr.isatty():
        text = f"\r{loaded} of {total} photos decoded" if loaded < total else "\r\033[K"
        print(text, end="", file=sys.stderr, flush=True)


def open_scene(settings: SceneConfig, refine: bool, ranks: Ranks = ONE, trained: Path | None = None) -> Scene:
    """A capture. On a terminal, its photos are counted while they are decoded. Raises `InputError`: there is no usable
    capture, or no training on it can work.

    Args:
        refine: `train.refine_cameras`.
        ranks: the processes that train together; each calls this. The first refines cameras: last digits may differ.
        trained: the configuration of a run that has begun on it: whether training on it can work is not asked again.
    """
    if trained and not Path(settings.path).exists():
        named = f"{settings.path} does not exist; '{trained}' names it as scene.path"
        raise InputError(f"no such scene: {named}: write its new place there")
    first, found = ranks.first, list[RefinedCameras | None]()
    how = settings.factor, settings.test_every, show_loading if first else None, settings.validation
    scene = load_scene(settings.path, *how, lambda read: found.append(find_cameras(read, refine)) if first else None)
    if not (settings.force or trained):
        require_agreement(scene)
        if scene.drawn_points:
            from turbogs_plugin.reconstruct.pose_check import require_poses  # no other capture needs that room

            require_poses(scene)
    if note := unseeing_note(scene):
        scene = replace(scene, notes=(*scene.notes, note))
    return with_cameras(scene, ranks.agree(found[0] if found else None))


def open_started(
    config: Config, clock: WallClock, ranks: Ranks = ONE, trained: Path | None = None
) -> tuple[Scene, torch.device]:
    """The capture, and the device with its kernels loaded: a thread starts it, in a second or more, while photos are
    decoded. Both are marked on the clock of the wall. Arguments and errors as of `open_scene`. Where one process ends
    before, the others wait until their launcher ends them."""

    def start() -> torch.device:
        device = resolve_device(config.train.device)
        ranks.meet(device)
        synchronize(device)  # makes CUDA's context, and takes no memory through torch
        if device.type == "cuda":
            library.unavailable_reason()  # loads it
        for name in ("scipy.sparse.linalg", "scipy.spatial"):  # plan and initial model would wait for them
            importlib.import_module(name)
        return device

    with ThreadPoolExecutor(1) as pool:
        started = pool.submit(start)
        scene = open_scene(config.scene, config.train.refine_cameras, ranks, trained)
        clock.mark("photos")
        device = started.result()
    clock.mark("CUDA and kernels, after the photos")
    return scene, device
