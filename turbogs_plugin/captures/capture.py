"""The capture that a reader of files hands to `load_scene`: in its own coordinates, checked, photos unread."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from turbogs_plugin.captures.undistort import LARGEST_SIDE, Lens
from turbogs_plugin.errors import InputError
from turbogs_plugin.types.cameras import Observations

FEWEST_PHOTOS = 3  # fewest photos of a capture
LONGEST_NAME = 4096  # most letters of a photo's name
LARGEST_PIXEL = 1e9  # most pixels of focal lengths and principal points, and 1 by the fewest: for float32


@dataclass
class Capture:
    """V posed photos and M points, in the capture's own coordinates.

    Args:
        names: V distinct names, ascending.
        photo_folder: photos of full size are ``photo_folder / name``; copies reduced by a factor may lie beside it, in
            a folder of the same name with ``_2``, ``_4``, ... appended.
        viewmats: [V, 4, 4] float64, world to camera (x right, y down, z forward); NaN where that is no rotation.
        Ks: [V, 3, 3] float64, intrinsics of the full-size photos, undistorted where they have a lens.
        sizes: [V, 2] int64 (width, height) of the full-size photos, undistorted where they have a lens.
        points: [M, 3] float64; M is 0 where `load_scene` is to draw them.
        point_colors: [M, 3] uint8.
        lenses: one a view, None for a pinhole camera.
        mask_files: files of masks that the capture names, one a view or None.
        notes: what the capture was taken for, and what was done with it: lines for the user.
        test: [V] bool, the test views of the capture's own split; None: views are split by their order.
        alpha: what the alpha of a photo is: the object's ``opacity``, so that the background shows through and training
            makes the model as transparent; or a ``mask``, whose zero pixels are ignored.
        observations: where photos show the points, in pixels as `Ks` has them; None: the capture does not say.
        doubt: what may be wrong with the poses.
    """

    names: tuple[str, ...]
    photo_folder: Path
    viewmats: np.ndarray
    Ks: np.ndarray
    sizes: np.ndarray
    points: np.ndarray
    point_colors: np.ndarray
    lenses: tuple[Lens | None, ...]
    mask_files: tuple[Path | None, ...]
    notes: tuple[str, ...]
    test: np.ndarray | None
    alpha: Literal["opacity", "mask"] = "opacity"
    observations: Observations | None = None
    doubt: str = ""

    @property
    def photo_sizes(self) -> np.ndarray:
        """[V, 2] int64 (width, height) that the full-size photos have on disk, if they are of their cameras' size."""
        both = zip(self.lenses, self.sizes, strict=True)
        return np.array([size if lens is None else lens.photo_size for lens, size in both])

    def checked(self, source: Path) -> Capture:
        """This capture without damaged views and points, which a note counts. Raises `InputError` where no point is
        finite, or fewer than `FEWEST_PHOTOS` training views are whole."""
        posed = np.isfinite(self.viewmats).all(axis=(1, 2))
        lensed = (np.abs(self.Ks) < LARGEST_PIXEL).all(axis=(1, 2))
        lensed &= (self.Ks[:, [0, 1], [0, 1]] > 1.0 / LARGEST_PIXEL).all(axis=1)
        sized = ((self.sizes >= 1) & (self.sizes <= LARGEST_SIDE)).all(axis=1)
        whole, finite, notes = posed & lensed & sized, np.isfinite(self.points).all(axis=1), []
        left = whole if self.test is None else whole & ~self.test
        for ok, trouble in (
            (posed, "a pose that is not a finite rotation and translation"),
            (lensed, f"intrinsics that are not finite with positive focal lengths, or beyond {LARGEST_PIXEL:g} pixels"),
            (sized, f"a size outside 1 .. {LARGEST_SIDE} pixels"),
        ):
            if not ok.all():
                count, damage = (~ok).sum(), f"'{self.names[ok.argmin()]}' has {trouble}"
                if left.sum() < min(FEWEST_PHOTOS, len(self.names)):
                    raise InputError(f"{source}: image {damage} ({count} such images): export or reconstruct it again")
                notes.append(f"{count} of {len(self.names)} images are left out as damaged: {damage}")
        if not finite.all():
            if not finite.any():
                raise InputError(f"{source}: none of {len(finite)} 3D points is finite: export or reconstruct it again")
            notes.append(f"{(~finite).sum()} of {len(finite)} points are left out, as they are not finite")
        return self.subset(np.flatnonzero(whole), np.flatnonzero(finite), tuple(notes)) if notes else self

    def subset(self, views: np.ndarray, points: np.ndarray, notes: tuple[str, ...]) -> Capture:
        """Some views and points, both ascending, and more notes."""
        shown = self.observations
        if shown is not None:
            shown = shown.of_views(views, np.ones((len(views), 2)))
            there = np.isin(shown.point_ids, points)
            ids = np.searchsorted(points, shown.point_ids[there])
            shown = Observations(shown.pixels[there], shown.view_ids[there], ids)
        lists = ("names", "lenses", "mask_files")
        kept: dict[str, Any] = {name: tuple(getattr(self, name)[view] for view in views) for name in lists}
        kept |= {name: getattr(self, name)[views] for name in ("viewmats", "Ks", "sizes")}
        kept |= {name: getattr(self, name)[points] for name in ("points", "point_colors")}
        test = None if self.test is None else self.test[views]
        return replace(self, notes=(*self.notes, *notes), test=test, observations=shown, **kept)


def bytes_of(path: Path) -> bytes:
    """A file's content. Raises `InputError` where it cannot be read, or Git LFS has left a pointer in its place."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    if content.startswith(b"version https://git-lfs"):
        raise InputError(f"{path} is a pointer of Git LFS: fetch it by 'git lfs pull'")
    return content


def text_of(path: Path) -> str:
    """A text file in UTF-8, or in UTF-16 or -32 as Windows' programs write it, marked or not; other bytes are as
    `surrogateescape` has them. Raises `InputError` where it cannot be read."""
    content = bytes_of(path)
    encoding = json.detect_encoding(content)
    text = content.decode(encoding, "surrogateescape" if encoding.startswith("utf-8") else "replace")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def named(names: Sequence[str], most: int = 3) -> str:
    """The first of some names."""
    return ", ".join(names[:most]) + (", ..." if len(names) > most else "")


def require_printable(name: str, source: Path) -> None:
    """Raise `InputError` where a photo's name cannot be printed, or is longer than a path; `source` names it."""
    if len(name) > LONGEST_NAME:
        raise InputError(f"{source}: an image name has {len(name)} letters: rename the photo")
    if not name.isprintable():
        raise InputError(f"{source}: image name {name!r} has signs that cannot be printed: rename the photo")
