"""What is drawn: pure functions from a subject and a request to a picture, [H, W, 3] uint8.

Pictures of the free camera (the render, depths, splats per tile, what density control changed) go by the eye of the
page. Pictures of a view (photo beside render, errors, ages, samples) are flat: the view's own pixels, fitted into the
page, whatever the free camera does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import adaptive_max_pool2d, interpolate

from turbogs_plugin.engine.rendering import render_image, splats_per_tile
from turbogs_plugin.report.pictures import ERROR_FULL_SCALE, colored, depth_picture, error_picture, rounded, to_uint8
from turbogs_plugin.scene import PosedImages
from turbogs_plugin.types import SH_C0, TILE_SIZE, Cameras, Gaussians
from turbogs_plugin.viewer.eye import Eye
from turbogs_plugin.viewer.subject import Subject

GAP = 4
"""Dark pixels between panels."""
BACKGROUND = 24
"""Grey level where a picture has nothing to show."""
DIMMED = 0.4
"""Brightness of what is there for orientation only."""
ADDED, REMOVED, SAMPLED = (0.1, 0.9, 0.25), (1.0, 0.15, 0.15), (255, 170, 0)
TILE_FULL_SCALE = 512
"""Splats of a tile at which its colour is the brightest."""


class Picture(str, Enum):
    """The pictures to choose from; the value is what the page calls it."""

    RENDER = "Render"
    DEPTH = "Depth"
    TILES = "Splats per tile"
    CHANGES = "Added and removed"
    COMPARE = "Photo | render | error"
    PHOTO = "Photo"
    ERRORS = "Error map"
    AGES = "Age map"
    SAMPLES = "Samples of this iteration"

    @property
    def of_view(self) -> bool:
        """Whether it shows a view of the capture, not what the free camera sees."""
        return self in (Picture.COMPARE, Picture.PHOTO, Picture.ERRORS, Picture.AGES, Picture.SAMPLES)

    @property
    def renders(self) -> bool:
        """Whether it takes a rendering, so that fewer pixels take less time."""
        return self in (Picture.RENDER, Picture.DEPTH, Picture.CHANGES, Picture.COMPARE)


@dataclass(frozen=True)
class Request:
    """What a page wants to see.

    Args:
        picture: which.
        eye: the page's camera; its size is that of the picture.
        view: number of a view of the capture, see `CaptureViews`; taken within its bounds.
    """

    picture: Picture
    eye: Eye
    view: int = 0


@torch.no_grad()
def draw(subject: Subject, request: Request) -> np.ndarray:
    """[H, W, 3] uint8 of the eye's size. A picture that cannot be drawn, as `missing` says, is empty."""
    if missing(subject, request):
        return _empty(request)
    return DRAWN_BY[request.picture](subject, request)


def missing(subject: Subject, request: Request) -> str:
    """Why a picture cannot be drawn, in a sentence for the page; empty if it can."""
    picture = request.picture
    if picture is Picture.CHANGES and (subject.change is None or len(subject.change.added) != len(subject.gaussians)):
        return "No change yet: wait for the next event of density control of a running training."
    if not picture.of_view:
        return ""
    if subject.capture is None:
        return "This model came without its capture: name it by --scene."
    if picture in (Picture.ERRORS, Picture.AGES):
        if subject.maps is None or subject.step is None:
            return "Only a training keeps error maps."
        if shown_view(subject, request) >= len(subject.capture.train):
            return "This is a test view: error maps are kept of training views alone."
    if picture is Picture.SAMPLES and subject.samples is None:
        return "No samples yet: they are drawn by a running training."
    return ""


def shown_view(subject: Subject, request: Request) -> int:
    """The view that a picture of a view shows. Samples are shown where they fell: in the chosen view if it was sampled
    in this iteration, else in the first one that was."""
    view = min(max(0, request.view), len(subject.capture) - 1)
    if request.picture is Picture.SAMPLES and subject.samples is not None and view not in subject.samples.view_ids:
        return subject.samples.view_ids[0]
    return view


def fitted(size: tuple[int, int], box: tuple[int, int]) -> tuple[int, int]:
    """The largest (width, height) of the same proportions as `size` within a box."""
    scale = min(box[0] / size[0], box[1] / size[1])
    return max(1, min(box[0], round(size[0] * scale))), max(1, min(box[1], round(size[1] * scale)))


def _render(subject: Subject, request: Request) -> np.ndarray:
    cameras = request.eye.cameras(subject.gaussians.device)
    return to_uint8(render_image(subject.gaussians, cameras, **subject.options).colors)


