"""Runs side by side as a study: runs with equal settings, but for the seed, are seeds of one variant."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.errors import InputError
from turbogs_plugin.files import unused_name
from turbogs_plugin.study.grid import Ablation
from turbogs_plugin.study.results import CellResult, Study, changes, curve_and_final, flat_settings, measured
from turbogs_plugin.train.history import Evaluation, read_history
from turbogs_plugin.train.run_files import RunFolder
from turbogs_plugin.train.wall import WallRecord

UNSHARED = ("scene.", "report.", "train.seed", "train.checkpoint_every", "train.evaluate_at")
"""Beginnings of settings in which runs of a variant may differ: seed, photos, and what is only reported or kept."""


def study_of_runs(paths: Sequence[Path]) -> Study:
    """The runs as cells of a study. A variant has the name of its first run; the first run's variant is the baseline.

    Runs are of one variant where they were asked for equal settings, whatever plan and budgets made of these. Raises
    `InputError`: no run there, one that is not finished, or two with equal settings and one seed."""
    variants: dict[str, dict[str, Any]] = {}  # name -> what its runs were asked for, without what is unshared
    scenes: dict[str, tuple[object, ...]] = {}  # name -> path, factor and test views
    results: list[CellResult] = []
    for path in paths:
        folder = RunFolder(path)
        config, history = folder.read_config(), read_history(folder.history)
        if not history:
            raise InputError(f"'{path}' has no evaluation yet: let the run go on")
        _require_finished(folder, config, history[-1])
        settings = flat_settings(folder.read_asked().to_mapping())
        shared = {key: value for key, value in settings.items() if not key.startswith(UNSHARED)}
        shared["train.device"] = config.train.device  # where it was trained
        place = (Path(config.scene.path), *config.scene.photos)
        curve, final = curve_and_final(history)
        wall = WallRecord.read(folder.wall)
        final |= measured({"wall_seconds": wall.wall_seconds if wall else None})
        final["peak_mib"] = history[-1].memory_bytes / 2**20
        named = re.sub(r"[^A-Za-z0-9_+.-]", "-", path.resolve().name)[:40].lstrip("._-")
        result = CellResult(
            scene=_name_of(place, place[0].name, scenes),
            variant=_name_of(shared, named, variants),
            seed=config.train.seed,
            settings=settings,
            planned=changes(settings, flat_settings(config.to_mapping())),
            curve=curve,
            final=final,
        )
        for other_path, other in zip(paths, results, strict=False):
            if other.key == result.key:
                said = f"'{path}' has the settings and the seed of '{other_path}'"
                raise InputError(f"{said}: leave one out, or compare a run with another train.seed")
        results.append(result)
    base = next(iter(variants))
    overrides = {
        name: [f"{key}={value}" for key, value in changes(variants[base], shared).items() if value is not None]
        for name, shared in variants.items()
    }
    return Study(Ablation(title=f"Comparison of {len(paths)} runs", variants=overrides, base=base), results)


def _name_of(thing: Any, wanted: str, known: dict[str, Any]) -> str:
    """Name by which a thing is known; a new one, made from the wanted name, for a thing that is not."""
    name = next((name for name, other in known.items() if other == thing), None) or unused_name(wanted or "run", known)
    known[name] = thing
    return name


def _require_finished(folder: RunFolder, config: Config, last: Evaluation) -> None:
    """Raise `InputError` where a run is not at its end, which a time budget sets after any number of iterations."""
    ended = config.budget.time or last.iteration >= int(config.train.iterations)
    if not (ended and folder.model.is_file()):
        resume = f"turbogs train --resume {shlex.quote(str(folder.path))}"
        raise InputError(f"'{folder.path}' is not finished (iteration {last.iteration}): let it go on with  {resume}")
