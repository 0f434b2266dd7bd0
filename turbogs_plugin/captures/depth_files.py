"""Depth maps that a ``transforms.json`` names, as nerfstudio and instant-ngp take them, for a loss of depth.

nerfstudio's ``depth_file_path`` is of 16-bit images or .npy in thousandths of the capture's unit, instant-ngp's
``depth_path`` of 16-bit images in ``integer_depth_scale``. A depth is along the camera's axis; 0 is none.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from turbogs_plugin.captures.capture import LARGEST_SIDE
from turbogs_plugin.captures.decoding import opened_image
from turbogs_plugin.errors import InputError

NERFSTUDIO, INSTANT_NGP = "depth_file_path", "depth_path"
THOUSANDTH = 1e-3
DEEP = ("I;16", "I;16B", "I;16L", "I", "F")
"""Pillow's modes of one channel of more than 8 bits."""


def depth_file(frame: dict[str, Any], scene: Path) -> tuple[Path, float] | None:
    """The depth map of a frame and the unit of its numbers, in the capture's; None where the frame names none.

    Args:
        frame: with what stands in the file for all frames.
        scene: folder that names begin at.

    Raises:
        InputError: a name of no file, or a unit that is no positive number.
    """
    key = next((key for key in (NERFSTUDIO, INSTANT_NGP) if frame.get(key)), None)
    if key is None:
        return None
    path = scene / str(frame[key])
    unit = THOUSANDTH if key == NERFSTUDIO else frame.get("integer_depth_scale", THOUSANDTH)
    if not path.is_file():
        raise InputError(f"{key} '{frame[key]}': there is no file {path}: copy it there, or take the entry out")
    if isinstance(unit, bool) or not isinstance(unit, (int, float)) or not 0 < unit < 1e300:
        raise InputError(f"integer_depth_scale is {str(unit)[:40]!r}: it must be a positive number")
    return path, float(unit)


def read_depth(path: Path, unit: float = THOUSANDTH) -> np.ndarray:
    """[H, W] float32 depths, in the capture's unit; 0 where there is none or it is not finite and positive.

    Raises:
        InputError: the file is no depth map of 16 bits or more, or larger than photos are.
    """
    if path.suffix.lower() == ".exr":
        raise InputError(f"depth map {path} is an .exr, which is not read: convert it to .npy or a 16-bit .png")
    if path.suffix.lower() == ".npy":
        try:
            values = np.load(path, mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise InputError(f"cannot read the depth map {path}: {str(error)[:120]}; export it again") from None
        values = values[..., 0] if values.ndim == 3 and values.shape[2] == 1 else values
    else:
        with opened_image(path, "depth map") as image:
            if image.mode not in DEEP:
                raise InputError(f"depth map {path} has {image.mode} pixels of 8 bits: export it with 16 bits")
            values = np.asarray(image)
    if values.ndim != 2 or max(values.shape) > LARGEST_SIDE or values.dtype.kind not in "uif":
        raise InputError(f"depth map {path} has {values.dtype} of {values.shape}: it must be numbers [height, width]")
    depths = np.asarray(values, dtype=np.float32) * np.float32(unit)
    return np.where(np.isfinite(depths) & (depths > 0), depths, np.float32(0.0))