def _depth(subject: Subject, request: Request) -> np.ndarray:
    cameras = request.eye.cameras(subject.gaussians.device)
    image = render_image(subject.gaussians, cameras, sh_degree=0, settings=subject.settings, with_depth=True)
    return depth_picture(image.depths.cpu().numpy())


def _tiles(subject: Subject, request: Request) -> np.ndarray:
    """Each tile in the colour of how many splats reach it."""
    cameras = request.eye.cameras(subject.gaussians.device)
    counts = splats_per_tile(subject.gaussians, cameras, settings=subject.settings)  # [rows, columns]
    share = torch.log1p(counts.float()) / np.log1p(TILE_FULL_SCALE)
    tiles = colored(share).repeat_interleave(TILE_SIZE, 0).repeat_interleave(TILE_SIZE, 1)
    tiles[::TILE_SIZE] = tiles[:, ::TILE_SIZE] = BACKGROUND
    return tiles[: request.eye.height, : request.eye.width].cpu().numpy()


def _changes(subject: Subject, request: Request) -> np.ndarray:
    """The model in grey, with what was added in green; and in red what was removed, where it was."""
    model, change = subject.gaussians, subject.change
    colors = (SH_C0 * model.sh0[:, 0] + 0.5).clamp(0.0, 1.0).mean(dim=1, keepdim=True) * DIMMED
    colors = torch.where(change.added[:, None], colors.new_tensor(ADDED), colors.expand(-1, 3))
    removed = change.removed
    colors = torch.cat([colors, colors.new_tensor(REMOVED).expand(len(removed), 3)])
    both = Gaussians(**{name: torch.cat([value, getattr(removed, name)]) for name, value in model.items()})
    painted = replace(both, sh0=((colors - 0.5) / SH_C0)[:, None], shN=both.shN[:, :0])
    cameras = request.eye.cameras(model.device)
    return to_uint8(render_image(painted, cameras, sh_degree=0, settings=subject.settings).colors)


