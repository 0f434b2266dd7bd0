"""The pictures of the viewer: functions from a model's state and a request to [H, W, 3] uint8.

The render, depths and changes are seen by the page's free camera. Comparison, error map, age map and samples show a
view of the capture, fitted into the page, whatever the free camera does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import adaptive_max_pool2d, interpolate

from turbogs_plugin.engine.render import render_image
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.report.images import ERROR_FULL_SCALE, colored, depth_picture, error_picture, rounded, to_uint8
from turbogs_plugin.scene import PosedImages
from turbogs_plugin.types import SH_C0, Cameras, Gaussians, Step
from turbogs_plugin.viewer.camera import ViewerCamera
from turbogs_plugin.viewer.model_state import CaptureViews, ModelState

GAP = 4
"""Dark pixels between panels."""
BACKGROUND = 24
"""Grey level where a picture has nothing to show."""
DIMMED = 0.4
"""Brightness of what is there for orientation only."""
ADDED, REMOVED, SAMPLED = (0.1, 0.9, 0.25), (1.0, 0.15, 0.15), (255, 170, 0)


class Picture(str, Enum):
    """The pictures to choose from; the value is the name on the page."""

    RENDER = "Render"
    DEPTH = "Depth"
    CHANGES = "Added and removed"
    COMPARE = "Photo | render | error"
    ERRORS = "Error map"
    AGES = "Age map"
    SAMPLES = "Samples of this iteration"

    @property
    def of_view(self) -> bool:
        """Whether it shows a view of the capture, not what the free camera sees."""
        return self in (Picture.COMPARE, Picture.ERRORS, Picture.AGES, Picture.SAMPLES)

    @property
    def renders(self) -> bool:
        """Whether it takes a rendering, so that fewer pixels take less time."""
        return self in (Picture.RENDER, Picture.DEPTH, Picture.CHANGES, Picture.COMPARE)


EXPLANATIONS = {
    Picture.RENDER: "The model from where you are. Drag to turn, scroll to come nearer. *Cameras of the capture* shows "
    "where its photos were taken: click one to stand there.",
    Picture.DEPTH: "How far away things are. Near is bright.",
    Picture.CHANGES: "**Green**: Gaussians that the last event of density control added, where more detail was wanted. "
    "**Red**: those that it removed. Grey: all others.",
    Picture.COMPARE: "A view of the capture: the photo, the model's render, and the difference (bright is wrong).",
    Picture.ERRORS: "What training remembers of each pixel's error, a mean over its last visits. Bright pixels are "
    "drawn more often.",
    Picture.AGES: "How long ago each pixel was last looked at. Black: just now. Bright: long ago, so it will be drawn "
    "soon, even if its error was small.",
    Picture.SAMPLES: "**Orange**: the pixels that this iteration renders and learns from. All others cost nothing "
    "this time.",
}


@dataclass(frozen=True)
class Request:
    """A page's wish.

    Args:
        picture: which.
        camera: the page's camera; its size is the picture's.
        view: number of a view of the capture, see `CaptureViews`; taken within its bounds.
    """

    picture: Picture
    camera: ViewerCamera
    view: int = 0


@torch.no_grad()
def draw(state: ModelState, request: Request) -> np.ndarray:
    """A picture of the camera's size, [H, W, 3] uint8; empty if it cannot be drawn (`missing`)."""
    if missing(state, request):
        return np.full((request.camera.height, request.camera.width, 3), BACKGROUND, dtype=np.uint8)
    return DRAWN_BY[request.picture](state, request)


def missing(state: ModelState, request: Request) -> str:
    """Why a picture cannot be drawn, in a sentence for the page; empty if it can."""
    picture = request.picture
    if picture is Picture.CHANGES and (state.change is None or len(state.change.update.fresh) != len(state.gaussians)):
        return "No change yet: wait for the next event of density control of a running training."
    if not picture.of_view:
        return ""
    if state.capture is None:
        return "This model came without its capture: name it by --scene."
    if picture in (Picture.ERRORS, Picture.AGES):
        if state.maps is None or state.step is None:
            return "Only a training keeps error maps."
        if shown_view(state, request) >= len(state.capture.train):
            return "This is a test view: error maps are kept of training views alone."
    if picture is Picture.SAMPLES and state.samples is None:
        return "No samples yet: they are drawn by a running training."
    return ""


