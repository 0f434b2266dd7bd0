"""Test errors of a model, and the evaluations of a training. Where views have masks, errors are of the pixels that are
not masked. Where photos have exposures of their own, a test view is shown with the exposure that is known of it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from turbogs_plugin.device import peak_memory_bytes, synchronize
from turbogs_plugin.engine.render import render_image
from turbogs_plugin.scene import PosedImages
from turbogs_plugin.train.history import MEASURES, Evaluation, FurtherErrors
from turbogs_plugin.train.look import Look
from turbogs_plugin.train.loop import Listener, TrainingLoop
from turbogs_plugin.types import Gaussians

PSNR_LIMIT = 100.0
"""PSNR of an exact match, in dB."""
SSIM_SIDE, SSIM_SIGMA = 11, 1.5
"""Side and standard deviation of SSIM's Gaussian window, in pixels; an image of smaller sides has no SSIM."""
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2
"""Constants of Wang et al. 2004 for values 0 .. 1."""

ImageError = Callable[[Tensor, Tensor], float]
"""LPIPS of an image against a photo, both [H, W, 3], 0 .. 1."""


@dataclass
class ViewMetrics(FurtherErrors):
    """Errors of one test view, without its masked pixels; NaN where they cannot be computed or are not wanted."""

    name: str
    psnr: float
    ssim: float
    l1: float
    lpips: float = math.nan


@dataclass
class Metrics:
    """Errors of a model on each test view, and how many of them were rendered per second, one after the other."""

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
        return float(np.min([view.psnr for view in self.views]))


@torch.no_grad()
def evaluate(
    gaussians: Gaussians,
    views: PosedImages,
    look: Look,
    lpips: ImageError | None = None,
    further: bool = False,
    view_ids: Sequence[int] | None = None,
) -> Metrics:
    """Render views, one at a time, and compare each with its photo.

    Args:
        gaussians: the model, on the views' device.
        lpips: from `load_lpips`, if wanted. It sees the photo's pixels where it is masked.
        further: give the errors by refined cameras and those of the model's own colours, too, where views have refined
            cameras and exposures.
        view_ids: at least one; None: all.
    """
    metrics: list[ViewMetrics] = []
    seconds = 0.0
    moved = replace(views, cameras=views.refined) if further and views.refined is not None else None
    for view_id in range(len(views)) if view_ids is None else view_ids:
        name = views.names[view_id]
        synchronize(gaussians.device)
        started = time.perf_counter()
        own = render_image(gaussians, views.cameras, view_id, **look.options).colors  # may be above 1
        image = look.colors(own, view_id)
        synchronize(gaussians.device)
        seconds += time.perf_counter() - started
        photo, mask = views.photos.image(view_id, look.background), views.mask(view_id)
        measured = compare(name, image, photo, mask)
        others = {"own": own.clamp(0.0, 1.0)} if further and look.exposures is not None else {}
        if moved is not None:
            others["refined"] = render_view(gaussians, moved, view_id, look)
        for kind, shown in others.items():
            other = compare(name, shown, photo, mask)
            for measure in MEASURES:
                setattr(measured, f"{kind}_{measure}", getattr(other, measure))
        if lpips is not None:
            measured.lpips = lpips(_unmasked(image, photo, mask), photo)
        metrics.append(measured)
    return Metrics(metrics, fps=len(metrics) / seconds)


@torch.no_grad()
def render_view(gaussians: Gaussians, views: PosedImages, view_id: int, look: Look) -> Tensor:
    """[H, W, 3] float32, 0 .. 1: the model seen by one of the cameras."""
    return look.colors(render_image(gaussians, views.cameras, view_id, **look.options).colors, view_id)


def psnr(image: Tensor, photo: Tensor) -> float:
    """PSNR in dB of an image against a photo, both [..., 3] float, 0 .. 1; NaN if a value is."""
    mse = (image - photo).square().mean().item()
    return min(PSNR_LIMIT, -10.0 * math.log10(mse)) if mse > 0 else PSNR_LIMIT if mse == 0 else math.nan