def _compare(subject: Subject, request: Request) -> np.ndarray:
    """Photo, render and error, side by side or one below the other, whichever is larger."""
    width, height = request.eye.width, request.eye.height
    views, view_id, wide = _fitted_view(subject, request, (max(1, (width - 2 * GAP) // 3), height))
    _, _, tall = _fitted_view(subject, request, (width, max(1, (height - 2 * GAP) // 3)))
    beside = wide >= tall
    size = wide if beside else tall
    photo = _photo_of(subject, views, view_id, size)
    image = _render_of(subject, views, view_id, size)
    parts = [rounded(photo), rounded(image), error_picture(photo, image.clamp(0.0, 1.0))]
    gap_shape = (size[1], GAP, 3) if beside else (GAP, size[0], 3)
    gap = torch.full(gap_shape, BACKGROUND, dtype=torch.uint8, device=photo.device)
    strip = torch.cat([parts[0], gap, parts[1], gap, parts[2]], dim=1 if beside else 0)
    return _centred(strip, request)


def _photo(subject: Subject, request: Request) -> np.ndarray:
    return _centred(rounded(_photo_of(subject, *_fitted_view(subject, request))), request)


def _errors(subject: Subject, request: Request) -> np.ndarray:
    """The map's own values: a mean over the last visits of each pixel, not the error of the present model."""
    errors = subject.maps.view_errors(shown_view(subject, request))
    return _map_picture(errors / (3.0 * ERROR_FULL_SCALE), subject, request)


def _ages(subject: Subject, request: Request) -> np.ndarray:
    """Black: sampled just now. The brightest: as long ago as the oldest pixel of the view, on a logarithmic scale."""
    ages = subject.maps.ages(shown_view(subject, request), subject.step).float()
    return _map_picture(torch.log1p(ages) / torch.log1p(ages.max()).clamp(min=1e-6), subject, request)


def _samples(subject: Subject, request: Request) -> np.ndarray:
    """The photo, dimmed, with the sampled pixels bright. One that falls between the page's pixels is still shown."""
    views, view_id, size = _fitted_view(subject, request)
    width, height = views.cameras.sizes[view_id].tolist()
    samples = subject.samples
    sampled = torch.zeros(1, height, width, device=samples.pixel_ids.device)
    of_view = samples.view_of_slot() == samples.view_ids.index(shown_view(subject, request))
    sampled.view(-1)[samples.pixel_ids[of_view & samples.filled].long()] = 1.0
    mask = _resized(sampled, size, adaptive_max_pool2d)[0] > 0  # [H, W]
    photo = rounded(DIMMED * _photo_of(subject, views, view_id, size))
    bright = torch.tensor(SAMPLED, dtype=torch.uint8, device=photo.device)
    return _centred(torch.where(mask.to(photo.device)[..., None], bright, photo), request)


DRAWN_BY: dict[Picture, Callable[[Subject, Request], np.ndarray]] = {
    Picture.RENDER: _render,
    Picture.DEPTH: _depth,
    Picture.TILES: _tiles,
    Picture.CHANGES: _changes,
    Picture.COMPARE: _compare,
    Picture.PHOTO: _photo,
    Picture.ERRORS: _errors,
    Picture.AGES: _ages,
    Picture.SAMPLES: _samples,
}


def _fitted_view(
    subject: Subject, request: Request, box: tuple[int, int] | None = None
) -> tuple[PosedImages, int, tuple[int, int]]:
    """The set of the view that is shown, its number there, and the (width, height) that it has within a box, or within
    the page."""
    views, view_id = subject.capture.find(shown_view(subject, request))
    own = tuple(views.cameras.sizes[view_id].tolist())
    return views, view_id, fitted(own, box or (request.eye.width, request.eye.height))


def _photo_of(subject: Subject, views: PosedImages, view_id: int, size: tuple[int, int]) -> Tensor:
    """[height, width, 3] float on the model's device: a photo, reduced by means over areas or enlarged pixel by
    pixel."""
    photo = views.photos.image(view_id, subject.background).to(subject.gaussians.device)
    return _resized(photo.permute(2, 0, 1), size).permute(1, 2, 0)


def _render_of(subject: Subject, views: PosedImages, view_id: int, size: tuple[int, int]) -> Tensor:
    """[height, width, 3] float: the model in a view of the capture at another size.

    A pixel that stands for several of the photo has less blur (`RasterSettings.eps2d`).
    """
    cameras = views.cameras.select([view_id]).to(subject.gaussians.device)
    own = tuple(cameras.sizes[0].tolist())
    by = max(1.0, own[0] / size[0], own[1] / size[1])
    drawn = (min(size[0], own[0]), min(size[1], own[1]))
    ratios = cameras.Ks.new_tensor([drawn[0] / own[0], drawn[1] / own[1], 1.0])
    small = Cameras(cameras.viewmats, cameras.Ks * ratios[None, :, None], np.array([drawn], dtype=np.int64))
    settings = replace(subject.settings, eps2d=subject.settings.eps2d / by**2)
    image = render_image(subject.gaussians, small, **(subject.options | {"settings": settings}))
    return _resized(image.colors.permute(2, 0, 1), size).permute(1, 2, 0)


def _map_picture(share: Tensor, subject: Subject, request: Request) -> np.ndarray:
    """A map [H * W] of the view shown, fitted into the page; what is reduced keeps its largest values."""
    width, height = subject.maps.sizes[shown_view(subject, request)].tolist()
    size = fitted((width, height), (request.eye.width, request.eye.height))
    return _centred(colored(_resized(share.view(1, height, width), size, adaptive_max_pool2d)[0]), request)


def _resized(planes: Tensor, size: tuple[int, int], reduce: Callable | None = None) -> Tensor:
    """[C, height, width] of planes [C, H, W]. Smaller ones by `reduce`, means over areas where None; larger ones repeat
    pixels."""
    target = (size[1], size[0])
    if target == tuple(planes.shape[1:]):
        return planes
    if target[0] > planes.shape[1] or target[1] > planes.shape[2]:
        return interpolate(planes[None], target, mode="nearest")[0]
    return interpolate(planes[None], target, mode="area")[0] if reduce is None else reduce(planes[None], target)[0]


def _empty(request: Request) -> np.ndarray:
    return np.full((request.eye.height, request.eye.width, 3), BACKGROUND, dtype=np.uint8)


def _centred(pixels: Tensor, request: Request) -> np.ndarray:
    """[H, W, 3] uint8 of the eye's size with smaller pixels [h, w, 3] in its middle."""
    whole = _empty(request)
    top, left = (whole.shape[0] - pixels.shape[0]) // 2, (whole.shape[1] - pixels.shape[1]) // 2
    whole[top : top + pixels.shape[0], left : left + pixels.shape[1]] = pixels.cpu().numpy()
    return whole
