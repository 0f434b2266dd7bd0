"""Test error of a model: PSNR, SSIM, mean absolute error, LPIPS and FLIP if wanted and there; and rendering speed.

Where views have masks, errors are of the pixels that are not masked, and those of whole photos are given beside them.
Where photos have exposures of their own, a test view is shown with the exposure that is known of it, and errors of the
model's own colours, and those after a colour alignment, are given beside.
"""

from __future__ import annotations

import importlib.util
import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.device import synchronize
from turbogs_plugin.engine.rendering import RasterSettings, render_image
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene import PosedImages
from turbogs_plugin.train.flip import Flip
from turbogs_plugin.train.history import MEASURES, FurtherErrors
from turbogs_plugin.train.interpolated_exposures import exposed
from turbogs_plugin.train.ssim import SSIM_SIDE, ssim
from turbogs_plugin.types import BLACK, Color, Gaussians

PSNR_LIMIT = 100.0
"""PSNR of an exact match, in dB."""

VGG16_FILE = "vgg16-397923af.pth"
"""The file name under which torchvision looks for the backbone of LPIPS."""

LPIPS_PACKAGES = ("torchvision", "torchmetrics")
"""What has the network, and LPIPS itself. Importing them takes seconds, so nothing else here uses them."""

Lpips = Callable[[Tensor, Tensor], float]
"""LPIPS of two images [H, W, 3], 0 .. 1."""


@dataclass
class ViewMetrics(FurtherErrors):
    """Errors of one test view, without its masked pixels; `ssim`, `lpips` and `flip` are NaN where they cannot be
    computed or are not wanted."""

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
        views, count = [asdict(view) for view in self.views], len(self.views)
        means = {name: math.fsum(view[name] for view in views) / count for name in views[0] if name != "name"}
        return ViewMetrics(f"mean of {count}", **means)

    @property
    def worst_psnr(self) -> float:
        """PSNR of the worst view, as a mean hides one view that something covers. NaN if a view has no value."""
        values = [view.psnr for view in self.views]
        return math.nan if any(map(math.isnan, values)) else min(values)


@dataclass(frozen=True)
class Look:
    """How a model is shown beside the photos of V views.

    Args:
        sh_degree: highest degree in use.
        settings: those of the rasterizer.
        background: behind the model, and behind transparent photos.
        exposures: [V, 3, 4] of the views (`interpolated_exposures`); None: the model's own colours.
    """

    sh_degree: int
    settings: RasterSettings
    background: Color = BLACK
    exposures: Tensor | None = None

    @property
    def options(self) -> dict[str, Any]:
        """Those of rendering the model's own colours."""
        return {"sh_degree": self.sh_degree, "settings": self.settings, "background": self.background}

    def colors(self, colors: Tensor, view_id: int) -> Tensor:
        """[H, W, 3], 0 .. 1: the model's own colours [H, W, 3], seen by a view, with its exposure."""
        return (colors if self.exposures is None else exposed(colors, self.exposures[view_id])).clamp(0.0, 1.0)


@torch.no_grad()
def evaluate(
    gaussians: Gaussians,
    views: PosedImages,
    look: Look,
    lpips: Lpips | None = None,
    flip: Flip | None = None,
    aligned: bool = False,
    refined: bool = False,
) -> Metrics:
    """Render every view, one at a time, and compare it with its photo. Where views have exposures, errors of the
    model's own colours are given beside.

    Args:
        gaussians: the model, on the views' device.
        views: cameras and photos.
        look: how it is shown.
        lpips: from `load_lpips`, if wanted.
        flip: from `load_flip`, if wanted. Masked pixels are the photo's in both images that these two get.
        aligned: give the errors of its own colours after `align_colors`, too.
        refined: where views have refined cameras, give the errors by these, too.
    """
    metrics, flips, seconds = [], [], 0.0
    moved = replace(views, cameras=views.refined) if refined and views.refined is not None else None
    for view_id, name in enumerate(views.names):
        synchronize(gaussians.device)
        started = time.perf_counter()
        own = _render(gaussians, views, view_id, look)
        image = look.colors(own, view_id)
        synchronize(gaussians.device)
        seconds += time.perf_counter() - started
        photo, mask = views.photos.image(view_id, look.background), views.mask(view_id)
        measured = compare(name, image, photo, mask)
        further = {}
        own = own.clamp(0.0, 1.0)
        if look.exposures is not None:
            further["own"] = compare(name, own, photo, mask)
        if views.masks is not None:
            further["whole"] = compare(name, image, photo)
        if moved is not None:
            further["refined"] = compare(name, render_view(gaussians, moved, view_id, look), photo, mask)
        if aligned:
            further["aligned"] = compare(name, align_colors(own, photo, mask), photo, mask)
        for kind, other in further.items():
            for measure in MEASURES:
                setattr(measured, f"{kind}_{measure}", getattr(other, measure))
        unmasked = image if mask is None else _unmasked(image, photo, mask)
        if lpips is not None:
            measured.lpips = lpips(unmasked, photo)
        if flip is not None:
            flips.append(flip(unmasked, photo))
        metrics.append(measured)
    for measured, value in zip(metrics, flips, strict=False):  # no flips where it is not wanted
        measured.flip = value.result()
    return Metrics(metrics, fps=len(metrics) / seconds)