def compare(name: str, image: Tensor, photo: Tensor, mask: Tensor | None = None) -> ViewMetrics:
    """Errors of an image against a photo, both [H, W, 3] float, 0 .. 1, at the one or more pixels of a mask [H, W],
    or all. SSIM is the mean over their windows, in which masked pixels are the photo's in both images."""
    enough = min(image.shape[:2]) >= SSIM_SIDE
    similarity = ssim(_unmasked(image, photo, mask), photo, mask).item() if enough else math.nan
    if mask is not None:
        image, photo = image[mask], photo[mask]  # [P, 3]
    return ViewMetrics(name, psnr(image, photo), similarity, (image - photo).abs().mean().item())


def _unmasked(image: Tensor, photo: Tensor, mask: Tensor | None) -> Tensor:
    """[H, W, 3]: the image with the photo's pixels where a mask [H, W] is False."""
    return image if mask is None else torch.where(mask[:, :, None], image, photo)


def ssim(image: Tensor, photo: Tensor, mask: Tensor | None = None) -> Tensor:
    """Structural similarity of images [H, W, 3] float, 0 .. 1, with sides of at least `SSIM_SIDE`: a scalar, the mean
    over channels and the pixels of a mask [H, W], or all; borders are mirrored, as torchmetrics does."""
    x, y = (picture.permute(2, 0, 1) for picture in (image, photo))  # [3, H, W]
    mean_x, mean_y, xx, yy, xy = _blurred(torch.stack((x, y, x * x, y * y, x * y)))
    variances = (xx - mean_x.square()).clamp(min=0.0) + (yy - mean_y.square()).clamp(min=0.0)
    covariance = xy - mean_x * mean_y
    similar_means = (2.0 * mean_x * mean_y + SSIM_C1) / (mean_x.square() + mean_y.square() + SSIM_C1)
    similarity = similar_means * (2.0 * covariance + SSIM_C2) / (variances + SSIM_C2)  # [3, H, W]
    return similarity.mean() if mask is None else similarity[:, mask].mean()


def _blurred(images: Tensor) -> Tensor:
    """[B, 3, H, W] images under the window, which is a product: down the columns first, then along the rows; by shifted
    sums, as a convolution loads a library."""
    margin = SSIM_SIDE // 2
    weights = [math.exp(-0.5 * (place / SSIM_SIGMA) ** 2) for place in range(-margin, margin + 1)]
    padded = F.pad(images, (margin,) * 4, mode="reflect")
    for axis in (2, 3):
        size = images.shape[axis]
        blurred = padded.narrow(axis, 0, size) * (weights[0] / sum(weights))
        for place in range(1, SSIM_SIDE):
            blurred.add_(padded.narrow(axis, place, size), alpha=weights[place] / sum(weights))
        padded = blurred
    return padded


@dataclass
class Evaluations(Listener):
    """Evaluates the model on test views, on its device, and passes the result to all listeners.

    Args:
        callback: called with the result, too.

    Attributes:
        metrics: errors of the newest evaluation; None where this process made none.
    """

    test: PosedImages
    callback: Callable[[Evaluation], object] | None = None
    history: list[Evaluation] = field(default_factory=list, init=False)
    metrics: Metrics | None = field(default=None, init=False)

    def begun(self, loop: TrainingLoop) -> None:
        if not self.history:
            self.evaluation_due(loop)

    def evaluation_due(self, loop: TrainingLoop) -> None:
        trainer = loop.trainer
        trainer.require_finite()
        metrics = evaluate(trainer.gaussians, self.test, trainer.look(self.test.names), further=loop.finished)
        mean, self.metrics = asdict(metrics.mean), metrics
        evaluation = Evaluation(
            iteration=trainer.iteration,
            train_seconds=loop.clock.seconds,
            num_gaussians=len(trainer.gaussians),
            memory_bytes=peak_memory_bytes(trainer.device),
            nonfinite_losses=int(trainer.nonfinite_losses),
            skipped_updates=int(trainer.optimizer.skipped),
            worst_psnr=metrics.worst_psnr,
            **{measure: value for measure, value in mean.items() if measure not in ("name", "lpips")},
        )
        self.history.append(evaluation)
        if self.callback is not None:
            self.callback(evaluation)
        for listener in loop.listeners:
            listener.evaluated(loop, evaluation)
