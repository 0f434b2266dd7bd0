"""LLFF captures: ``poses_bounds.npy`` beside ``images`` or copies of them in ``images_4``, ``images_8``, ...

A row has 17 numbers: a 3x5 matrix [R | t | hwf] in row-major order, then the nearest and the farthest depth. The
columns of R are the camera's axes in the world (down, right, backward), t is the camera's centre, and hwf are height,
width and focal length of the full-size photos in pixels. There is a row for each photo, in name order.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from turbogs_plugin.captures.capture import Capture, check_photo_name, sizes_text
from turbogs_plugin.captures.decoding import photo_sizes
from turbogs_plugin.captures.photo_files import FRAME_SUFFIXES
from turbogs_plugin.captures.starting_points import NUM_RANDOM_POINTS, points_in_views
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.geometry import viewmat_of_pose

FILE = "poses_bounds.npy"
COLUMNS = 17
AGAIN = "write it again with LLFF's imgs2poses.py"


def read_llff(scene: Path, factor: int = 1) -> Capture:
    """Read a capture. There are no points: they are drawn within the views, between the bounds of depth.

    Args:
        scene: the folder.
        factor: the capture is to be loaded at this part of its full size. The folder with the smallest photos is
            taken that are not smaller than that; with a factor of 1 and no full-size photos, the
            largest ones that are there. `Capture.reduction` says which.

    Raises:
        InputError: a file of another shape, poses or bounds that make no sense, photos that do not belong to it.
    """
    source = scene / FILE
    viewmats, full_sizes, focals, bounds = _read_table(source)
    usable = _usable_folders(scene, factor)
    whole = (each for each in usable[:-1] if _is_whole_copy(*each, full_sizes))
    reduction, photos = next(whole, usable[-1])
    names = tuple(check_photo_name(photo.name, photos[0].parent) for photo in photos)
    sizes = _checked_sizes(photos, full_sizes, source)
    intrinsics = np.tile(np.eye(3), (len(sizes), 1, 1))
    intrinsics[:, [0, 1], [0, 1]] = focals[:, None] * (sizes / full_sizes)
    intrinsics[:, :2, 2] = 0.5 * sizes
    points = points_in_views(viewmats, intrinsics, sizes, bounds, NUM_RANDOM_POINTS)
    depths = f"{bounds[:, 0].min():.4g} to {bounds[:, 1].max():.4g}"
    folder = photos[0].parent
    return Capture(
        names=names,
        photo_folder=folder,
        viewmats=viewmats,
        Ks=intrinsics,
        sizes=sizes,
        points=points,
        notes=(
            f"{source} (LLFF): {len(sizes)} photos {sizes_text(sizes)} of {folder.name}; "
            f"no points, so {len(points):,} random ones (seed 0) within the views at depths of {depths}",
        ),
        reduction=reduction,
        alpha="mask",
    ).checked(source)


def _read_table(source: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What the file says of V photos, checked.

    Returns:
        [V, 4, 4] float64 world to camera (x right, y down, z forward); [V, 2] float64 (width, height) and [V] float64
        focal lengths in pixels, of the full-size photos; [V, 2] float64 nearest and farthest depth along the camera's
        axis, 0 < near < far.
    """
    try:
        # Mapped, so that a header cannot ask for more memory than there is file.
        rows = np.lib.format.open_memmap(source, mode="r")
        usable = rows.ndim == 2 and rows.shape[1] == COLUMNS and np.issubdtype(rows.dtype, np.number)
        usable = usable and not np.iscomplexobj(rows)
    except Exception as error:  # numpy's parser of headers lets through whatever it runs into
        reason = " ".join((str(error) or type(error).__name__).split())[:200]
        raise InputError(f"{source} is not a readable .npy file: {reason}; {AGAIN}") from error
    if not usable:
        shape = "x".join(map(str, rows.shape)) or "one value"
        raise InputError(f"{source} has {shape} of {rows.dtype} where N x {COLUMNS} numbers were expected: {AGAIN}")
    table = np.array(rows, dtype=np.float64)
    matrices = table[:, :15].reshape(-1, 3, 5)
    viewmats = np.empty((len(table), 4, 4))
    for row, matrix in enumerate(matrices):
        down, right, backward = matrix[:, :3].T
        try:
            viewmats[row] = viewmat_of_pose(np.column_stack([right, down, -backward]), matrix[:, 3])
        except ValueError as error:
            raise InputError(f"{source}: the pose in row {row} {error}: {AGAIN}") from None
    height, width, focal = matrices[:, :, 4].T
    near, far = table[:, 15:].T
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        sized = np.isfinite(matrices[:, :, 4]).all(axis=1) & (matrices[:, :, 4] > 0).all(axis=1)
        bounded = np.isfinite(far) & np.isfinite(1.0 / near) & (near > 0) & (near < far)
    for ok, trouble in (
        (sized, "a height, width or focal length that is not a positive number"),
        (bounded, "bounds of depth that are not 0 < near < far"),
    ):
        if not ok.all():
            raise InputError(f"{source}: row {int(np.argmin(ok))} has {trouble} ({(~ok).sum()} such rows): {AGAIN}")
    return viewmats, np.column_stack([width, height]), focal, table[:, 15:]


