"""Depth maps that a ``transforms.json`` names for its photos (nerfstudio's ``depth_file_path``): images in thousandths
of the capture's unit, or .npy and .exr in the unit; 0 is none."""

from __future__ import annotations

from pathlib import Path, PureWindowsPath

import numpy as np

from turbogs_plugin.captures.decoding import ALWAYS_PIXELS, PIXELS_A_BYTE, opened_image
from turbogs_plugin.captures.transforms import BENDS, FILE, frames_of
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.depths import CELL, Maps
from turbogs_plugin.scene.scene import PosedImages

KEY = "depth_file_path"
FEWEST, METRIC = 20, 0.1  # a map is metric where its median ratio to points' depths is so near 1, or of fewer cells


def depth_maps(folder: Path, views: PosedImages, unit: float) -> Maps | None:
    """What gives the maps of photos without a lens; None where there is none. `unit`: the scene's, in the capture's."""
    named: dict[str, Path] = {}
    for frame in frames_of(folder / FILE)[1] if (folder / FILE).is_file() else []:
        if KEY in frame and not any(frame.get(bend) for bend in BENDS):
            parts, place = PureWindowsPath(frame["file_path"]).parts, PureWindowsPath(str(frame[KEY])).as_posix()
            named |= {"/".join(parts[first:]): folder / place for first in range(len(parts))}

    def cells(view: int, known: np.ndarray) -> np.ndarray | None:
        if (file := named.get(views.names[view])) is None:
            return None
        depths, places = _read(file) / unit, []
        for count, side, have in zip(known.shape, views.cameras.sizes[view, ::-1], depths.shape, strict=True):
            places.append(((np.arange(count) + 0.5) * CELL / side * have).astype(int).clip(max=have - 1))
        depths = np.nan_to_num(depths[np.ix_(*places)], posinf=0.0)
        return _fitted(np.divide(1.0, depths, where=depths > 0, out=np.zeros_like(depths)), known)

    return cells if named else None


def _read(path: Path) -> np.ndarray:
    """[H, W] float64 depths in the capture's unit. Raises `InputError` for what is no map of 16 bits or more."""
    kind = path.suffix.lower()
    try:
        if kind == ".npy":
            values = np.load(path, mmap_mode="r", allow_pickle=False).squeeze()
        elif kind == ".exr":
            values = _exr(path)
        else:
            with opened_image(path) as image:
                values = np.asarray(image)
    except (OSError, ValueError, EOFError, RuntimeError) as error:
        said = str(error).rpartition(f"{path}: ")[2].partition(";")[0][:120]  # without another remedy
        raise InputError(f"cannot read the depth map {path}: {said}; export it as .npy or .png") from None
    if values.ndim != 2 or values.dtype.kind not in "uif" or values.dtype.itemsize < 2:
        raise InputError(f"depth map {path} has {values.dtype} of {values.shape}: export one channel of 16 bits")
    return np.asarray(values, dtype=np.float64) * (1.0 if kind in (".npy", ".exr") else 1e-3)


def _exr(path: Path) -> np.ndarray:
    """[H, W] of an OpenEXR image: its channel Z, else its first one. Raises `RuntimeError` and `ValueError`."""
    try:
        import OpenEXR
    except ImportError:
        raise InputError(f"{path} needs OpenEXR: pip install OpenEXR") from None
    low, high = OpenEXR.File(str(path), header_only=True).header()["dataWindow"]
    if np.prod(high.astype(float) - low + 1) > max(ALWAYS_PIXELS, PIXELS_A_BYTE * path.stat().st_size):
        raise ValueError("its header announces more pixels than its bytes may have")
    channels = OpenEXR.File(str(path), separate_channels=True).channels()
    return channels["Z" if "Z" in channels else min(channels)].pixels


def _fitted(given: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The map's inverse depths where it is metric; else what its numbers, as depths or inverse ones, make by the scale
    and shift that bring them nearest to the points' inverse depths: least squares, of the half that fits best."""
    both = (given > 0) & (known > 0)
    if both.sum() < FEWEST or abs(np.median(given[both] / known[both]) - 1) <= METRIC:
        return given
    found = []
    for numbers in (given, np.divide(1.0, given, where=given > 0, out=np.zeros_like(given))):
        kept = both
        for _ in range(2):
            fit = np.polyval(np.polyfit(numbers[kept], known[kept], 1), numbers)
            errors = np.where(both, np.abs(fit - known), np.inf)
            kept = errors <= np.median(errors[both])
        found.append((np.median(errors[both]), np.where(given > 0, fit.clip(min=0), 0.0)))
    return min(found, key=lambda pair: pair[0])[1]
