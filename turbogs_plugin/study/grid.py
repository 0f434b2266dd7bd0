"""Cells of a study: named variants of a configuration, over captures and seeds.

An ablation is a YAML file, as those in ``configs/ablations/``::

    title: Optimizer
    base: turbogs            # configuration that the variants change
    baseline: moment-lm      # the variant that the others are compared with; the first one where absent
    variants:
      moment-lm: []
      sparse-adam: [optimizer.type=sparse_adam]
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from turbogs_plugin.config.configuration import Config, load_config, named_beside, refuse_overrides
from turbogs_plugin.config.scaling import with_iterations
from turbogs_plugin.config.typed import build_dataclass
from turbogs_plugin.errors import InputError, nearest
from turbogs_plugin.yaml_json import read_named_yaml

PACKAGE = "turbogs_plugin.configs.ablations"
"""Where the packaged ablations are."""

GIVEN = {"train.seed": "given by --seeds", "scene.path": "given by --scene"}
"""Settings that no variant can change, and why."""

_NAME = re.compile(r"[A-Za-z0-9+][A-Za-z0-9_+.-]{0,47}")


@dataclass
class Ablation:
    """Named variants of a configuration.

    Args:
        title: heading of the report.
        variants: name -> overrides ``section.key=value`` of the base configuration. Names become file names.
        base: a packaged configuration, or a YAML file beside the ablation's.
        baseline: the variant that the others are compared with; the first one where empty.
        notes: name -> what a reader should know of a variant.
    """

    title: str
    variants: dict[str, list[str]]
    base: str = "turbogs"
    baseline: str = ""
    notes: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.variants:
            raise InputError("variants: at least one is needed")
        for name in self.variants:
            if not _NAME.fullmatch(str(name)):
                raise InputError(f"variant '{name}': a name has up to 48 letters, digits, '.', '_', '+' and '-'")
        self.baseline = self.baseline or next(iter(self.variants))
        for name in (self.baseline, *self.notes):
            self.require_variant(name)

    def require_variant(self, name: str) -> None:
        """Raises `InputError` where there is no such variant."""
        if name not in self.variants:
            raise InputError(f"no variant '{name}': {nearest(name, self.variants)}")

    def only(self, names: Sequence[str]) -> list[str]:
        """These variants and the baseline, in the ablation's order; all where none is given."""
        for name in names:
            self.require_variant(name)
        return [name for name in self.variants if not names or name in (*names, self.baseline)]


@dataclass(frozen=True)
class CellKey:
    """Name of a cell: of its capture, variant and seed."""

    scene: str
    variant: str
    seed: int

    @property
    def file(self) -> Path:
        """Path of the cell's result, relative to the folder of cells."""
        return Path(self.scene) / f"{self.variant}--seed{self.seed}.json"

    def __str__(self) -> str:
        return f"{self.scene}, {self.variant}, seed {self.seed}"


def load_ablation(name_or_file: str) -> Ablation:
    """Ablation from a packaged name or a YAML file. Raises `InputError`: an unknown name, an unreadable file, or one
    that is not an ablation."""
    mapping = read_named_yaml(name_or_file, PACKAGE, "ablation")
    ablation = build_dataclass(Ablation, mapping, f"ablation '{name_or_file}'")
    return replace(ablation, base=named_beside(ablation.base, name_or_file))


def variant_config(ablation: Ablation, variant: str, seed: int, overrides: Sequence[str], steps: int | None) -> Config:
    """Configuration of a variant.

    Args:
        overrides: ``section.key=value`` for all variants, on top of the variant's own.
        steps: iterations, to which everything that counts iterations is scaled; None: the configuration's own number.

    Raises:
        InputError: the configuration is wrong; the message names the variant.
    """
    try:
        changes = [*ablation.variants[variant], *overrides]
        refuse_overrides(changes, GIVEN)
        config = load_config(ablation.base, [*changes, f"train.seed={seed}"])
        if config.budget.max_memory:
            limits = "budget.max_memory limits a whole process, which here trains all cells"
            raise InputError(f"{limits}: leave it out, or limit density.max_gaussians")
        if steps is not None and config.budget.time:
            both = f"--steps {steps} and the time budget {config.budget.time}"
            raise InputError(f"{both} exclude each other: leave one out")
    except InputError as error:
        raise InputError(f"variant '{variant}': {error}") from None
    return config if steps is None else with_iterations(config, steps)
