"""What the trainings of a study gave."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from turbogs_plugin.report.provenance import Provenance
from turbogs_plugin.study.grid import Ablation, CellKey
from turbogs_plugin.train.history import Evaluation


@dataclass(kw_only=True)
class CellResult:
    """What one training gave. `turbogs_plugin.study.results_file` keeps all of it, in this order.

    Args:
        scene, variant, seed: which.
        capture: `capture_digest` of the scene, or "" where it was not recorded.
        provenance: machine, versions and commit, or None where they were not recorded.
        resolved: False in a record that has only the configuration asked for, which is then `config`.
        warmup_iterations: iterations of the same configuration, but for the seed, that the process had trained before
            the clock started, on a model thrown away.
        lpips_reason: why LPIPS was not computed; empty where it was.
        config: its configuration, as plan and budgets resolved it.
        asked: the configuration that was asked for: by it a finished cell is recognised.
        overrides, steps: what the call of the study asked for beside its variant (`variant_config`); empty and None
            where it asked for nothing, or where that was not recorded.
        lpips, flip: of the final model; NaN where they were not computed.
        fps: test views rendered a second, one after the other; NaN where it was not recorded.
        wall_seconds: of a run, from its process's start until its model was written; NaN where a process has many.
        cell_seconds: of a study's cell, on the wall: loading its capture (once for all its cells, and counted in each),
            plan, training and evaluations; NaN for runs, and where it was not recorded.
        peak_bytes: peak of the GPU's tensors while training, or None where it was not measured.
        history: every evaluation, the last one of the final model.
    """

    scene: str
    variant: str
    seed: int
    capture: str = ""
    provenance: Provenance | None = None
    resolved: bool = True
    warmup_iterations: int = 0
    lpips_reason: str = ""
    config: dict[str, Any]
    asked: dict[str, Any]
    overrides: list[str] = field(default_factory=list)
    steps: int | None = None
    lpips: float = math.nan
    flip: float = math.nan
    fps: float = math.nan
    wall_seconds: float = math.nan
    cell_seconds: float = math.nan
    peak_bytes: int | None = None
    history: list[Evaluation]

    @property
    def key(self) -> CellKey:
        return CellKey(self.scene, self.variant, self.seed)

    @property
    def final(self) -> Evaluation:
        """The evaluation of the final model."""
        return self.history[-1]

    @property
    def time_budget(self) -> str:
        """As it was written, for instance 20s; empty where there is none."""
        return self.config["budget"]["time"]


@dataclass
class Failure:
    """A cell that gave no result, and why."""

    key: CellKey
    reason: str


@dataclass
class Study:
    """An ablation with the results that are there, of all its variants or some.

    Args:
        ablation: titles, variants, baseline.
        results: of finished cells, in the order of the grid.
        failures: of broken ones.
        targets: PSNRs in dB whose time is asked for; none: they follow from the baseline's result.
    """

    ablation: Ablation
    results: list[CellResult]
    failures: list[Failure] = field(default_factory=list)
    targets: list[float] = field(default_factory=list)

    @property
    def scenes(self) -> list[str]:
        return list(dict.fromkeys(result.scene for result in self.results))

    @property
    def provenances(self) -> list[Provenance | None]:
        """The different ones of the results, in their order."""
        made = [result.provenance for result in self.results]
        return [entry for number, entry in enumerate(made) if entry not in made[:number]]

    def of(self, scene: str, variant: str) -> list[CellResult]:
        """The results of all seeds."""
        return [result for result in self.results if (result.scene, result.variant) == (scene, variant)]
