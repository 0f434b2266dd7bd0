"""Carries a grid out: variants x scenes x seeds in one process, resumable, with the scene loaded once."""

from __future__ import annotations

import itertools
import json
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from turbogs_plugin.captures.camera_refinement import load_and_find, with_cameras
from turbogs_plugin.config.configuration import Config
from turbogs_plugin.config.old_spellings import old_spelling
from turbogs_plugin.device import free_device_memory, synchronize
from turbogs_plugin.errors import InputError, TrainingStopped
from turbogs_plugin.report.provenance import Provenance
from turbogs_plugin.report.tensorboard import EventWriter, event_writers
from turbogs_plugin.scene import Scene
from turbogs_plugin.study.cell import capture_digest, train_cell
from turbogs_plugin.study.claims import Claims
from turbogs_plugin.study.difference import ABSENT, compared, difference
from turbogs_plugin.study.folder import StudyFolder
from turbogs_plugin.study.grid import Ablation, CellKey, variant_config
from turbogs_plugin.study.progress import SweepProgress
from turbogs_plugin.study.results import CellResult, Failure, Study
from turbogs_plugin.train.start import resolve_device

POLL_SECONDS = 1.0
"""Between two looks at cells that other processes train."""

UNCOMPARED = ("scene.path", "train.device", "train.batch_for", "report.tensorboard")
"""Settings that may differ between a kept cell and the present call: where things are, who is told, and a batch for
several processes, of which a cell has one, change no result."""


@dataclass
class SweepOptions:
    """How a grid is carried out.

    Args:
        scenes: folders of captures, of different names.
        seeds: of each variant.
        overrides: ``section.key=value`` of all variants.
        steps: iterations of every cell; None: the configurations' own.
        device: auto, cpu or cuda.
        within: seconds after which no further cell begins; None: all are trained.
        gpus: numbers of this machine's GPUs, each of which a process of its own uses; none: this process trains.
    """

    scenes: Sequence[Path]
    seeds: Sequence[int] = (0,)
    overrides: Sequence[str] = ()
    steps: int | None = None
    device: str = "auto"
    within: float | None = None
    gpus: Sequence[int] = ()

    def __post_init__(self) -> None:
        scenes = [path.resolve() for path in self.scenes]
        for what, values in (("scenes", [str(path) for path in scenes]), ("seeds", list(self.seeds))):
            if not values or len(set(values)) != len(values):
                raise InputError(f"{what}: one or more different ones are needed, got {values}")
        for first, second in itertools.combinations(scenes, 2):
            if first.name == second.name:
                raise InputError(f"scenes: two folders are called '{first.name}', {first} and {second}: rename one")


@dataclass(frozen=True)
class _Cell:
    """One that is to be trained.

    Args:
        scene: as it is trained on.
        loading: seconds until it was there.
        capture: digest of the capture.
    """

    key: CellKey
    config: Config
    scene: Scene
    loading: float
    capture: str


def run_sweep(
    ablation: Ablation,
    variants: Sequence[str],
    options: SweepOptions,
    here: Provenance,
    folder: StudyFolder,
    siblings: Sequence[StudyFolder] = (),
    begun: float | None = None,
) -> int:
    """Train the cells that are not there yet and keep each result as it comes.

    A cell that breaks is kept as a failure and the rest goes on; the same call tries it again. Other processes may do
    the same at the same time, on other machines too: each cell is trained by one of them (`claims`), and this one
    returns when all are there.

    Args:
        ablation: all of it is what the study is of.
        variants: of it, the ones to train now.
        here: machine and sources, as they were when the process began.
        siblings: studies by this very process, whose cells of the same settings are taken, if the same sources made
            them on the same machine. Tables share variants, the baseline above all.
        begun: `time.monotonic` from which `options.within` counts; now where absent.

    Returns:
        How many cells are left, for another call, because `options.within` was over.

    Raises:
        InputError: anything wrong with the input (then nothing was trained), or a cell made by another configuration.
        TrainingStopped: the GPU can no longer be used by this process.
    """
    begun = time.monotonic() if begun is None else begun
    call = {"overrides": list(options.overrides), "steps": options.steps}
    folder.require_usable()
    before = written_before(options, variants, folder)  # first of all: a cell that ends after this has another time
    finished = {result.key: result for result in _study_there(folder, ablation).results}
    for result in finished.values():
        if result.variant not in ablation.variants:
            raise InputError(f"'{folder.path}' has a cell of another ablation ({result.key}): choose a new --out")
    device = resolve_device(options.device)
    reusable = _reusable_cells(here, siblings)
    repeated: list[CellResult] = []
    left: list[_Cell] = []
    # All scenes are read before anything is trained, so that a wrong one is known at once.
    for path in options.scenes:
        name = path.resolve().name
        configs = _scene_configs(ablation, variants, options, path.resolve(), device)
        settings = next(iter(configs.values())).scene
        started = time.perf_counter()
        scene, cameras = load_and_find(path, settings.factor, settings.test_every)
        loading = time.perf_counter() - started
        capture = capture_digest(scene)
        prepared: dict[bool, tuple[Scene, float]] = {}  # refined cameras or not -> the scene, seconds
        for key, config in configs.items():
            known = reusable.get((name, capture, _comparable(config.to_mapping())))
            if key in finished:
                _require_same(finished[key], config)
            elif known is not None:
                repeated.append(replace(known, variant=key.variant, **call))
            else:
                if (refined := config.train.refine_cameras) not in prepared:
                    started = time.perf_counter()
                    own = with_cameras(scene, cameras, refined)
                    prepared[refined] = own, loading + time.perf_counter() - started
                left.append(_Cell(key, config, *prepared[refined], capture))
        for key, result in finished.items():
            if key.scene == name and result.capture not in ("", capture):
                raise InputError(
                    f"the cell '{key}' has other photos or cameras than '{name}' has now: choose a new --out"
                )
        del scene, prepared  # where no cell needs it: photos take room
    # What is there is read anew, for others may have ended cells while the photos were read.
    folder.write_study(replace(_study_there(folder, ablation), ablation=ablation))
    for result in repeated:
        if folder.written(result.key) == before[result.key]:
            folder.write(result)
    wanted = len(options.scenes) * len(options.seeds) * len(variants)
    claims = Claims(folder.claims)
    warm: set[tuple[str, str]] = set()  # variants and captures: a plan is of a capture
    with SweepProgress(len(left), wanted - len(left)) as progress:
        while left and not (options.within is not None and time.monotonic() - begun > options.within):
            taken = next(((place, claim) for place, cell in enumerate(left) if (claim := claims.take(cell.key))), None)
            if taken is None:
                time.sleep(POLL_SECONDS)
                continue
            place, claim = taken
            cell = left.pop(place)  # the photos go with the last cell that needs them
            key, config, scene = cell.key, cell.config, cell.scene
            with claim.kept():
                if folder.written(key) != before[key]:
                    progress.ended_elsewhere()
                    continue
                progress.begin(key)
                path = (folder.tensorboard / key.file).with_suffix("")
                events = [EventWriter(path, scene.test, config.report.strips)] if config.report.tensorboard else []
                listeners = [progress, *events]
                try:
                    trained = (key.variant, key.scene) in warm
                    outcome = train_cell(
                        key.variant, config, scene, device, here, listeners, cell.loading, trained, cell.capture
                    )
                    outcome = replace(outcome, **call)
                    warm.add((key.variant, key.scene))
                except Exception as error:  # whatever a variant breaks by, the other cells go on
                    outcome = Failure(key, _reason(error))
                finally:
                    for writer in events:
                        writer.close()
                if not claim.held:
                    progress.ended_elsewhere()
                    continue
                folder.write(outcome)
            progress.ended(outcome)
            if isinstance(outcome, Failure):
                _require_working(device)
    return len(left)


