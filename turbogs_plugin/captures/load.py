"""From a path to a scene that can be trained on."""

from __future__ import annotations

import itertools
import math
import shlex
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Lock

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.captures import blender, llff
from turbogs_plugin.captures.capture import FEWEST_PHOTOS, Capture, named
from turbogs_plugin.captures.colmap import INSTANT_NGP_FOLDERS, MODEL_FOLDERS, find_model, incomplete_model, read_colmap
from turbogs_plugin.captures.decoding import (
    channels_of,
    is_turned,
    load_photos,
    photo_array,
    photo_sizes,
    reduced_sizes,
)
from turbogs_plugin.captures.mask_files import find_masks, load_masks
from turbogs_plugin.captures.nearby import POSE_FILES, capture_around, capture_near
from turbogs_plugin.captures.photo_folder import find_photos, unread
from turbogs_plugin.captures.starting_points import colors_in_photos
from turbogs_plugin.captures.transforms import FILE, read_transforms
from turbogs_plugin.captures.undistort import undistortion_note
from turbogs_plugin.errors import InputError
from turbogs_plugin.masks import PixelMasks, ViewMask
from turbogs_plugin.scene.frame import Frame
from turbogs_plugin.scene.geometry import camera_centers
from turbogs_plugin.scene.host_arrays import file_note
from turbogs_plugin.scene.scene import PosedImages, PosedViews, Scene
from turbogs_plugin.types import Cameras

MOST_PIXELS = 1 << 28
"""Of a photo as it is trained on. Where tiles are drawn whole, a draw tells 2^20 of a view apart (`RANK_BITS` of
engine/reference/draws.py)."""

FARTHEST = 1e15
"""Distance of a point in extents, from which on squares, and squares of these, do not fit into float32."""


