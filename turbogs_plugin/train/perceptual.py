"""LPIPS and FLIP, two measures of the difference that a viewer sees, by their authors' networks and libraries, if these
are installed. Nothing is downloaded, and what takes seconds to import is imported when it is used.

FLIP (Andersson et al. 2020) runs on the CPU and takes about 1.7 s a megapixel on one core, so only `turbogs eval` and
the end of a study's cell compute it: a run's wall clock does not pay for it.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.errors import InputError

LPIPS_PACKAGES = ("torchvision", "torchmetrics")
"""Packages with the network, and with LPIPS itself."""

FLIP_PACKAGE = "flip_evaluator"

PIXELS_PER_DEGREE = 67.0
"""Viewing distance of FLIP: the paper's 0.7 m before a 4K screen 0.7 m wide."""

ImageError = Callable[[Tensor, Tensor], float]
"""LPIPS or mean FLIP of an image against a photo, both [H, W, 3], 0 .. 1."""


def load_lpips(device: torch.device) -> tuple[ImageError | None, str]:
    """LPIPS (VGG16), if `LPIPS_PACKAGES` are installed and the backbone's weights are in torch's cache.

    Args:
        device: where to compute.

    Returns:
        The function, or None; and the reason for None.

    Raises:
        InputError: the file in the cache does not hold the weights.
    """
    missing = [name for name in LPIPS_PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        release = torch.__version__.partition("+")[0]  # or pip may bring another torch with torchvision
        return None, f"it needs {' and '.join(missing)}: pip install {' '.join(missing)} torch=={release}"
    weights = Path(torch.hub.get_dir()) / "checkpoints" / "vgg16-397923af.pth"  # torchvision's name
    if not weights.is_file():
        return None, f"there are no weights of VGG16 on this machine: put torchvision's file at {weights}"
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    try:
        network = LearnedPerceptualImagePatchSimilarity(net_type="vgg", normalize=True).to(device)
    except (RuntimeError, OSError, KeyError, EOFError) as error:
        raise InputError(f"'{weights}' does not hold VGG16's weights ({error}): remove it, or put them there") from None
    return lambda image, photo: network(image.permute(2, 0, 1)[None], photo.permute(2, 0, 1)[None]).item(), ""


def load_flip() -> tuple[ImageError | None, str]:
    """FLIP, if its package is installed: the function, or None; and the reason for None."""
    if importlib.util.find_spec(FLIP_PACKAGE) is None:
        return None, 'flip-evaluator is not installed; pip install "turbogs-plugin[flip]"'
    return flip, ""


def flip(image: Tensor, photo: Tensor) -> float:
    """Mean FLIP of an image against a photo, both [H, W, 3] float, 0 .. 1, in sRGB; NaN if a value is not finite."""
    from flip_evaluator import evaluate

    if not (image.isfinite().all() and photo.isfinite().all()):  # the library calls these equal
        return math.nan
    pair = [np.ascontiguousarray(picture.detach().cpu().numpy(), dtype=np.float32) for picture in (photo, image)]
    settings = {"inputsRGB": True, "applyMagma": False, "computeMeanError": True}
    _, mean, _ = evaluate(*pair, "LDR", **settings, parameters={"ppd": PIXELS_PER_DEGREE})
    return float(mean)