@torch.no_grad()
def render_view(gaussians: Gaussians, views: PosedImages, view_id: int, look: Look) -> Tensor:
    """[H, W, 3] float32, 0 .. 1: the model seen by one of the cameras."""
    return look.colors(_render(gaussians, views, view_id, look), view_id)


def _render(gaussians: Gaussians, views: PosedImages, view_id: int, look: Look) -> Tensor:
    """[H, W, 3] float32, the model's own colours, which may be above 1."""
    return render_image(gaussians, views.cameras, view_id, **look.options).colors


def psnr(image: Tensor, photo: Tensor) -> float:
    """PSNR in dB of an image against a photo, both [..., 3] float, 0 .. 1; NaN if a value is."""
    mse = (image - photo).square().mean().item()
    return min(PSNR_LIMIT, -10.0 * math.log10(mse)) if mse > 0 else PSNR_LIMIT if mse == 0 else math.nan


def compare(name: str, image: Tensor, photo: Tensor, mask: Tensor | None = None) -> ViewMetrics:
    """Errors of an image against a photo, both [H, W, 3] float, 0 .. 1. SSIM has its usual Gaussian window of 11.

    Args:
        mask: [H, W] bool, the pixels to compare, at least one; None: all. SSIM's is the mean over their windows, in
            which masked pixels are the photo's in both images.
    """
    of_windows = image if mask is None else _unmasked(image, photo, mask)
    similarity = ssim(of_windows, photo, mask).item() if min(image.shape[:2]) >= SSIM_SIDE else math.nan
    if mask is not None:
        image, photo = image[mask], photo[mask]  # [P, 3]
    return ViewMetrics(name, psnr(image, photo), similarity, (image - photo).abs().mean().item())


def align_colors(image: Tensor, photo: Tensor, mask: Tensor | None = None) -> Tensor:
    """[H, W, 3], 0 .. 1: the image with its colours mapped by the affine map, 3x4, that brings them closest to the
    photo's, in the sense of least squares over the pixels of the mask [H, W]."""
    rows = image.reshape(-1, 3) if mask is None else image[mask]
    targets = photo.reshape(-1, 3) if mask is None else photo[mask]
    rows, targets = torch.nn.functional.pad(rows, (0, 1), value=1.0).double(), targets.double()  # [P, 4], [P, 3]
    # Few numbers: on the CPU, and by the pseudo-inverse, as an image of one colour has many such maps.
    inverse = torch.linalg.pinv((rows.T @ rows).cpu(), rtol=1e-9, hermitian=True)
    affine = (inverse @ (rows.T @ targets).cpu()).to(image)  # [4, 3]
    return (image @ affine[:3] + affine[3]).clamp(0.0, 1.0)


def _unmasked(image: Tensor, photo: Tensor, mask: Tensor) -> Tensor:
    """[H, W, 3]: the image with the photo's pixels where the mask [H, W] is False."""
    return torch.where(mask[:, :, None], image, photo)


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
    """On the CPU until it is used. A run loads it before it trains, to try it, and uses it for its report."""
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
