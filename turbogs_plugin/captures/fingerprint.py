"""What a checkpoint says of its capture, so that no run is resumed with another one."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from turbogs_plugin.scene import Frame, PosedImages, Scene

NO_MASKS = torch.zeros(0, dtype=torch.int64)
"""Counts of unmasked pixels where a capture has no masks."""
ROUNDING = 1e-5
"""Two readings of one reconstruction differ by less: in extents, and relative to each intrinsic."""


def capture_state(scene: Scene) -> dict[str, Any]:
    """The frame and the cameras of a scene, as plain tensors and values."""
    return {
        "frame": {"center": scene.frame.center.tolist(), "scale": scene.frame.scale},
        "train_views": _views_state(scene.train),
        "test_views": _views_state(scene.test),
    }


def frame_of_state(state: dict[str, Any]) -> Frame:
    """The frame that `capture_state` wrote down.

    Raises:
        InputError: it is none.
    """
    return Frame(np.array(state["frame"]["center"]), state["frame"]["scale"])


def capture_difference(saved: dict[str, Any], present: dict[str, Any]) -> str:
    """How a capture differs from a saved one, in words; empty where it does not.

    Args:
        saved, present: what `capture_state` gave, of one structure (`checkpoint.require_like`), among other things.
    """
    for split in ("train", "test"):
        before, now = saved[f"{split}_views"], present[f"{split}_views"]
        if before["names"] != now["names"]:
            return f"other {split} images"
        for same, what in (
            (torch.equal(before["sizes"], now["sizes"]), "sizes"),
            (torch.equal(before["unmasked"], now["unmasked"]), "masks"),
            (
                _close(before["Ks"], now["Ks"], ROUNDING * now["Ks"].abs())
                and _close(before["viewmats"], now["viewmats"], torch.tensor(ROUNDING)),
                "cameras",
            ),
        ):
            if not same:
                return f"other {what} of {split} images"
    before, now = frame_of_state(saved), frame_of_state(present)
    moved = np.abs(before.center - now.center).max()
    if max(moved, abs(before.scale - now.scale)) > ROUNDING * now.scale:
        return "other coordinates"
    return ""


def _views_state(views: PosedImages) -> dict[str, Any]:
    cameras = views.cameras
    unmasked = NO_MASKS if views.masks is None else torch.from_numpy(views.masks.pixel_counts)
    return {
        "unmasked": unmasked,  # [V] int64
        "names": list(views.names),
        "sizes": torch.from_numpy(cameras.sizes),  # [V, 2] int64
        "viewmats": cameras.viewmats,  # [V, 4, 4] float32
        "Ks": cameras.Ks,  # [V, 3, 3] float32
    }


def _close(before: torch.Tensor, now: torch.Tensor, tolerance: torch.Tensor) -> bool:
    return before.shape == now.shape and bool(((before - now).abs() <= tolerance).all())
