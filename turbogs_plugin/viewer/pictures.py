"""The pictures of the viewer, [H, W, 3] uint8, and the state that they show.

The render is seen by the page's free camera. Comparison, error map, age map and samples show a view of the capture,
fitted into the page, whatever the free camera does.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import adaptive_max_pool2d, interpolate

from turbogs_plugin.engine.render import render_image
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.report.images import ERROR_FULL_SCALE, colored, rounded, strip, to_uint8
from turbogs_plugin.scene import PosedImages
from turbogs_plugin.train.look import Look
from turbogs_plugin.train.metrics import render_view
from turbogs_plugin.types import Gaussians, PixelSamples, Step
from turbogs_plugin.viewer.camera import ViewerCamera

BACKGROUND = 24
"""Grey level where a picture has nothing to show."""
DIMMED = 0.4  # of what is there for orientation only
SAMPLED = (255, 170, 0)


class Picture(str, Enum):
    """The pictures to choose from; the value is the name on the page."""

    RENDER = "Render"
    COMPARE = "Photo | render | error"
    ERRORS = "Error map"
    AGES = "Age map"
    SAMPLES = "Samples of this iteration"

    @property
    def of_view(self) -> bool:
        """Whether it shows a view of the capture, not what the free camera sees."""
        return self is not Picture.RENDER


@dataclass(frozen=True)
class CaptureViews:
    """The views of a capture under one numbering: training views, then test views; wherever their photos are kept."""

    train: PosedImages
    test: PosedImages

    def __len__(self) -> int:
        return len(self.train) + len(self.test)

    def find(self, number: int) -> tuple[PosedImages, int]:
        """The set that a view belongs to, and its number there."""
        count = len(self.train)
        return (self.train, number) if number < count else (self.test, number - count)

    def name(self, number: int) -> str:
        views, view_id = self.find(number)
        kind = "training" if views is self.train else "test"
        return f"{views.names[view_id]} ({kind} view {view_id + 1} of {len(views)})"


@dataclass
class ModelState:
    """All that a picture may show. Pictures that need what is None say so.

    Args:
        gaussians: the model, on the device that renders.
        look: how it is shown, without exposures.
        maps: errors and ages of the training views, and the time from which ages count.
        samples: pixels of the last iteration.
    """

    gaussians: Gaussians
    look: Look
    capture: CaptureViews | None = None
    maps: tuple[ErrorMaps, Step] | None = None
    samples: PixelSamples | None = None


class AbsentError(Exception):
    """A model's state lacks what a picture shows; the message says why, for the page."""


@torch.no_grad()
def draw(state: ModelState, picture: Picture, camera: ViewerCamera, view: int = 0) -> tuple[np.ndarray, str]:
    """A picture, [H, W, 3] uint8, and a line about it: which view it shows, or why it is empty.

    Args:
        camera: the page's camera; its size is the picture's.
        view: number of a view of the capture, see `CaptureViews`; taken within its bounds. Samples are shown where they
            fell: in this view if it was sampled in this iteration, else in the first one that was.
    """
    try:
        if picture is Picture.RENDER:
            cameras = camera.cameras(state.gaussians.device)
            return to_uint8(render_image(state.gaussians, cameras, **state.look.options).colors), ""
        number = min(max(0, view), len(_capture(state)) - 1)
        if picture is Picture.SAMPLES and state.samples is not None and number not in state.samples.view_ids:
            number = state.samples.view_ids[0]
        drawn = {Picture.COMPARE: _compare, Picture.SAMPLES: _samples}.get(picture)
        pixels = drawn(state, camera, number) if drawn else _map(state, camera, number, picture is Picture.AGES)
        return _centred(pixels, camera), _capture(state).name(number)
    except AbsentError as reason:
        return _centred(torch.zeros(0, 0, 3), camera), str(reason)


def _compare(state: ModelState, camera: ViewerCamera, number: int) -> Tensor:
    """Photo, render and error side by side, made at the photo's own size."""
    views, view_id = _capture(state).find(number)
    views = views.with_cameras_on(state.gaussians.device)
    image = render_view(state.gaussians, views, view_id, state.look)
    pixels = strip(_photo(state, number), image, views.mask(view_id))
    return _fitted(pixels.permute(2, 0, 1).float(), camera).permute(1, 2, 0).round().byte()


def _map(state: ModelState, camera: ViewerCamera, number: int, of_ages: bool) -> Tensor:
    """Errors, as the map has them: a mean over the last visits of each pixel, not the error of the present model. Or
    ages, on a logarithmic scale from black (sampled just now) to the oldest pixel of the view. What is reduced keeps
    its largest values."""
    if state.maps is None or number >= len(_capture(state).train):
        raise AbsentError("A running training keeps error maps, of its training views.")
    maps, step = state.maps
    shares = maps.view_errors(number) / (3.0 * ERROR_FULL_SCALE)
    if of_ages:
        ages = torch.log1p(maps.ages(number, step).float())
        shares = ages / ages.max().clamp(min=1e-6)
    width, height = maps.sizes[number].tolist()
    return colored(_fitted(shares.view(1, height, width), camera, keep_largest=True)[0])


def _samples(state: ModelState, camera: ViewerCamera, number: int) -> Tensor:
    """The photo, dimmed, with the sampled pixels bright, also those that fall between the page's pixels."""
    samples = state.samples
    if samples is None:
        raise AbsentError("No samples yet: they are drawn by a running training.")
    photo = _photo(state, number)
    sampled = torch.zeros_like(photo[..., 0])  # [H, W]
    chosen = samples.view_of_slot() == samples.view_ids.index(number)
    sampled.view(-1)[samples.pixel_ids[chosen & samples.filled].long()] = 1.0
    mask = _fitted(sampled[None], camera, keep_largest=True)[0] > 0  # [h, w]
    dimmed = rounded(DIMMED * _fitted(photo.permute(2, 0, 1), camera).permute(1, 2, 0))
    return torch.where(mask[..., None], dimmed.new_tensor(SAMPLED), dimmed)


def _capture(state: ModelState) -> CaptureViews:
    if state.capture is None:
        raise AbsentError("This model came without its capture: name it by --scene.")
    return state.capture


def _photo(state: ModelState, number: int) -> Tensor:
    """A photo on the model's device, [H, W, 3] float32, 0 .. 1."""
    views, view_id = _capture(state).find(number)
    return views.photos.image(view_id, state.look.background).to(state.gaussians.device)


def _fitted(planes: Tensor, camera: ViewerCamera, keep_largest: bool = False) -> Tensor:
    """Float planes [C, H, W] as [C, h, w], the largest of their proportions in the page: reduced by means over areas,
    or with the largest values kept, or enlarged by repeated pixels."""
    height, width = planes.shape[1:]
    scale = min(camera.width / width, camera.height / height)
    size = max(1, round(scale * height)), max(1, round(scale * width))
    if scale > 1.0:
        return interpolate(planes[None], size, mode="nearest")[0]
    return adaptive_max_pool2d(planes, size) if keep_largest else interpolate(planes[None], size, mode="area")[0]


def _centred(pixels: Tensor, camera: ViewerCamera) -> np.ndarray:
    """Pixels [h, w, 3] uint8 in the middle of a picture of the camera's size."""
    whole = np.full((camera.height, camera.width, 3), BACKGROUND, dtype=np.uint8)
    top, left = (whole.shape[0] - pixels.shape[0]) // 2, (whole.shape[1] - pixels.shape[1]) // 2
    whole[top : top + pixels.shape[0], left : left + pixels.shape[1]] = pixels.cpu().numpy()
    return whole
