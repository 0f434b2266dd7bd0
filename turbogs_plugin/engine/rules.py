"""Rules: what a strategy asks for, as plain values that every engine can carry out.

A strategy with a rule needs no code of its own for a device: the engine has it. The torch reference
(`turbogs_plugin.engine.reference`) defines what each rule means; its CUDA twin does the same in fewer passes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from turbogs_plugin.types import TILE_SIZE

LUMINANCE_CONSTANT = 0.01**2
STRUCTURE_CONSTANT = 0.03**2
"""SSIM's two constants, for colours of 0 .. 1."""

WINDOW_SIGMA = 1.5
"""Standard deviation of SSIM's Gaussian windows, in pixels; they end after `layout.WINDOW_RADIUS` of them."""

GRID_STEPS = (0.7548776662466927, 0.5698402909980532)
"""1 / g and 1 / g^2, with g^3 = g + 1."""


@dataclass(frozen=True)
class DrawRule:
    """Draw of an iteration's samples (paper section 3.5); `engine.reference.draws` defines the draw.

    Args:
        unit: one of `layout.SAMPLE_UNITS`.
        hard, stable: shares of the units drawn by error and by age; the mixed stage draws the rest.
        mixed_uniform: the mixed stage ignores error and age.
        importance: a of the weights ``p^-a`` of pixels; 0 for no weights.
        multiple: of unit ``pixel``: N_pix is the nearest multiple of this, which divides a tile's 256 pixels.
    """

    unit: str
    hard: float
    stable: float
    mixed_uniform: bool
    importance: float
    multiple: int = 1

    def wanted(self, rate: float, units: int) -> int:
        """Number of `units` to draw: ``max(1, floor(rate * units))``, the paper's N_pix for the 256 pixels of a tile.

        With `multiple` it is the nearest number: rounding down would lose up to half of a small budget.
        """
        step = self.multiple if self.unit == "pixel" else 1
        slack = 0.5 if step > 1 else 0.0
        return min(units, step * max(1, math.floor(rate * units / step + slack)))

    def origin(self, iteration: int, masked: bool) -> tuple[int, int]:
        """Origin (x, y) of the grid of tiles in an iteration, pixels; see `TileGrid`.

        Whole tiles begin elsewhere in each iteration, so that no pixel is always at the edge of its tile, where the
        windows that a loss compares are cut: at the points of a sequence that fills the square evenly (Roberts 2018,
        R2). Not where maps have masks, whose tables are of one grid.
        """
        if self.unit != "tile" or masked:
            return 0, 0
        x, y = (int(TILE_SIZE * math.fmod(iteration * step, 1.0)) for step in GRID_STEPS)
        return x, y

    def stages(self, wanted: int) -> tuple[int, int, int]:
        """Number of units of the hard, stable and mixed stage; halves round up."""
        hard = min(wanted, math.floor(self.hard * wanted + 0.5))
        stable = min(wanted - hard, math.floor(self.stable * wanted + 0.5))
        return hard, stable, wanted - hard - stable


@dataclass(frozen=True)
class Dropout:
    """The Gaussians that a pass leaves out, as if they were not there; `engine.reference.raster` defines which.

    After DropGaussian (Park et al., CVPR 2025), but opacities of the others stay as they are.

    Args:
        share: chance of each Gaussian to be left out, 0 .. 1.
        seed, iteration: with the row they decide.
    """

    share: float = 0.0
    seed: int = 0
    iteration: int = 0

    @property
    def threshold(self) -> int:
        """A Gaussian is left out whose random word is below this; 0: none."""
        return min(round(self.share * 2**32), 2**32 - 1)


NO_DROPOUT = Dropout()


@dataclass(frozen=True)
class LossTerms:
    """A loss on samples (paper section 3.7); `engine.reference.losses` defines its value and gradient.

    Args:
        epsilon: rounding radius of the Charbonnier term, in units of colour.
        l1_weight: factor of the Charbonnier term.
        structure: one of `layout.STRUCTURES`.
        structure_weight: factor of the mean over tiles and channels of 1 - S, S the similarity.
        variance_constant: c of `ncc`, epsilon of `printed_ncc`.
        depth_weight: factor of the depth term, where depths are given.
    """

    epsilon: float
    l1_weight: float = 1.0
    structure: str = "none"
    structure_weight: float = 0.0
    variance_constant: float = STRUCTURE_CONSTANT
    depth_weight: float = 0.0

    @property
    def balance(self) -> bool:
        """Whether the structure term is scaled by the paper's lambda: but for `ssim`, which has many windows a tile."""
        return self.structure in ("ncc", "printed_ncc")


@dataclass(frozen=True)
class ParameterRates:
    """The learning rate of each parameter at one iteration, in the parameter's own units per step."""

    means: float
    quats: float
    scales: float
    opacities: float
    sh0: float
    shN: float


@dataclass(frozen=True)
class UpdateRule:
    """One step of the parameters (paper section 3.9); `engine.reference.update` defines it.

    Args:
        rates: learning rate of each parameter at this iteration.
        beta1, beta2: decay of the moments.
        eps: added to sqrt(v); Adam's v is bias-corrected before.
        kind: one of `layout.UPDATE_KINDS`. `moment_lm` is moment-damped LM times the rates on two blocks of each
            Gaussian, and Adam on the higher bands; `unscaled_lm` is the same without the rates.
    """

    rates: ParameterRates
    beta1: float
    beta2: float
    eps: float
    kind: str = "adam"

    @property
    def per_view(self) -> bool:
        """Whether the rule needs the gradients of each view; else their sum suffices."""
        return self.kind != "adam"