def written_before(options: SweepOptions, variants: Sequence[str], folder: StudyFolder) -> dict[CellKey, int]:
    """The cells asked for, and when the file of each was last written until now (`StudyFolder.written`)."""
    names = [path.resolve().name for path in options.scenes]
    keys = itertools.starmap(CellKey, itertools.product(names, variants, options.seeds))
    return {key: folder.written(key) for key in keys}


def cells_left(before: Mapping[CellKey, int], folder: StudyFolder) -> int:
    """How many of the cells of `written_before` have no result, and no failure since then: older ones are retried."""
    finished = {result.key for result in folder.read_study().results}
    return sum(key not in finished and folder.written(key) == written for key, written in before.items())


def _study_there(folder: StudyFolder, ablation: Ablation) -> Study:
    """What the folder holds; nothing of the ablation where it holds no study yet."""
    return folder.read_study() if folder.file.is_file() else Study(ablation, [])


def _scene_configs(
    ablation: Ablation, variants: Sequence[str], options: SweepOptions, scene: Path, device: torch.device
) -> dict[CellKey, Config]:
    """The cells of a scene, seed after seed.

    Raises:
        InputError: they would not share its photos, or event files are asked for and cannot be written.
    """
    configs: dict[CellKey, Config] = {}
    for seed in options.seeds:
        for variant in variants:
            config = variant_config(ablation, variant, seed, options.overrides, options.steps)
            config.scene.path, config.train.device = str(scene), device.type
            event_writers(config)  # which can be made
            configs[CellKey(scene.name, variant, seed)] = config
            if config.scene != next(iter(configs.values())).scene:
                raise InputError(f"variant '{variant}' changes the scene's photos, which all variants share")
    return configs


def _require_same(present: CellResult, config: Config) -> None:
    old = old_spelling(present.asked)
    if old:
        raise InputError(f"the cell '{present.key}' is of an earlier version ({old}): choose a new --out")
    changes = difference(compared(present.asked, UNCOMPARED), compared(config.to_mapping(), UNCOMPARED))
    if changes:
        sections = dict.fromkeys(path.partition(".")[0] for path in [*changes.pop(ABSENT, ()), *changes])
        raise InputError(
            f"the cell '{present.key}' was made with other settings ({', '.join(sections)}): choose a new --out"
        )


def _reusable_cells(here: Provenance, siblings: Sequence[StudyFolder]) -> dict[tuple[str, str, str], CellResult]:
    """(scene, capture, settings) -> a result of another study that a cell of these settings would repeat."""
    results = [result for folder in siblings for result in folder.read_study().results]
    return {
        (result.scene, result.capture, _comparable(result.asked)): result
        for result in results
        if result.capture and result.provenance == here
    }


def _comparable(mapping: dict[str, Any]) -> str:
    """``section.key`` -> value of what decides a result, as a text to compare."""
    return json.dumps(compared(mapping, UNCOMPARED), sort_keys=True)


def _reason(error: Exception) -> str:
    """One line: what happened, and where unless the message is written for the user."""
    text = " ".join(str(error).split()) or "no message"
    if isinstance(error, InputError | TrainingStopped):
        return text
    frame = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {text[:500]} ({Path(frame.filename).name}:{frame.lineno})"


def _require_working(device: torch.device) -> None:
    """After a failure: see whether the GPU still answers this process, and free the broken model's memory."""
    try:
        synchronize(device)
    except RuntimeError as error:
        reason = str(error).splitlines()[0]
        raise TrainingStopped(f"the GPU no longer answers this process ({reason}): the same command goes on") from None
    free_device_memory(device)
