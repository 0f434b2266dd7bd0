"""The fingerprint of a capture in a checkpoint, so that no run is resumed with another capture."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from turbogs_plugin.scene import Frame, PosedImages, Scene

ROUNDING = 1e-5
"""Two readings of one reconstruction differ by less: in extents, and relative to each intrinsic."""


def capture_state(scene: Scene) -> dict[str, Any]:
    """The frame and the cameras of a scene, as plain tensors and values."""
    return {
        "frame": {"center": scene.frame.center.tolist(), "scale": scene.frame.scale},
        "train_views": _views_state(scene.train),
        "test_views": _views_state(scene.test),
    }


def capture_difference(saved: dict[str, Any], present: dict[str, Any]) -> str:
    """The difference of a capture from a saved one, in words; empty where there is none. Both are what `capture_state`
    gave, of one structure (`checkpoint.require_like`), among other things."""
    for split in ("train", "test"):
        before, now = saved[f"{split}_views"], present[f"{split}_views"]
        if before["names"] != now["names"]:
            return f"other {split} images"
        bounds = {"sizes": 0.0, "unmasked": 0.0, "Ks": ROUNDING * now["Ks"].abs(), "viewmats": ROUNDING}
        for key, bound in bounds.items():
            if before[key].shape != now[key].shape or not ((before[key] - now[key]).abs() <= bound).all():
                return f"other {'masks' if key == 'unmasked' else 'cameras'} of {split} images"
    first, frame = (Frame(**state["frame"]) for state in (saved, present))
    moved = max(np.abs(first.center - frame.center).max(), abs(first.scale - frame.scale))
    return "other coordinates" if moved > ROUNDING * frame.scale else ""


def _views_state(views: PosedImages) -> dict[str, Any]:
    cameras, masks = views.cameras, views.masks
    return {
        "unmasked": torch.from_numpy(masks.pixel_counts) if masks else torch.zeros(0, dtype=torch.int64),  # [V]
        "names": list(views.names),
        "sizes": torch.from_numpy(cameras.sizes),  # [V, 2] int64
        "viewmats": cameras.viewmats,  # [V, 4, 4] float32
        "Ks": cameras.Ks,  # [V, 3, 3] float32
    }
