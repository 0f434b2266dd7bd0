"""FLIP: the difference a viewer sees when two pictures take turns (Andersson et al. 2020), by its authors' library.

It runs on the CPU and takes about 1.7 s a megapixel on one core, so only `turbogs eval` and the end of a study's cell
compute it: a run's wall clock does not pay for it.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable

import numpy as np
from torch import Tensor

FLIP_PACKAGE = "flip_evaluator"

PIXELS_PER_DEGREE = 67.0
"""How far off a viewer is thought to be: the paper's 0.7 m before a 4K screen 0.7 m wide."""

Flip = Callable[[Tensor, Tensor], float]
"""Mean FLIP of an image against a photo, both [H, W, 3], 0 .. 1: 0 for equal ones, below 1."""


def load_flip() -> tuple[Flip | None, str]:
    """FLIP, if its package is installed: the function, or None; and the reason for None."""
    if importlib.util.find_spec(FLIP_PACKAGE) is None:
        return None, 'flip-evaluator is not installed; pip install "turbogs-plugin[flip]"'
    return flip, ""


def flip(image: Tensor, photo: Tensor) -> float:
    """Mean FLIP of an image against a photo, both [H, W, 3] float, 0 .. 1, in sRGB; NaN if a value is not finite."""
    from flip_evaluator import evaluate

    if not (image.isfinite().all() and photo.isfinite().all()):  # the library calls these equal
        return math.nan
    arrays = [np.ascontiguousarray(picture.detach().cpu().numpy(), dtype=np.float32) for picture in (photo, image)]
    settings = {"ppd": PIXELS_PER_DEGREE}
    _, mean, _ = evaluate(*arrays, "LDR", inputsRGB=True, applyMagma=False, computeMeanError=True, parameters=settings)
    return float(mean)
