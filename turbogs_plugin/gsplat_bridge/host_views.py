"""The photos of a gsplat trainer's data set, with what is refused by name."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.errors import InputError, is_number, require
from turbogs_plugin.gsplat_bridge.host import require_keys
from turbogs_plugin.masks import PixelMasks
from turbogs_plugin.scene import Photos, PosedImages
from turbogs_plugin.types import Cameras

AS_GSPLAT = "expected items as of gsplat's data sets"


def read_items(
    trainset: Any, name: str, white: float, convert: Callable[[np.ndarray], Tensor]
) -> tuple[list[dict[str, Any]], list[Tensor] | None]:
    """The items of a data set, by number, read by several threads; and [H, W] bool of each, True where a pixel counts,
    or None where no item has a mask.

    Args:
        trainset: V items with "image" [H, W, 3], 0 .. `white`, and perhaps "mask" [H, W].
        name: of the data set, for messages.
        convert: of an image, float32 [H, W, 3] within 0 .. 255, what is kept of it in its item.

    Raises:
        InputError: it has no items by number, or cuts random patches (``patch_size``); or an image is no tensor
            [H, W, 3], or not within 0 .. `white`; or a mask has another size.
    """
    if not (hasattr(trainset, "__len__") and hasattr(trainset, "__getitem__")):
        raise InputError(f"{name} is a {type(trainset).__name__}: expected a data set with items by number, no loader")
    require(is_number(white) and 0 < white < float("inf"), "white", white, "above 0 and finite")
    require(len(trainset) > 0, f"length of {name}", len(trainset), "1 or more photos")
    if getattr(trainset, "patch_size", None) is not None:
        raise InputError(f"{name} needs whole images, its patch_size is {trainset.patch_size}: leave patch_size out")

    def read(number: int) -> dict[str, Any]:
        item, place = trainset[number], f"{name}[{number}]"
        require_keys(item if isinstance(item, dict) else {}, ("image",), place, AS_GSPLAT)
        image, mask = item["image"], item.get("mask")
        if not isinstance(image, Tensor) or image.dim() != 3 or image.shape[-1] != 3:
            found = tuple(image.shape) if isinstance(image, Tensor) else type(image).__name__
            raise InputError(f"{place}['image'] is {found}: expected a tensor [H, W, 3], colours alone")
        if mask is not None and tuple(mask.shape) != tuple(image.shape[:2]):
            expected = f"{tuple(image.shape[:2])} as its image"
            raise InputError(f"{place}['mask'] has shape {tuple(mask.shape)}: expected {expected}")
        values = np.asarray(image.detach().cpu(), dtype=np.float32)  # numpy has no threads that wait for each other
        low, high = float(values.min()), float(values.max())
        if not np.isfinite((low, high)).all():
            raise InputError(f"{place}['image'] has values that are not finite: expected 0 .. {white:g}")
        if not 0 <= low <= high <= white:
            raise InputError(f"{place}['image'] has values {low:g} .. {high:g}: expected 0 .. {white:g}; see white")
        whole = torch.ones(image.shape[:2], dtype=torch.bool) if mask is None else torch.as_tensor(mask).bool()
        return {**item, "image": convert(values * np.float32(255.0 / white)), "largest": high, "counts": whole}

    # Numbers, not iteration: a data set without __iter__ would be read past its end.
    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
        items = list(pool.map(read, range(len(trainset))))
    if white > 1 and max(item["largest"] for item in items) <= 1:
        raise InputError(f"{name} has images within 0 .. 1, and white is {white:g}: pass white=1")
    masked = any(item.get("mask") is not None for item in items)
    return items, [item["counts"] for item in items] if masked else None


def posed_images(views: Any, white: float) -> PosedImages:
    """The views of a data set whose items have "image", "K" [3, 3], "camtoworld" [4, 4] and perhaps "mask" [H, W]."""
    items, masks = read_items(views, "views", white, lambda image: torch.from_numpy(np.rint(image).astype(np.uint8)))
    cameras = []
    for number, item in enumerate(items):
        place = f"views[{number}]"
        require_keys(item, ("K", "camtoworld"), place, AS_GSPLAT)
        K, pose = (torch.as_tensor(item[key]).double().cpu() for key in ("K", "camtoworld"))
        for key, value, side in (("K", K, 3), ("camtoworld", pose, 4)):
            good = value.shape == (side, side) and bool(value.isfinite().all())
            require(good, f"{place}['{key}']", value.tolist(), f"finite, [{side}, {side}]")
        require(bool((K.diagonal()[:2] > 2).all()), f"{place}['K']", K.tolist(), "focal lengths and centre in pixels")
        axes, last = pose[:3, :3], pose[3].tolist()
        turned = (axes @ axes.T - torch.eye(3)).abs().max() < 1e-3 and axes.det() > 0 and last == [0, 0, 0, 1]
        require(bool(turned), f"{place}['camtoworld']", pose.tolist(), "a rotation and a place, without a scale")
        cameras.append((torch.linalg.inv(pose), K))
    viewmats, Ks = (torch.stack(values).float() for values in zip(*cameras, strict=True))
    sizes = np.array([item["image"].shape[1::-1] for item in items], dtype=np.int64)
    return PosedImages(
        Cameras(viewmats, Ks, sizes),
        tuple(map(str, range(len(items)))),
        Photos(torch.cat([item["image"].reshape(-1, 3) for item in items]), sizes),
        None if masks is None else PixelMasks.from_images(masks),
    )
