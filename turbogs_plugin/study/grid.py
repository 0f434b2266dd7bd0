"""What an ablation is: named variants of a configuration, over scenes and seeds.

A YAML in ``configs/ablations/``::

    title: Optimizer
    base: turbogs            # configuration that the variants change
    baseline: moment-lm      # the variant that the others are compared with; the first one where absent
    variants:
      moment-lm: []
      sparse-adam: [optimizer.type=sparse_adam]
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from turbogs_plugin.config.configuration import Config, load_config, named_beside
from turbogs_plugin.config.scaling import with_iterations
from turbogs_plugin.config.sections import AUTO
from turbogs_plugin.config.typed import build_dataclass
from turbogs_plugin.errors import InputError, nearest
from turbogs_plugin.yaml_json import read_named_yaml

PACKAGE = "turbogs_plugin.configs.ablations"
"""Where the packaged ablations are."""

_NAME = re.compile(r"[A-Za-z0-9+][A-Za-z0-9_+.-]{0,47}")


@dataclass
class Ablation:
    """Named variants.

    Args:
        title: of the table.
        variants: name -> overrides ``section.key=value`` of the base configuration. Names become file names.
        base: a packaged configuration or a YAML file; of `load_ablation`, one by its place beside the ablation's.
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
        """These variants and the baseline, in the ablation's order; all variants where none is named."""
        for name in names:
            self.require_variant(name)
        return [name for name in self.variants if not names or name in (*names, self.baseline)]


@dataclass(frozen=True)
class CellKey:
    """One training of a grid. `scene`: the capture's name."""

    scene: str
    variant: str
    seed: int

    @property
    def file(self) -> Path:
        """Where its result is, relative to the cells' folder."""
        return Path(self.scene) / f"{self.variant}--seed{self.seed}.json"

    def __str__(self) -> str:
        return f"{self.scene}, {self.variant}, seed {self.seed}"


def load_ablation(name_or_file: str) -> Ablation:
    """The ablation of a packaged name or a YAML file.

    Raises:
        InputError: an unknown name, an unreadable file, or one that is not an ablation.
    """
    mapping = read_named_yaml(name_or_file, PACKAGE, "ablation")
    ablation = build_dataclass(Ablation, mapping, f"ablation '{name_or_file}'")
    return replace(ablation, base=named_beside(ablation.base, name_or_file))


def alike_at(ablation: Ablation, variants: Sequence[str], overrides: Sequence[str], steps: int) -> dict[str, str]:
    """Variants that become the same as another one when all have this length -> that other variant.

    A variant may differ from another one by nothing but `train.epochs`, which a given number of iterations replaces.
    Variants that are the same at their own lengths, too, are not listed: the ablation wants them so.

    Raises:
        InputError: naming the variant, whatever is wrong with its configuration.
    """

    def text(variant: str, length: int | None) -> str:
        mapping = variant_config(ablation, variant, 0, overrides, length).to_mapping()
        if mapping["train"]["iterations"] != AUTO:
            del mapping["train"]["epochs"]
        return json.dumps(mapping, sort_keys=True)

    alike: dict[str, str] = {}
    first: dict[str, str] = {}
    for variant in sorted(variants, key=lambda name: name != ablation.baseline):
        known = first.setdefault(text(variant, steps), variant)
        if known != variant and text(known, None) != text(variant, None):
            alike[variant] = known
    return alike


def variant_config(ablation: Ablation, variant: str, seed: int, overrides: Sequence[str], steps: int | None) -> Config:
    """The configuration of a variant.

    Args:
        overrides: of all variants, on top of the variant's own.
        steps: iterations; None: the configuration's own number.

    Raises:
        InputError: naming the variant, whatever is wrong with its configuration.
    """
    try:
        config = load_config(ablation.base, [*ablation.variants[variant], *overrides, f"train.seed={seed}"])
    except InputError as error:
        raise InputError(f"variant '{variant}': {error}") from None
    if config.budget.max_memory:
        raise InputError(
            f"variant '{variant}': budget.max_memory holds a whole process, which here trains all cells: "
            "leave it out, or limit density.max_gaussians"
        )
    if steps is None:
        return config
    if config.budget.time:
        raise InputError(
            f"variant '{variant}': --steps {steps} and the time budget {config.budget.time} exclude each other: "
            "leave one out"
        )
    return with_iterations(config, steps)
