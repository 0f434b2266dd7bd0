"""Training of a study's cells: variants x captures x seeds, in one process or in one for each GPU.

A cell that ends is kept in a file, and a process that trains one holds its lock (`StudyFolder`). So a call may be
stopped at any moment and made again until all cells are there, and several calls may share a study's folder.
"""

from __future__ import annotations

import itertools
import math
import multiprocessing
import os
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import astuple, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.config.sections import SceneConfig
from turbogs_plugin.device import free_device_memory, processor_cores
from turbogs_plugin.distributed.processes import end_with_parent, require_gpus
from turbogs_plugin.errors import InputError, TrainingStopped
from turbogs_plugin.report.provenance import Provenance, provenance
from turbogs_plugin.scene import Scene
from turbogs_plugin.study.cell import capture_digest, train_cell
from turbogs_plugin.study.grid import Ablation, CellKey, variant_config
from turbogs_plugin.study.results import Study, StudyFolder, changes, flat_settings
from turbogs_plugin.study.study_report import write_report
from turbogs_plugin.train.inputs import open_scene, resolve_device

MAY_DIFFER = ("scene.path", "train.seed", "train.device", "train.batch_for")
"""Beginnings of settings that may differ between cells of a variant: of the cell, and those that change no result."""


@dataclass(frozen=True)
class CellChoice:
    """What a call of a study trains: the options of `turbogs ablate`."""

    scenes: Sequence[Path]
    seeds: Sequence[int] = (0,)
    only: Sequence[str] = ()
    overrides: Sequence[str] = ()
    steps: int | None = None

    def configs(self, ablation: Ablation, gpus: int = 0) -> dict[CellKey, Config]:
        """Configuration of each cell, capture by capture, seed by seed. Raises `InputError`, also for too few GPUs."""
        paths = [path.resolve() for path in self.scenes]
        if not self.seeds or len(set(self.seeds)) != len(self.seeds):
            raise InputError(f"seeds: one or more different ones are needed, got {list(self.seeds)}")
        if len({path.name for path in paths}) < len(paths):
            raise InputError(f"scenes: two folders of {', '.join(map(str, paths))} are called the same: rename one")
        for path in paths:
            if not path.is_dir():
                raise InputError(f"no such scene: '{path}': give --scene the folder of a capture")
        configs: dict[CellKey, Config] = {}
        for path, seed, variant in itertools.product(paths, self.seeds, ablation.only(self.only)):
            config = variant_config(ablation, variant, seed, self.overrides, self.steps)
            require_gpus(gpus, config.train.device)
            config.scene.path, config.train.device = str(path), resolve_device(config.train.device).type
            configs[CellKey(path.name, variant, seed)] = config
            shared = next(iter(configs.values())).scene
            if config.scene.photos != shared.photos:
                raise InputError(f"variant '{variant}' changes the scene's photos, which all variants share")
        return configs


def run_study(ablation: Ablation, choice: CellChoice, out: Path, gpus: int | None = None) -> list[str]:
    """Train the cells that a study's folder has not yet, and write its report, also where the call is interrupted; a
    line for each cell that broke. Such a cell leaves no file, the others go on, and the next call tries it again.

    Args:
        gpus: number of this machine's GPUs, a process each; None: this process trains.

    Raises:
        InputError: a capture that cannot be read (the others' cells are trained first); anything else wrong with the
            input, or a cell made with other settings (then nothing was trained).
        TrainingStopped: a process was killed.
    """
    folder = StudyFolder(out)
    if not folder.file.is_file() and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"--out '{out}' is not empty and holds no study: choose a new folder")
    configs = choice.configs(ablation, gpus or 0)
    study = folder.read_study() if folder.file.is_file() else Study(ablation, [])
    _require_same(study, ablation, configs)
    folder.write_study(Study(ablation, study.results))
    if there := sum(result.key in configs for result in study.results):
        print(f"kept    {there} of {len(configs)} cells: these were trained before")
    here = provenance(next(iter(configs.values())).train.device)
    try:
        if gpus is None:
            return train_cells(ablation, choice, folder, here)
        return _train_on_gpus(gpus, (ablation, choice, folder, here))
    finally:
        if folder.read_study().results:
            print(f"report  {write_report(folder)}")