def load_scene(
    path: str | Path,
    factor: int = 1,
    test_every: int = 8,
    progress: Callable[[int, int], object] | None = None,
    sized: Callable[[np.ndarray, np.ndarray], object] | None = None,
    meanwhile: Callable[[PosedViews, PosedViews, Tensor], object] | None = None,
) -> Scene:
    """Load a capture with its photos.

    Cameras with distortion become pinhole cameras in the same place, their photos are undistorted. Masks are read from
    where `find_masks` looks, and from the photos' alpha where that is no opacity (`Capture.alpha`); views that are
    masked whole are left out.

    Args:
        path: the scene's folder. Where it could be of several kinds, the first of these is taken: a COLMAP
            reconstruction (binary or text, in ``sparse``, ``colmap/sparse``, ... or numbered folders of these), a
            ``transforms.json``, NeRF-synthetic's ``transforms_train.json``, LLFF's ``poses_bounds.npy``.
        factor: photos and intrinsics are reduced by this. Copies in ``images_<factor>`` are used where all are there
            in the right size; otherwise ``images`` are reduced by area averaging.
        test_every: the first of each `test_every` photos in name order is a test view, the others are for training.
            Captures with a split of their own (NeRF-synthetic, lists in a ``transforms.json``) keep it.
        progress: called with the number of photos decoded so far, and of all, by one thread at a time.
        sized: called with the sizes [V, 2] (width, height) of training and of test views, before a photo is decoded;
            what it raises ends the loading.
        meanwhile: called once, while photos are decoded, with training views, test views and the scene's points.

    Raises:
        InputError: anything wrong with the scene or the arguments, in one line.
    """
    scene = Path(path)
    if not isinstance(factor, int) or factor < 1:
        raise InputError(f"factor is {factor}: it must be an integer of at least 1")
    if not isinstance(test_every, int) or test_every < 1:
        raise InputError(f"test_every is {test_every}: it must be an integer of at least 1")
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # what is not finite is refused by its name
        capture = _read(scene, factor)
    test = np.arange(len(capture.names)) % test_every == 0 if capture.test is None else capture.test
    if len(test) < FEWEST_PHOTOS:
        raise InputError(f"{scene} has {len(test)} images: at least {FEWEST_PHOTOS} are needed; add photos to it")
    if capture.test is not None and (~test).sum() < FEWEST_PHOTOS:
        raise InputError(f"{scene} has {(~test).sum()} training images: at least {FEWEST_PHOTOS} are needed; add some")
    if test.all():
        raise InputError(f"test_every is {test_every}: every image of {scene} would be a test image; use 2 or more")

    with np.errstate(over="ignore", invalid="ignore"):
        frame = Frame.around(camera_centers(capture.viewmats[~test]), capture.points)
    viewmats = torch.from_numpy(frame.normalise_poses(capture.viewmats)).float()
    points = torch.from_numpy(frame.normalise_points(capture.points)).float()
    far = ~(points.abs() < FARTHEST).all(dim=1)
    if far.any():
        raise InputError(
            f"{scene}: {int(far.sum())} of {len(far)} 3D points lie too far from the cameras for float32: take them out"
        )
    if factor > 1 and factor % capture.reduction:
        raise InputError(
            f"--factor {factor}: the largest photos of {scene} are those of {capture.photo_folder.name}: use --factor "
            f"{capture.reduction} or a multiple of it, or bring the full-size photos back"
        )
    remaining = max(1, factor // capture.reduction)
    paths, file_sizes, sizes, fitted = _find_photos(scene, capture, remaining)
    largest = sizes[np.argmax(sizes.prod(axis=1))]
    if largest.prod() > MOST_PIXELS:
        raise InputError(
            f"{scene}: a photo would have {largest[0]}x{largest[1]} pixels, more than {MOST_PIXELS}: use --factor "
            f"{factor * math.ceil(math.sqrt(largest.prod() / MOST_PIXELS))}"
        )
    ratios = sizes / capture.sizes  # [V, 2]
    intrinsics = capture.Ks.copy()
    intrinsics[:, :2] *= ratios[:, :, None]

    mask_files, mask_note = find_masks(scene, capture, paths)
    masks = load_masks(mask_files, paths, capture, file_sizes, sizes)
    seen = np.array([mask is None or mask.pixels > 0 for mask in masks])
    for name, part in (("training", ~test), ("test", test)):
        if not (part & seen).any():
            raise InputError(
                f"{scene}: all {part.sum()} {name} photos are masked whole: zero in a mask, or in "
                "the alpha of a photo, is masked; mend the masks, or take them away"
            )

    parts = [np.flatnonzero(part & seen) for part in (~test, test)]
    channels = [channels_of([paths[view] for view in views]) if capture.alpha == "opacity" else 3 for views in parts]
    # Before minutes go into photos that have no room.
    if sized is not None:
        sized(*(sizes[views] for views in parts))
    colors = [photo_array(sizes[views], count) for views, count in zip(parts, channels, strict=True)]
    counter, one_at_a_time = itertools.count(1), Lock()

    def loaded() -> None:
        with one_at_a_time:
            if progress is not None:
                progress(next(counter), int(seen.sum()))

    def pose(views: np.ndarray) -> PosedViews:
        cameras = Cameras(viewmats[views], torch.from_numpy(intrinsics[views]).float(), sizes[views])
        shown = None if capture.observations is None else capture.observations.of_views(views, ratios[views])
        return PosedViews(cameras, shown)

    def select(views: np.ndarray, colors: Tensor, posed: PosedViews, meanwhile: Callable | None) -> PosedImages:
        names = tuple(capture.names[view] for view in views)
        files, lenses = ([of_view[view] for view in views] for of_view in (paths, capture.lenses))
        photos = load_photos(files, file_sizes[views], sizes[views], lenses, colors, loaded, meanwhile)
        masked = _pixel_masks([masks[view] for view in views], sizes[views])
        return PosedImages(posed.cameras, names, photos, masked, posed.observations)

    posed = [pose(views) for views in parts]
    work = (None if meanwhile is None else partial(meanwhile, *posed, points), None)
    train, tested = (select(*part) for part in zip(parts, colors, posed, work, strict=True))
    if capture.point_colors is None:
        point_colors = colors_in_photos(points, train.cameras, train.photos, train.masks)
    else:
        point_colors = torch.from_numpy(capture.point_colors)
    notes = (
        fitted,
        undistortion_note(capture.lenses),
        mask_note,
        _masked_note(capture.names, masks, mask_files, sizes, seen),
        "transparent photos are composited on a background (train.background)" if train.photos.transparent else "",
        file_note([train.photos.stored, tested.photos.stored], "photos"),
    )
    return Scene(
        name=scene.resolve().name,
        train=train,
        test=tested,
        points=points,
        point_colors=point_colors,
        frame=frame,
        extent=1.0,
        drawn_points=capture.point_colors is None,
        notes=tuple(filter(None, (*capture.notes, *notes))),
    )


def _pixel_masks(masks: list[ViewMask | None], sizes: np.ndarray) -> PixelMasks | None:
    """The masks of views of these `sizes` [V, 2]; None where none has a masked pixel."""
    if all(mask is None for mask in masks):
        return None
    pairs = zip(masks, sizes.tolist(), strict=True)
    return PixelMasks.of_views([ViewMask.whole(tuple(size)) if mask is None else mask for mask, size in pairs])


def _masked_note(
    names: tuple[str, ...],
    masks: list[ViewMask | None],
    files: list[Path | None],
    sizes: np.ndarray,
    seen: np.ndarray,
) -> str:
    """How much is masked, by the photos' alpha where no file does it, and which views are left out for it, in one line;
    empty where nothing is masked."""
    if not (cut := [view for view, mask in enumerate(masks) if mask is not None]):
        return ""
    share = 1.0 - sum(masks[view].pixels for view in cut) / int(sizes[cut].prod(axis=1).sum())
    gone = [name for name, kept in zip(names, seen, strict=True) if not kept]
    left_out = f"; {len(gone)} masked whole are left out: {gone[0]}, ..." if gone else ""
    by_alpha = sum(files[view] is None for view in cut)
    by = "" if not by_alpha else " by their alpha" if by_alpha == len(cut) else f" ({by_alpha} by their alpha alone)"
    return f"{len(cut)} photos have masked pixels{by}, {share:.1%} of them{left_out}"


def holds_photos_alone(scene: Path) -> bool:
    """Whether a folder has photos, and nothing that says where they were taken from: no reconstruction in parts, and no
    capture in it or around it."""
    if not scene.is_dir() or _is_begun(scene) or camera_files(scene) != (None, []):
        return False
    return bool(find_photos(scene)[1]) and not capture_near(scene)


def _is_begun(scene: Path) -> bool:
    """Whether there is a folder for a reconstruction, whatever it has."""
    return any((scene / place.partition("/")[0]).is_dir() for place in MODEL_FOLDERS if place != ".")


def camera_files(scene: Path) -> tuple[tuple[Path, str] | None, list[str]]:
    """What a folder has of cameras: the reconstruction, as `find_model` gives it, and the names of other files."""
    files = [file for file in POSE_FILES if (scene / file).is_file()]
    return find_model(scene, anywhere=not files), files


def _read(scene: Path, factor: int) -> Capture:
    """The capture, of the first kind in the order that `load_scene` states."""
    if not scene.is_dir():
        if scene.is_file() and not unread(scene) and (where := capture_around(scene)):
            raise InputError(where)
        trouble = f"{scene} is a file" if scene.is_file() else f"{scene} does not exist"
        raise InputError(f"no such scene: {unread(scene) or f'{trouble}: give the folder of a capture, or of photos'}")
    model, files = camera_files(scene)
    found = _read_model(scene, model, files)
    if isinstance(found, Capture):
        return found
    other = _read_other(scene, files, factor)
    return replace(other, notes=(*other.notes, found)) if found else other


def _read_model(scene: Path, model: tuple[Path, str] | None, files: list[str]) -> Capture | str:
    """The capture of what `camera_files` gave, or why that reconstruction is not used; empty where there is none."""
    if model is None:
        lack = incomplete_model(scene)
        if lack is None or lack[0] == scene:
            return ""
        return f"{lack[0]} is not used: it has no {' and no '.join(lack[1])}"
    # What instant-ngp leaves beside its transforms.json must serve as well as that.
    whole = bool(files) and model[0].relative_to(scene).parts[:1] in [(name,) for name in INSTANT_NGP_FOLDERS]
    try:
        capture = read_colmap(scene, *model)
    except InputError as error:
        if not whole:
            raise
        return f"{model[0]} is not used: {error}"
    there = [(capture.photo_folder / name).is_file() for name in capture.names]
    if not files or (all(there) if whole else any(there)):
        return _passing_over(files, capture)
    # LLFF's poses are of the reduced copies too, which have other names than COLMAP's photos.
    return f"{model[0]} not used, its photos are not there"


def _read_other(scene: Path, files: list[str], factor: int) -> Capture:
    """The capture of the first of these files, none of them COLMAP's."""
    if FILE in files:
        return _passing_over(files[1:], read_transforms(scene))
    if files and files[0] in blender.FILES:
        return _passing_over([file for file in files if file not in blender.FILES], blender.read_blender(scene))
    if files:
        return llff.read_llff(scene, factor)
    if not _is_begun(scene) and (where := capture_near(scene)):
        raise InputError(where)
    solve = f"'turbogs reconstruct {shlex.quote(str(scene))} --out SCENE'"
    if holds_photos_alone(scene):
        raise InputError(
            f"{scene} has {len(find_photos(scene)[1])} photos and nothing that says where they were taken from: find "
            f"that by {solve}, then use SCENE"
        )
    if lack := incomplete_model(scene):
        folder, absent = lack
        files_back = "bring that file" if len(absent) == 1 else "bring these files"
        anew = f"take {scene / folder.relative_to(scene).parts[0]} away and find the cameras" if folder != scene else ""
        raise InputError(
            f"{folder} has no {' and no '.join(absent)}: {files_back} of the reconstruction back"
            + (f", or {anew} by {solve}" if anew and find_photos(scene)[1] else "")
        )
    if photos := find_photos(scene)[1]:
        begun = next(place for place in MODEL_FOLDERS if (scene / place).is_dir())
        raise InputError(
            f"{scene} has {len(photos)} photos and no reconstruction in {scene / begun}: bring its files back, or take "
            f"the folder away and find the cameras by {solve}"
        )
    raise InputError(
        f"{scene} has neither a COLMAP reconstruction (cameras, images and points3D as .bin or .txt in sparse/0) nor a "
        f"{FILE}, a {blender.TRAIN_FILE} or a {llff.FILE}, nor photos"
        + f"; {unread(scene) or 'give the folder of a capture, or of photos'}"
    )


def _passing_over(files: list[str], capture: Capture) -> Capture:
    """The capture, whose notes say that these files, which make the folder another kind too, were not used."""
    return replace(capture, notes=(*capture.notes, f"{', '.join(files)} not used")) if files else capture


def _find_photos(scene: Path, capture: Capture, factor: int) -> tuple[list[Path], np.ndarray, np.ndarray, str]:
    """The files to read, [V, 2] their sizes, [V, 2] the sizes to give them, and a note on those of other sizes."""
    if factor > 1:
        reduced_sizes(capture.sizes, factor)  # refuses a factor that is too large
    expected = capture.photo_sizes
    if factor > 1 and capture.photo_folder != scene:
        folder = capture.photo_folder.with_name(f"{capture.photo_folder.name}_{factor}")
        paths = [folder / name for name in capture.names]
        if all(path.is_file() for path in paths):
            sizes = photo_sizes(paths)
            if (np.abs(sizes - expected / factor) <= 1.0).all():
                return paths, sizes, _undistorted_sizes(capture, sizes), ""
    paths = [capture.photo_folder / name for name in capture.names]
    missing = [name for name, path in zip(capture.names, paths, strict=True) if not path.is_file()]
    if len(missing) == len(paths) and (where := capture_around(scene)):
        raise InputError(where)
    if missing:
        remedy = _in_other_letters(capture.photo_folder / missing[0]) or "bring them back"
        raise InputError(
            f"{len(missing)} of {len(paths)} photos are missing in {capture.photo_folder}: {named(missing)}; {remedy}"
        )
    sizes = photo_sizes(paths)
    fitted = _require_scaled(paths, sizes, expected)
    return paths, sizes, reduced_sizes(_undistorted_sizes(capture, sizes), factor), fitted


def _in_other_letters(path: Path) -> str:
    """What to do where a file that is missing is there in capital or small letters; empty where it is not."""
    beside = path.parent.iterdir() if path.parent.is_dir() else ()
    other = next((file.name for file in beside if file.name.lower() == path.name.lower()), None)
    return f"{other} is there: give the files the letters that the reconstruction has" if other else ""


def _undistorted_sizes(capture: Capture, sizes: np.ndarray) -> np.ndarray:
    """[V, 2] int64: the sizes that photos of these `sizes` [V, 2] have once they are undistorted."""
    pairs = zip(capture.lenses, sizes.tolist(), strict=True)
    return np.array([size if lens is None else lens.size_of(size) for lens, size in pairs], dtype=np.int64)


def _require_scaled(paths: list[Path], sizes: np.ndarray, expected: np.ndarray) -> str:
    """A note on the photos that are not of their cameras' size; empty where all are.

    Raises:
        InputError: a photo that is no scaled copy, to a pixel, of one of its camera's size: it was cropped or turned.
    """
    ratios = sizes / expected  # [V, 2]
    scaled = (np.abs(expected * ratios[:, ::-1] - sizes) <= 1.0).any(axis=1)
    if not scaled.all():
        bad = int(np.argmin(scaled))
        (width, height), (camera_width, camera_height) = sizes[bad].tolist(), expected[bad].tolist()
        differ = f"photo {paths[bad]} is {width}x{height} but its camera is {camera_width}x{camera_height}"
        if is_turned(paths[bad]):
            raise InputError(
                f"{differ}: its EXIF orientation turns it, which is not followed here; write its pixels turned, as by  "
                "magick mogrify -auto-orient PHOTO"
            )
        raise InputError(
            f"{differ}: it was cropped or turned, not scaled; use the photos that the cameras were reconstructed from"
        )
    others = np.flatnonzero((sizes != expected).any(axis=1))
    if not len(others):
        return ""
    (width, height), (camera_width, camera_height) = sizes[others[0]].tolist(), expected[others[0]].tolist()
    return (
        f"{len(others)} photos in another size than their cameras: intrinsics rescaled from "
        f"{camera_width}x{camera_height} to {width}x{height}"
    )
