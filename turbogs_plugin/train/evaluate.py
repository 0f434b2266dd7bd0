"""Test error of a model: PSNR, SSIM, mean absolute error, LPIPS and FLIP if wanted and there; and rendering speed."""

from __future__ import annotations

import importlib.util
import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from turbogs_plugin.device import synchronize
from turbogs_plugin.engine.rendering import RasterSettings, render_image
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene import PosedImages
from turbogs_plugin.train.flip import Flip
from turbogs_plugin.train.ssim import SSIM_SIDE, ssim
from turbogs_plugin.types import Gaussians

PSNR_LIMIT = 100.0
"""PSNR of an exact match, in dB."""

VGG16_FILE = "vgg16-397923af.pth"
"""The file name under which torchvision looks for the backbone of LPIPS."""

LPIPS_PACKAGES = ("torchvision", "torchmetrics")
"""What has the network, and LPIPS itself. Importing them takes seconds, so nothing else here uses them."""

Lpips = Callable[[Tensor, Tensor], float]
"""LPIPS of two images [H, W, 3], 0 .. 1."""


@dataclass
class ViewMetrics:
    """Errors of one test view; `ssim`, `lpips` and `flip` are NaN where they cannot be computed or are not wanted."""

    name: str
    psnr: float
    ssim: float
    l1: float
    lpips: float = math.nan
    flip: float = math.nan


@dataclass
class Metrics:
    """Errors of a model on its test views.

    Args:
        views: the errors of each test view.
        fps: test views rendered per second, one after the other.
    """

    views: list[ViewMetrics]
    fps: float

    @property
    def mean(self) -> ViewMetrics:
        """The means over views; NaN if a view has no value."""
        values = ((view.psnr, view.ssim, view.l1, view.lpips, view.flip) for view in self.views)
        columns = zip(*values, strict=True)
        return ViewMetrics(f"mean of {len(self.views)}", *(math.fsum(column) / len(self.views) for column in columns))

    @property
    def worst_psnr(self) -> float:
        """PSNR of the worst view, as a mean hides one view that something covers. NaN if a view has no value."""
        values = [view.psnr for view in self.views]
        return math.nan if any(map(math.isnan, values)) else min(values)


@torch.no_grad()
def evaluate(
    gaussians: Gaussians,
    views: PosedImages,
    sh_degree: int,
    settings: RasterSettings,
    lpips: Lpips | None = None,
    flip: Flip | None = None,
) -> Metrics:
    """Render every view, one at a time, and compare it with its photo.

    Args:
        gaussians: the model, on the views' device.
        views: cameras and photos.
        sh_degree: highest degree in use.
        settings: those of the rasterizer.
        lpips: from `load_lpips`, if wanted.
        flip: from `load_flip`, if wanted.
    """
    metrics, seconds = [], 0.0
    for view_id, name in enumerate(views.names):
        synchronize(gaussians.device)
        started = time.perf_counter()
        image = render_view(gaussians, views, view_id, sh_degree, settings)
        synchronize(gaussians.device)
        seconds += time.perf_counter() - started
        photo = views.photos.image(view_id)
        metrics.append(compare(name, image, photo))
        if lpips is not None:
            metrics[-1].lpips = lpips(image, photo)
        if flip is not None:
            metrics[-1].flip = flip(image, photo)
    return Metrics(metrics, fps=len(metrics) / seconds)


@torch.no_grad()
def render_view(
    gaussians: Gaussians, views: PosedImages, view_id: int, sh_degree: int, settings: RasterSettings
) -> Tensor:
    """[H, W, 3] float32, 0 .. 1: the model seen by one of the cameras."""
    image = render_image(gaussians, views.cameras, view_id, sh_degree=sh_degree, settings=settings)
    return image.colors.clamp(0.0, 1.0)


def psnr(image: Tensor, photo: Tensor) -> float:
    """PSNR in dB of an image against a photo, both [H, W, 3] float, 0 .. 1; NaN if a value is."""
    mse = (image - photo).square().mean().item()
    return min(PSNR_LIMIT, -10.0 * math.log10(mse)) if mse > 0 else PSNR_LIMIT if mse == 0 else math.nan


def compare(name: str, image: Tensor, photo: Tensor) -> ViewMetrics:
    """Errors of an image against a photo, both [H, W, 3] float, 0 .. 1. SSIM has its usual Gaussian window of 11."""
    similarity = ssim(image, photo).item() if min(image.shape[:2]) >= SSIM_SIDE else math.nan
    return ViewMetrics(name, psnr(image, photo), similarity, (image - photo).abs().mean().item())


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
        return None, f"it needs {' and '.join(LPIPS_PACKAGES)}, and {' and '.join(missing)} is not installed"
    file = Path(weights) if weights else Path(torch.hub.get_dir()) / "checkpoints" / VGG16_FILE
    if not file.is_file():
        return None, f"its weights are not on this machine; name a local {VGG16_FILE} in report.lpips_weights"
    return _load_lpips(file, device), ""


def _load_lpips(file: Path, device: torch.device) -> Lpips:
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    cache = torch.hub.get_dir()
    with tempfile.TemporaryDirectory() as folder:  # torchvision loads the file only from a cache
        (Path(folder) / "checkpoints").mkdir()
        (Path(folder) / "checkpoints" / VGG16_FILE).symlink_to(file.resolve())
        torch.hub.set_dir(folder)
        try:
            network = LearnedPerceptualImagePatchSimilarity(net_type="vgg", normalize=True).to(device)
        except (RuntimeError, OSError, KeyError, EOFError) as error:
            raise InputError(f"report.lpips_weights: '{file}' does not hold VGG16's weights: {error}") from None
        finally:
            torch.hub.set_dir(cache)
    return lambda image, photo: network(image.permute(2, 0, 1)[None], photo.permute(2, 0, 1)[None]).item()