def train_cells(ablation: Ablation, choice: CellChoice, folder: StudyFolder, here: Provenance) -> list[str]:
    """Train, in this process, the cells that the folder has not and no other process trains; what broke. Raises
    `InputError` last, for captures that cannot be read, or are others than the finished cells'."""
    configs = choice.configs(ablation)
    device = torch.device(next(iter(configs.values())).train.device)
    warm: set[tuple[str, str]] = set()  # variants and captures
    broken: list[str] = []
    unread: dict[str, InputError] = {}  # by capture
    for number, (key, config) in enumerate(configs.items(), 1):
        with folder.claimed(key) as mine:
            study = folder.read_study()
            kept = {result.key: result for result in study.results}
            if key in kept:
                _require_same(study, ablation, {key: config})  # another call may have trained it meanwhile
            if not mine or key in kept or key.scene in unread:
                continue
            try:
                scene, digest, loading = _loaded(astuple(config.scene), config.train.refine_cameras)
                if any(cell.scene == key.scene and cell.capture not in ("", digest) for cell in kept.values()):
                    raise InputError(f"'{key.scene}' has other photos than its kept cells: choose a new --out")
            except InputError as error:
                unread[key.scene] = error
                continue
            try:
                free_device_memory(device)  # memory of a cell that broke
                is_warm = (key.variant, key.scene) in warm
                result = train_cell(key.variant, config, scene, device, here, loading, is_warm)
            except Exception as error:  # whatever a variant breaks by, the other cells go on
                broken.append(f"{key}: {type(error).__name__}: {' '.join(str(error).split())}")
                said = f"FAILED {broken[-1]}"
            else:
                warm.add((key.variant, key.scene))
                folder.write(result)
                psnr, end = result.final.get("psnr", math.nan), result.final
                said = f"{key}: {psnr:.2f} dB in {end['seconds']:.1f} s, {end['gaussians']} Gaussians"
            # One write with the end of the line, or the lines of two processes would stand on one.
            print(f"[{number}/{len(configs)}] {said}\n", end="", file=sys.stderr, flush=True)
    if unread:
        raise InputError("; ".join(map(str, unread.values())))
    return broken


@lru_cache(maxsize=2)  # with refined cameras and without
def _loaded(settings: tuple[Any, ...], refine: bool) -> tuple[Scene, str, float]:
    """Capture, its digest, and the seconds in which it was loaded. It stays for the next cells."""
    started = time.perf_counter()
    scene = open_scene(SceneConfig(*settings), refine)
    return scene, capture_digest(scene), time.perf_counter() - started


def _require_same(study: Study, ablation: Ablation, configs: dict[CellKey, Config]) -> None:
    """Raise `InputError` where a kept cell's variant is gone, or one of a variant that is asked for had other settings
    than these, whatever its capture and seed: a page has one mean of them."""
    if gone := [str(result.key) for result in study.results if result.variant not in ablation.variants]:
        raise InputError(f"the study has the cell '{gone[0]}': put its variant back, or choose a new --out")
    asked = {key.variant: flat_settings(config.to_mapping()) for key, config in configs.items()}
    for result in (result for result in study.results if result.variant in asked):
        differ = changes(asked[result.variant], result.settings)
        changed = [path for path in differ if not path.startswith(MAY_DIFFER)]
        if changed:
            raise InputError(f"cell '{result.key}' had other settings ({', '.join(changed[:4])}): choose a new --out")


def _train_on_gpus(gpus: int, arguments: tuple[Ablation, CellChoice, StudyFolder, Provenance]) -> list[str]:
    """`train_cells` by a process for each GPU."""
    try:
        with ProcessPoolExecutor(gpus, multiprocessing.get_context("spawn")) as pool:
            workers = [pool.submit(_work, gpu, gpus, arguments) for gpu in range(gpus)]
            return [line for worker in workers for line in worker.result()]
    except BrokenProcessPool:
        raise TrainingStopped("a process of this study was killed: call again to go on") from None


def _work(gpu: int, gpus: int, arguments: tuple[Ablation, CellChoice, StudyFolder, Provenance]) -> list[str]:
    """Task of a process, before it starts CUDA. It ends with the process that started it."""
    end_with_parent()
    assert (parent := multiprocessing.parent_process()) and parent.is_alive(), "the study was ended meanwhile"
    visible = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name]
    os.environ["CUDA_VISIBLE_DEVICES"] = visible[gpu] if gpu < len(visible) else str(gpu)
    # With as many threads as cores in each process, all would wait for one another at every parallel loop.
    torch.set_num_threads(max(1, processor_cores() // gpus))
    return train_cells(*arguments)
