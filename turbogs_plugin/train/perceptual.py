"""LPIPS and FLIP, two measures of the difference that a viewer sees, by their authors' networks and libraries, if these
are installed. Nothing is downloaded, and what takes seconds to import is imported when it is used.

FLIP (Andersson et al. 2020) runs on the CPU and takes about 1.7 s a megapixel on one core, so only `turbogs eval` and
the end of a study's cell compute it: a run's wall clock does not pay for it.
"""

from __future__ import annotations

import importlib.util
import math
import tempfile
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.errors import InputError

VGG16_FILE = "vgg16-397923af.pth"
"""File name under which torchvision looks for the backbone of LPIPS."""

LPIPS_PACKAGES = ("torchvision", "torchmetrics")
"""Packages with the network, and with LPIPS itself."""

FLIP_PACKAGE = "flip_evaluator"

PIXELS_PER_DEGREE = 67.0
"""Viewing distance of FLIP: the paper's 0.7 m before a 4K screen 0.7 m wide."""

Lpips = Callable[[Tensor, Tensor], float]
"""LPIPS of two images [H, W, 3], 0 .. 1."""

Flip = Callable[[Tensor, Tensor], float]
"""Mean FLIP of an image against a photo, both [H, W, 3], 0 .. 1: 0 for equal ones, below 1."""


def load_lpips(weights: str | None, device: torch.device) -> tuple[Lpips | None, str]:
    """LPIPS (VGG16), if `LPIPS_PACKAGES` and the backbone's weights are on this machine. Nothing is downloaded.

    Args:
        weights: local file with torchvision's VGG16 weights; None: torch's own cache is searched.
        device: where to compute.

    Returns:
        The function, or None; and the reason for None.

    Raises:
        InputError: `weights` names no readable file.
    """
    if weights is not None and not Path(weights).is_file():
        raise InputError(f"report.lpips_weights: no such file '{weights}'")
    missing = [name for name in LPIPS_PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        release = torch.__version__.partition("+")[0]  # or pip may bring another torch with torchvision
        return None, (
            f"it needs {' and '.join(missing)} (pip install {' '.join(missing)} torch=={release}) and the weights "
            f"{VGG16_FILE}"
        )
    file = Path(weights) if weights else Path(torch.hub.get_dir()) / "checkpoints" / VGG16_FILE
    if not file.is_file():
        return None, f"its weights are not on this machine; name a local {VGG16_FILE} in report.lpips_weights"
    return _load_lpips(file, device), ""


def _load_lpips(file: Path, device: torch.device) -> Lpips:
    network = _lpips_network(file.resolve()).to(device)
    return lambda image, photo: network(image.permute(2, 0, 1)[None], photo.permute(2, 0, 1)[None]).item()


@lru_cache(maxsize=1)
def _lpips_network(file: Path) -> torch.nn.Module:
    """The network on the CPU. A run loads it before it trains, to try it, and uses it for its report."""
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    cache = torch.hub.get_dir()
    with tempfile.TemporaryDirectory() as folder:  # torchvision loads the file only from a cache
        (Path(folder) / "checkpoints").mkdir()
        (Path(folder) / "checkpoints" / VGG16_FILE).symlink_to(file)
        torch.hub.set_dir(folder)
        try:
            return LearnedPerceptualImagePatchSimilarity(net_type="vgg", normalize=True)
        except (RuntimeError, OSError, KeyError, EOFError) as error:
            raise InputError(f"report.lpips_weights: '{file}' does not hold VGG16's weights: {error}") from None
        finally:
            torch.hub.set_dir(cache)


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
    pair = [np.ascontiguousarray(picture.detach().cpu().numpy(), dtype=np.float32) for picture in (photo, image)]
    settings = {"inputsRGB": True, "applyMagma": False, "computeMeanError": True}
    _, mean, _ = evaluate(*pair, "LDR", **settings, parameters={"ppd": PIXELS_PER_DEGREE})
    return float(mean)