def _usable_folders(scene: Path, factor: int) -> list[tuple[int, list[Path]]]:
    """The folders that a capture can be loaded from at this factor, smallest photos first; at least one. Of each, by
    how much its photos are smaller than the full-size ones, and the photos in order."""
    matches = ((path, re.fullmatch(r"images(?:_([1-9]\d{0,3}))?", path.name)) for path in sorted(scene.iterdir()))
    found = ((int(match[1] or 1), _photos_of(path)) for path, match in matches if match and path.is_dir())
    folders = sorted((folder for folder in found if folder[1]), key=lambda folder: -folder[0])
    if not folders:
        raise InputError(f"{scene} has {FILE} but no photos ({', '.join(FRAME_SUFFIXES)}): put them into images")
    usable = [folder for folder in folders if factor % folder[0] == 0]
    if not usable and factor == 1:
        usable = folders[-1:]
    if not usable:
        reduction, photos = folders[-1]
        raise InputError(
            f"--factor {factor}: the largest photos of {scene} are those of {photos[0].parent.name}: use --factor "
            f"{reduction} or a multiple of it, or put the full-size photos into images"
        )
    return usable


def _photos_of(folder: Path) -> list[Path]:
    files = (file for file in sorted(folder.iterdir()) if file.suffix.lower() in FRAME_SUFFIXES)
    return [file for file in files if not file.name.startswith(".") and file.is_file()]


def _is_whole_copy(reduction: int, photos: list[Path], full_sizes: np.ndarray) -> bool:
    """Whether all photos are there in the size that the folder's name says."""
    if len(photos) != len(full_sizes):
        return False
    return bool((np.abs(photo_sizes(photos) - full_sizes / reduction) <= 1.0).all())


def _checked_sizes(photos: list[Path], full_sizes: np.ndarray, source: Path) -> np.ndarray:
    """[V, 2] int64 sizes of a folder's photos, which have the file's sizes at a uniform scale."""
    if len(photos) != len(full_sizes):
        missing = len(full_sizes) - len(photos)
        remedy = "take out the photos without a pose (COLMAP leaves out what it cannot place)"
        if missing > 0:
            remedy = f"{missing} photos are missing there, bring them back"
        raise InputError(
            f"{source} has {len(full_sizes)} poses but {photos[0].parent} has {len(photos)} photos: {remedy}, or "
            f"{AGAIN}"
        )
    sizes = photo_sizes(photos)
    # Either side of a reduced photo may be rounded by up to a pixel.
    ratios = sizes / full_sizes
    bent = np.abs(ratios[:, 0] - ratios[:, 1]) > (1.0 / full_sizes).sum(axis=1)
    if bent.any():
        view = int(np.argmax(bent))
        raise InputError(
            f"photo {photos[view]} is {sizes_text(sizes[[view]])}, no uniform scale of the "
            f"{sizes_text(full_sizes[[view]])} in {FILE}: use the photos that it was written for"
        )
    return sizes