def shown_view(state: ModelState, request: Request) -> int:
    """The view that a picture of a view shows. Samples are shown where they fell: in the chosen view if it was sampled
    in this iteration, else in the first one that was."""
    view = min(max(0, request.view), len(_capture(state)) - 1)
    if request.picture is Picture.SAMPLES and state.samples is not None and view not in state.samples.view_ids:
        return state.samples.view_ids[0]
    return view


def _fitted(size: np.ndarray, request: Request, panels: int = 1) -> tuple[int, int]:
    """The largest (width, height) with the proportions of `size` [2], so that panels fit side by side into the page."""
    width, height = max(1, (request.camera.width - (panels - 1) * GAP) // panels), request.camera.height
    scale = min(width / size[0], height / size[1])
    return max(1, min(width, round(size[0] * scale))), max(1, min(height, round(size[1] * scale)))


def _render(state: ModelState, request: Request) -> np.ndarray:
    cameras = request.camera.cameras(state.gaussians.device)
    return to_uint8(render_image(state.gaussians, cameras, **state.options).colors)


def _depth(state: ModelState, request: Request) -> np.ndarray:
    cameras = request.camera.cameras(state.gaussians.device)
    image = render_image(state.gaussians, cameras, sh_degree=0, settings=state.settings, with_depth=True)
    assert image.depths is not None
    return depth_picture(image.depths.cpu().numpy())


def _changes(state: ModelState, request: Request) -> np.ndarray:
    """The model in grey, with what was added in green; and in red what was removed, where it was."""
    model, change = state.gaussians, state.change
    assert change is not None
    colors = (SH_C0 * model.sh0[:, 0] + 0.5).clamp(0.0, 1.0).mean(dim=1, keepdim=True) * DIMMED
    colors = torch.where(change.update.fresh[:, None], colors.new_tensor(ADDED), colors.expand(-1, 3))
    colors = torch.cat([colors, colors.new_tensor(REMOVED).expand(len(change.removed), 3)])
    removed = dict(change.removed.items())
    both = Gaussians(**{name: torch.cat([value, removed[name]]) for name, value in model.items()})
    painted = replace(both, sh0=((colors - 0.5) / SH_C0)[:, None], shN=both.shN[:, :0])
    cameras = request.camera.cameras(model.device)
    return to_uint8(render_image(painted, cameras, sh_degree=0, settings=state.settings).colors)


def _compare(state: ModelState, request: Request) -> np.ndarray:
    """Photo, render and error, side by side."""
    views, view_id, size = _fitted_view(state, request, panels=3)
    photo = _photo_of(state, views, view_id, size)
    image = _render_of(state, views, view_id, size)
    gap = torch.full((size[1], GAP, 3), BACKGROUND, dtype=torch.uint8, device=photo.device)
    parts = (rounded(photo), gap, rounded(image), gap, error_picture(photo, image.clamp(0.0, 1.0)))
    return _centred(torch.cat(parts, dim=1), request)


def _errors(state: ModelState, request: Request) -> np.ndarray:
    """The map's own values: a mean over the last visits of each pixel, not the error of the present model."""
    errors = _maps(state)[0].view_errors(shown_view(state, request))
    return _map_picture(errors / (3.0 * ERROR_FULL_SCALE), state, request)


def _ages(state: ModelState, request: Request) -> np.ndarray:
    """Black: sampled just now. The brightest: as long ago as the oldest pixel of the view, on a logarithmic scale."""
    maps, step = _maps(state)
    ages = maps.ages(shown_view(state, request), step).float()
    return _map_picture(torch.log1p(ages) / torch.log1p(ages.max()).clamp(min=1e-6), state, request)


def _samples(state: ModelState, request: Request) -> np.ndarray:
    """The photo, dimmed, with the sampled pixels bright. A sample that falls between the page's pixels is still
    shown."""
    views, view_id, size = _fitted_view(state, request)
    width, height = views.cameras.sizes[view_id].tolist()
    samples = state.samples
    assert samples is not None
    sampled = torch.zeros(1, height, width, device=samples.pixel_ids.device)
    chosen = samples.view_of_slot() == samples.view_ids.index(shown_view(state, request))
    sampled.view(-1)[samples.pixel_ids[chosen & samples.filled].long()] = 1.0
    mask = _resized(sampled, size, adaptive_max_pool2d)[0] > 0  # [H, W]
    photo = rounded(DIMMED * _photo_of(state, views, view_id, size))
    bright = torch.tensor(SAMPLED, dtype=torch.uint8, device=photo.device)
    return _centred(torch.where(mask.to(photo.device)[..., None], bright, photo), request)


DRAWN_BY: dict[Picture, Callable[[ModelState, Request], np.ndarray]] = {
    Picture.RENDER: _render,
    Picture.DEPTH: _depth,
    Picture.CHANGES: _changes,
    Picture.COMPARE: _compare,
    Picture.ERRORS: _errors,
    Picture.AGES: _ages,
    Picture.SAMPLES: _samples,
}


def _capture(state: ModelState) -> CaptureViews:
    assert state.capture is not None, "`missing` says so"
    return state.capture


def _maps(state: ModelState) -> tuple[ErrorMaps, Step]:
    assert state.maps is not None and state.step is not None, "`missing` says so"
    return state.maps, state.step


def _fitted_view(state: ModelState, request: Request, panels: int = 1) -> tuple[PosedImages, int, tuple[int, int]]:
    """The set of the view that is shown, its number there, and its (width, height) where several panels stand side by
    side in the page."""
    views, view_id = _capture(state).find(shown_view(state, request))
    return views, view_id, _fitted(views.cameras.sizes[view_id], request, panels)


def _photo_of(state: ModelState, views: PosedImages, view_id: int, size: tuple[int, int]) -> Tensor:
    """A photo on the model's device, [height, width, 3] float, reduced by means over areas or enlarged pixel by
    pixel."""
    photo = views.photos.image(view_id, state.background).to(state.gaussians.device)
    return _resized(photo.permute(2, 0, 1), size).permute(1, 2, 0)


def _render_of(state: ModelState, views: PosedImages, view_id: int, size: tuple[int, int]) -> Tensor:
    """The model in a view of the capture at another size, [height, width, 3] float.

    A pixel that stands for several of the photo has less blur (`RasterSettings.eps2d`).
    """
    cameras = views.cameras.select([view_id]).to(state.gaussians.device)
    width, height = cameras.sizes[0].tolist()
    drawn = min(size[0], width), min(size[1], height)
    ratios = cameras.Ks.new_tensor([drawn[0] / width, drawn[1] / height, 1.0])
    small = Cameras(cameras.viewmats, cameras.Ks * ratios[None, :, None], np.array([drawn], dtype=np.int64))
    settings = replace(state.settings, eps2d=state.settings.eps2d * (drawn[0] / width) ** 2)
    image = render_image(state.gaussians, small, **(state.options | {"settings": settings}))
    return _resized(image.colors.permute(2, 0, 1), size).permute(1, 2, 0)


def _map_picture(share: Tensor, state: ModelState, request: Request) -> np.ndarray:
    """A map [H * W] of the view shown, fitted into the page; what is reduced keeps its largest values."""
    own = _maps(state)[0].sizes[shown_view(state, request)]
    plane = share.view(1, int(own[1]), int(own[0]))
    return _centred(colored(_resized(plane, _fitted(own, request), adaptive_max_pool2d)[0]), request)


def _resized(planes: Tensor, size: tuple[int, int], reduce: Callable | None = None) -> Tensor:
    """Planes [C, H, W] as [C, height, width]. Smaller ones are made by `reduce`, by means over areas where it is None;
    larger ones repeat pixels."""
    target = (size[1], size[0])
    if target[0] > planes.shape[1] or target[1] > planes.shape[2]:
        return interpolate(planes[None], target, mode="nearest")[0]
    return interpolate(planes[None], target, mode="area")[0] if reduce is None else reduce(planes[None], target)[0]


def _centred(pixels: Tensor, request: Request) -> np.ndarray:
    """Pixels [h, w, 3] uint8 in the middle of a picture of the camera's size."""
    whole = np.full((request.camera.height, request.camera.width, 3), BACKGROUND, dtype=np.uint8)
    top, left = (whole.shape[0] - pixels.shape[0]) // 2, (whole.shape[1] - pixels.shape[1]) // 2
    whole[top : top + pixels.shape[0], left : left + pixels.shape[1]] = pixels.cpu().numpy()
    return whole
