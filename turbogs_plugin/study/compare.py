"""Any runs side by side, as an ablation of them: runs that were asked the same are seeds of one variant."""

from __future__ import annotations

import itertools
import math
import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.config.sections import SceneConfig
from turbogs_plugin.errors import InputError
from turbogs_plugin.files import unused_name
from turbogs_plugin.study.difference import ABSENT, compared, difference
from turbogs_plugin.study.grid import Ablation
from turbogs_plugin.study.results import CellResult, Study
from turbogs_plugin.train.clock import WallRecord
from turbogs_plugin.train.history import Evaluation, read_history
from turbogs_plugin.train.run_files import RunFolder

UNSHARED = ("scene.", "report.", "train.seed", "train.checkpoint_every", "train.evaluate_at")
"""Sections and settings in which the runs of a variant may differ: seed, photos, and what is only reported or kept."""


def study_of_runs(paths: Sequence[Path]) -> Study:
    """The runs' histories as cells. A variant is called as its first run; the first run's variant is the baseline.

    Runs are of one variant where the same was asked for. What plan and budgets make of it does not count, for that
    differs from machine to machine and from seed to seed.

    Raises:
        InputError: no run there, one that is not finished, or two of the same settings and seed.
    """
    variants: dict[str, dict[str, Any]] = {}  # name -> what was asked for without the seed and the place
    results: list[CellResult] = []
    folders = [RunFolder(path) for path in paths]
    configs = [folder.read_config() for folder in folders]
    scenes = _scene_names([config.scene for config in configs])
    for path, folder, config, scene in zip(paths, folders, configs, scenes, strict=True):
        history = read_history(folder.history)
        if not history:
            raise InputError(f"'{path}' has no evaluation yet")
        _require_finished(folder, config, history[-1])
        asked = folder.read_asked().to_mapping()
        shared = compared(asked, UNSHARED) | {"train.device": config.train.device}  # where it was trained
        folder_name = re.sub(r"[^A-Za-z0-9_+.-]", "-", path.resolve().name)[:40].lstrip("._-") or "run"
        name = next((name for name, known in variants.items() if known == shared), unused_name(folder_name, variants))
        variants[name] = shared
        result = CellResult(
            scene=scene,
            variant=name,
            seed=config.train.seed,
            lpips_reason="a run's history does not record it; see the runs' own reports",
            config=config.to_mapping(),
            asked=asked,
            peak_bytes=history[-1].memory_bytes,  # a CPU run records the peak of its process, which is its own
            wall_seconds=wall.wall_seconds if (wall := WallRecord.read(folder.wall)) else math.nan,
            history=history,
        )
        for other_path, other in zip(paths, results, strict=False):
            if path.resolve() == other_path.resolve():
                raise InputError(f"'{path}' is given twice, and a run is not compared with itself: leave one out")
            if other.key == result.key:
                raise InputError(
                    f"'{path}' has the settings and the seed of '{other_path}': leave one out, or compare a run with "
                    "another train.seed"
                )
        results.append(result)
    base = next(iter(variants))
    overrides = {
        name: [f"{path}={value}" for path, value in difference(variants[base], shared).items() if path != ABSENT]
        for name, shared in variants.items()
    }
    return Study(Ablation(title=f"Comparison of {len(paths)} runs", variants=overrides, base=base), results)


def _require_finished(folder: RunFolder, config: Config, last: Evaluation) -> None:
    """Raise `InputError` where a run's last evaluation is not that of its end.

    A time budget ends a run within half an iteration of it, after a number of iterations that only checkpoints tell.
    These are large, and may be gone: they are read only where the last evaluation is nearer to the one that was to be
    before it than to the end of the budget. A model alone says nothing, for an export of a stopped run leaves one, too.
    """
    seconds = config.budget.seconds()
    if seconds is None:
        finished = last.iteration >= config.train.iterations
        at = f"iteration {last.iteration} of {config.train.iterations}"
    else:
        before = max((share for share in config.train.evaluate_at if share < 1.0), default=0.0)
        finished = last.train_seconds > 0.5 * (before + 1.0) * seconds or folder.finished_text(False) != ""
        at = f"{last.train_seconds:.1f} of {seconds:g} s"
    if not finished:
        raise InputError(
            f"'{folder.path}' is not finished, its last evaluation is at {at}: let it go on with  "
            f"turbogs train --resume {shlex.quote(str(folder.path))}"
        )


def _scene_names(scenes: Sequence[SceneConfig]) -> list[str]:
    """The captures' names, with what tells those of one name apart: parent folders, the factor, the test views."""
    names = []
    for scene in scenes:
        path = Path(scene.path)
        alike = [other for other in scenes if Path(other.path).name == path.name]
        folders = {Path(other.path).parts for other in alike}
        depth = next(n for n in itertools.count(1) if len({parts[-n:] for parts in folders}) == len(folders))
        name = "-".join(part for part in path.parts[-depth:] if part != path.anchor)
        for setting in ("factor", "test_every"):
            if len({getattr(other, setting) for other in alike}) > 1:
                name += f"-{setting}-{getattr(scene, setting)}"
        names.append(name)
    return names
