"""A scene: what training reads of a capture."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from turbogs_plugin.errors import InputError
from turbogs_plugin.masks import PixelMasks
from turbogs_plugin.scene.frame import Frame
from turbogs_plugin.scene.photos import Photos
from turbogs_plugin.types import Cameras
from turbogs_plugin.types.cameras import Observations


@dataclass
class PosedImages:
    """V photos with their cameras.

    Args:
        cameras: float32, in the scene's normalised frame.
        names: of the photos, in name order.
        photos: their pixels.
        masks: which pixels count, on the CPU; None for all.
        observations: where the photos show the scene's points; None: the capture does not say.
        refined: other cameras of the photos, which agree better with what is trained on (`refine_cameras`), if any.
    """

    cameras: Cameras
    names: tuple[str, ...] = field(repr=False)
    photos: Photos = field(repr=False)
    masks: PixelMasks | None = field(default=None, repr=False)
    observations: Observations | None = field(default=None, repr=False)
    refined: Cameras | None = field(default=None, repr=False)

    def __len__(self) -> int:
        return len(self.names)

    def to(self, device: torch.device | str) -> PosedImages:
        return replace(self.with_cameras_on(device), photos=self.photos.to(device))

    def with_cameras_on(self, device: torch.device | str) -> PosedImages:
        """The views with their cameras on a device, and photos where they are."""
        refined = None if self.refined is None else self.refined.to(device)
        return replace(self, cameras=self.cameras.to(device), refined=refined)

    def mask(self, view_id: int) -> Tensor | None:
        """[H, W] bool on the cameras' device, True where a pixel of a view counts; None where all do."""
        if self.masks is None or self.masks.pixel_counts[view_id] == self.cameras.sizes[view_id].prod():
            return None
        return self.masks.image(view_id).to(self.cameras.viewmats.device)


@dataclass(repr=False)
class Scene:
    """A capture ready for training, in its normalised frame.

    Args:
        name: of the scene's folder.
        train, test: the two disjoint sets of views.
        points: [M, 3] float32. Observations of the views count in them.
        point_colors: [M, 3] uint8.
        frame: back to the capture's own coordinates.
        extent: 1.1 times the largest distance of a training camera from their mean, as in 3DGS; 1 by the choice of
            frame, also where the cameras only turn on the spot.
        drawn_points: the points were drawn at random, as the capture has none.
        reprojection_error: how far points are from where training photos show them, a median in pixels, by
            `refine_cameras`: for the accuracy of the cameras; None: the capture does not say.
        doubt: what may be wrong with the poses; empty where nothing speaks against them.
        notes: what the capture was taken for, and what was done with its photos: lines for the user.
    """

    name: str
    train: PosedImages
    test: PosedImages
    points: Tensor
    point_colors: Tensor
    frame: Frame
    extent: float
    drawn_points: bool = False
    reprojection_error: float | None = None
    doubt: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for observations in (self.train.observations, self.test.observations):
            if observations and (most := int(observations.point_ids.max())) >= len(self.points):
                trouble = f"photos show point {most}, and the scene has {len(self.points)} points"
                raise InputError(f"{trouble}: with other points, give train and test views observations=None")

    def __repr__(self) -> str:
        width, height = self.train.cameras.sizes[0]
        views = f"{len(self.train)} + {len(self.test)} views of {width}x{height}"
        return f"Scene '{self.name}': {views}, {len(self.points):,} points"
