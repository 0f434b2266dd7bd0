"""LLFF captures: ``poses_bounds.npy`` beside ``images`` or copies of them in ``images_4``, ``images_8``, ...

A row has 17 numbers: a 3x5 matrix [R | t | hwf] in row-major order, then the nearest and the farthest depth. The
columns of R are the camera's axes in the world (down, right, backward), t is the camera's centre, and hwf are height,
width and focal length of the full-size photos in pixels. There is a row for each photo, in name order.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from turbogs_plugin.captures.capture import Capture, require_printable
from turbogs_plugin.captures.photo_files import IMAGES, NAMED_SUFFIXES, REDUCED, maps_beside, unread
from turbogs_plugin.captures.starting_points import clouds_beside, points_in_views
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.geometry import viewmat_of_pose

FILE = "poses_bounds.npy"
AGAIN = "write it again with LLFF's imgs2poses.py"


def read_llff(scene: Path) -> Capture:
    """Read a capture, with the largest photos that are there. There are no points: they are drawn within the views,
    between the bounds of depth. Raises `InputError` for a file of another shape, poses or bounds that make no sense,
    another number of photos."""
    source = scene / FILE
    table = _read_table(source)
    matrices, bounds = table[:, :15].reshape(-1, 3, 5), table[:, 15:]
    height, width, focal = matrices[:, :, 4].T
    sizes = np.column_stack([width, height])
    folder = next((scene / name for name in (IMAGES, *REDUCED) if _names_of(scene / name)), scene / IMAGES)
    names = _names_of(folder)
    if len(names) != len(table):
        raise InputError(
            f"{source} has {len(table)} poses but {folder} has {len(names)} photos: bring back those that are missing, "
            f"take out those without a pose, or {AGAIN}{f' ({unread(folder)})' if unread(folder) else ''}"
        )
    viewmats = np.empty((len(table), 4, 4))
    for row, (name, matrix) in enumerate(zip(names, matrices, strict=True)):
        require_printable(name, folder)
        down, right, backward = matrix[:, :3].T
        try:
            viewmats[row] = viewmat_of_pose(np.column_stack([right, down, -backward]), matrix[:, 3])
        except ValueError as error:
            raise InputError(f"{source}: the pose in row {row} {error}: {AGAIN}") from None
    Ks = np.tile(np.eye(3), (len(table), 1, 1))
    Ks[:, [0, 1], [0, 1]], Ks[:, :2, 2] = focal[:, None], 0.5 * sizes
    points = points_in_views(viewmats, Ks, sizes, bounds)
    words = f"{len(names)} photos of {folder.name}, no points, so {len(points):,} random ones within the views"
    depths = f"{bounds[:, 0].min():.4g} to {bounds[:, 1].max():.4g}"
    return Capture(
        names=tuple(names),
        photo_folder=folder,
        viewmats=viewmats,
        Ks=Ks,
        sizes=sizes.astype(np.int64),
        points=points,
        notes=(
            f"{source} (LLFF): {words} at depths of {depths}",
            *clouds_beside([scene], None, "LLFF's captures begin with random points"),
        ),
        alpha="mask",
    ).checked(source)


def _read_table(source: Path) -> np.ndarray:
    """[V, 17] float64, with positive sizes and focal lengths, and depths 0 < near < far."""
    try:
        # Mapped, so that a header cannot ask for more memory than there is file.
        table = np.array(np.lib.format.open_memmap(source, mode="r"), dtype=np.float64)
        if table.ndim != 2 or table.shape[1] != 17:
            raise ValueError(f"{'x'.join(map(str, table.shape))} where N x 17 numbers were expected")
    except Exception as error:  # numpy's parser of headers lets through whatever it runs into
        reason = " ".join((str(error) or type(error).__name__).split())[:200]
        raise InputError(f"{source} is not a readable table: {reason}; {AGAIN}") from error
    lens, (near, far) = table[:, 4:15:5], table[:, 15:].T
    usable = ((lens > 0) & np.isfinite(lens)).all(axis=1) & (near > 1e-300) & (near < far) & np.isfinite(far)
    if not usable.all():
        trouble = "no positive height, width and focal length, or bounds of depth that are not 0 < near < far"
        raise InputError(f"{source}: row {int(np.argmin(usable))} has {trouble}: {AGAIN}")
    return table


def _names_of(folder: Path) -> list[str]:
    """The names of a folder's photos, in order."""
    files = list(folder.iterdir()) if folder.is_dir() else []
    files = [f for f in files if f.suffix.lower() in NAMED_SUFFIXES and f.name[0] != "." and f.is_file()]
    return sorted(file.name for file in set(files).difference(maps_beside(files)))
