"""Loading: a folder becomes a capture of one kind, and that a scene that can be trained on."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import torch

from turbogs_plugin.captures import transforms
from turbogs_plugin.captures.capture import FEWEST_PHOTOS, Capture
from turbogs_plugin.captures.colmap import MODEL_FOLDERS, find_model, read_colmap
from turbogs_plugin.captures.decoding import ALWAYS_PIXELS, is_transparent, load_photos, photo_sizes, reduced_sizes
from turbogs_plugin.captures.mask_files import find_masks, load_masks
from turbogs_plugin.captures.photo_files import IMAGES, find_photos, unread
from turbogs_plugin.captures.starting_points import colors_in_photos, starting_points
from turbogs_plugin.captures.undistort import undistortion_note
from turbogs_plugin.errors import InputError
from turbogs_plugin.masks import PixelMasks
from turbogs_plugin.scene.frame import Frame
from turbogs_plugin.scene.geometry import camera_centers, seen
from turbogs_plugin.scene.host_arrays import file_note
from turbogs_plugin.scene.photos import Photos
from turbogs_plugin.scene.scene import PosedImages, Scene
from turbogs_plugin.types import Cameras

READERS: dict[str, Callable[[Path], Capture]] = {
    transforms.FILE: transforms.read_transforms,
    transforms.TRAIN_FILE: transforms.read_blender,
}
"""Readers of files of cameras that are not COLMAP's, in the order in which they are taken."""
OTHER_POSES = {
    "COLMAP: move its folder to sparse/0": "*/cameras.bin */cameras.txt */*/cameras.bin */*/cameras.txt",
    "OpenSfM or ODM: ns-process-data odm, or OpenSfM's export_colmap": "opensfm/*.json reconstruction*.json odm_*",
    "Metashape: export its cameras as COLMAP, or ns-process-data metashape": "*.xml *.psx",
    "others: write a transforms.json": "*pose*.txt pose/* *traj*.txt groundtruth.txt odometry.csv cameras*.npz cams/*",
    "RealityScan: export as COLMAP, or ns-process-data realitycapture": "*.csv *.rspj *.rcproj *.xmp",
    "Bundler, VisualSFM or Pix4D: export as COLMAP": "*.out *.nvm *calibrated*camera*.txt */*calibrated*camera*.txt",
    "openMVG or Meshroom: openMVG_main_openMVG2Colmap, or export as COLMAP": "sfm_data* *.sfm",
    "Polycam: ns-process-data polycam": "*cameras/*.json keyframes/*cameras mesh_info.json",
    "Record3D: ns-process-data record3d": "metadata.json EXR_RGBD",
    "LLFF: take the sparse/0 that it was made from": "poses_bounds.npy",
    "nerfstudio: name it transforms.json, or give the folder that it lies in": "transforms*.json */transforms*.json",
    "Kapture: kapture_export_colmap.py": "sensors/trajectories.txt",
    "the capture of a model: use that capture": "cameras.json",
}
"""Files that may have cameras and are not read, by what writes them and the way from there to a capture."""
SPLITS = ("test.txt", "train.txt", "val.txt", "split.json", "train_test_lists.json", "transforms_test.json")
"""Files of splits, of which readers of other kinds of captures take none."""
PARTS_OF_RUN = ("model.ply", "checkpoints", "report")  # one lies beside the config.yaml of a run that has begun
LENS_PIXELS = 16  # pixels of a lens's camera for each of the photo that is undistorted in the camera's size, at most
FARTHEST = 1e15  # distance of a point in extents, from which on squares, and squares of these, do not fit into float32


def load_scene(
    path: str | Path,
    factor: int = 1,
    test_every: int = 8,
    progress: Callable[[int, int], object] | None = None,
    validation: bool = False,
    meanwhile: Callable[[Scene], object] = lambda scene: None,
) -> Scene:
    """Load a capture with its photos.

    Cameras with distortion become pinhole cameras in the same place, their photos are undistorted. Views that are
    masked whole (`find_masks`, or by the photos' alpha where `Capture.alpha` says so) are left out.

    Args:
        path: the scene's folder. Where it could be of several kinds, the first of these is taken: a COLMAP
            reconstruction (`find_model`), ``transforms.json``, NeRF-synthetic's ``transforms_train.json``.
        factor: photos and intrinsics are reduced by this. Copies in ``images_<factor>`` are used where all are there
            in the right size; otherwise ``images`` are reduced by area averaging.
        test_every: the first of each `test_every` photos in name order is a test view, the others are for training.
            Captures with a split of their own (NeRF-synthetic, lists in a ``transforms.json``) keep it.
        validation: leave the test views out, and test on the first of each `test_every` of the others.
        progress: called with the number of photos decoded so far, and of all.
        meanwhile: called with the scene while its photos are decoded, without their pixels.

    Raises:
        InputError: anything wrong with the scene or the arguments, in one line.
    """
    scene = Path(path)
    for name, number in (("factor", factor), ("test_every", test_every)):
        if not isinstance(number, int) or number < 1:
            raise InputError(f"{name} is {number}: it must be an integer of at least 1")
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # what is not finite is refused by its name
        capture = read_capture(scene)
        test = _test_views(scene, capture, test_every)
        if drawn := not len(capture.points):
            own = slice(None) if capture.test is None else ~test
            places, how = starting_points(capture.viewmats[own], capture.Ks[own], capture.sizes[own])
            notes = (*capture.notes, f"{len(places):,} random points are drawn {how}, as the capture has none")
            capture = replace(capture, points=places, point_colors=np.zeros(places.shape, np.uint8), notes=notes)
        if validation:
            note = f"{test.sum()} test photos are left out: photos that choose settings are among the others"
            capture = capture.subset(np.flatnonzero(~test), np.arange(len(capture.points)), (note,))
            capture = replace(capture, test=None)
            test = _test_views(scene, capture, test_every)
        frame = Frame.around(camera_centers(capture.viewmats[~test]), capture.points)
    points = torch.from_numpy(frame.normalise_points(capture.points)).float()  # [M, 3]
    if (far := ~(points.abs() < FARTHEST).all(dim=1)).any():
        trouble = f"{int(far.sum())} of {len(far)} 3D points lie too far from the cameras for float32"
        raise InputError(f"{scene}: {trouble}: take them out")
    files, file_sizes, sizes, size_note = _find_photos(scene, capture, factor)
    mask_files, mask_note = find_masks(scene, capture, files)
    masks = load_masks(mask_files, files, capture, file_sizes, sizes)
    seen = np.array([mask is None or mask.pixel_counts[0] > 0 for mask in masks])
    parts = [np.flatnonzero(part & seen) for part in (~test, test)]
    for name, part, views in zip(("training", "test"), (~test, test), parts, strict=True):
        if not len(views):
            how = "zero in a mask, or in the alpha of a photo, is masked; mend the masks, or take them away"
            raise InputError(f"{scene}: all {part.sum()} {name} photos are masked whole: {how}")
    views, count = np.concatenate(parts), len(parts[0])
    paths, lenses = [files[view] for view in views], [capture.lenses[view] for view in views]
    channels = 4 if capture.alpha == "opacity" and any(map(is_transparent, paths)) else 3
    train, tested = (_posed(capture, frame, masks, part, sizes[part]) for part in parts)
    name, colors = scene.resolve().name, torch.from_numpy(capture.point_colors)
    loaded = Scene(name, train, tested, points, colors, frame, extent=1.0, drawn_points=drawn, doubt=capture.doubt)
    # In one array: its room is found once.
    photos = load_photos(paths, sizes[views], lenses, channels, progress, lambda: meanwhile(loaded))
    train.photos.colors, tested.photos.colors = photos.colors.tensor_split([int(photos.offsets[count])])
    if drawn:
        loaded.point_colors = colors_in_photos(points, train.cameras, train.photos, train.masks)
    notes = (
        *capture.notes,
        size_note,
        undistortion_note(capture.lenses),
        mask_note,
        _masked_note(capture.names, masks, sizes, seen),
        "transparent photos are composited on a background (train.background)" if train.photos.transparent else "",
        file_note([train.photos.stored, tested.photos.stored], "photos"),
    )
    loaded.notes = tuple(filter(None, notes))
    return loaded


def unseeing_note(scene: Scene) -> str:
    """A line on cameras that see none of the points, which no error tells; empty where each sees one."""
    points, blind = scene.points.cpu().numpy(), []
    for views in () if scene.drawn_points else (scene.train, scene.test):
        viewmats, Ks = views.cameras.viewmats.cpu().numpy(), views.cameras.Ks.cpu().numpy()
        for name, viewmat, K, size in zip(views.names, viewmats, Ks, views.cameras.sizes, strict=True):
            if not any(len(seen(points[::step], viewmat, K, size)[0]) for step in (256, 16, 1)):  # some, or all
                blind.append(name)
    return f"{len(blind)} cameras see none of the points: {', '.join(blind[:3])}" if blind else ""


def _posed(
    capture: Capture, frame: Frame, masks: list[PixelMasks | None], views: np.ndarray, sizes: np.ndarray
) -> PosedImages:
    """Some views with cameras for photos of these sizes, masks and what the photos show; photos without pixels."""
    ratios = sizes / capture.sizes[views]
    intrinsics = capture.Ks[views]
    intrinsics[:, :2] *= ratios[:, :, None]
    viewmats = torch.from_numpy(frame.normalise_poses(capture.viewmats[views])).float()
    cameras = Cameras(viewmats, torch.from_numpy(intrinsics).float(), sizes)
    shown = None if capture.observations is None else capture.observations.of_views(views, ratios)
    own, masked = [masks[view] for view in views], None
    if any(mask is not None for mask in own):
        pairs = zip(own, sizes[:, ::-1].tolist(), strict=True)  # (height, width)
        masked = PixelMasks.joined([mask or PixelMasks.of(np.ones(size, dtype=bool)) for mask, size in pairs])
    photos = Photos(torch.empty(0, 3, dtype=torch.uint8), sizes)
    return PosedImages(cameras, tuple(capture.names[view] for view in views), photos, masked, shown)


def _test_views(scene: Path, capture: Capture, test_every: int) -> np.ndarray:
    """[V] bool: the test views, by the capture's own split or by order; enough views remain to train on."""
    views = len(capture.names)
    test = np.arange(views) % test_every == 0 if capture.test is None else capture.test
    count, kind = (views, "images") if capture.test is None else ((~test).sum(), "training images")
    if count < FEWEST_PHOTOS:
        raise InputError(f"{scene} has {count} {kind}: at least {FEWEST_PHOTOS} are needed; add photos to it")
    if test.all():
        raise InputError(f"test_every is {test_every}: every image of {scene} would be a test image; use 2 or more")
    return test


def _masked_note(names: tuple[str, ...], masks: list[PixelMasks | None], sizes: np.ndarray, seen: np.ndarray) -> str:
    """One line on masked pixels and on views left out for them; empty where nothing is masked."""
    pixels = {view: int(mask.pixel_counts[0]) for view, mask in enumerate(masks) if mask is not None}
    if not pixels:
        return ""
    share = 1.0 - sum(pixels.values()) / int(sizes[list(pixels)].prod(axis=1).sum())
    left_out = f"; {(~seen).sum()} masked whole are left out: {names[seen.argmin()]}, ..." if not seen.all() else ""
    return f"{len(pixels)} photos have masked pixels, {share:.1%} of them{left_out}"


def _find_photos(scene: Path, capture: Capture, factor: int) -> tuple[list[Path], np.ndarray, np.ndarray, str]:
    """The files of V photos, reduced by `factor`: copies in ``images_<factor>`` where all are there in the right size,
    else the capture's photos. Photos of ``images_4`` that are smaller than their cameras by that are reduced already.
    And [V, 2] int64 (width, height) of the files; [V, 2] int64 to give them, undistorted and reduced; a note on photos
    of another size than their cameras."""
    cameras, bent = capture.photo_sizes, np.array([lens is not None for lens in capture.lenses])
    copies = capture.photo_folder.with_name(f"{capture.photo_folder.name}_{factor}")
    paths = [copies / name for name in capture.names]
    # Photos of lenses are undistorted in full size.
    if factor > 1 and capture.photo_folder != scene and not bent.any() and all(map(Path.is_file, paths)):
        sizes = photo_sizes(paths)
        if (np.abs(sizes - cameras / factor) <= 1.0).all():
            return paths, sizes, sizes, ""
    paths = [capture.photo_folder / name for name in capture.names]
    sizes, note = photo_sizes(paths), ""
    other = (np.abs(cameras * (sizes / cameras)[:, ::-1] - sizes) > 1.0).all(axis=1)
    small = bent & (cameras.prod(axis=1) > np.maximum(ALWAYS_PIXELS, LENS_PIXELS * sizes.prod(axis=1)))
    for wrong in (other, small, (sizes != cameras).any(axis=1)):
        if not wrong.any():
            continue
        path, remedy = paths[wrong.argmax()], "use the photos that the cameras were reconstructed from"
        size, camera = ("x".join(map(str, both[wrong.argmax()].tolist())) for both in (sizes, cameras))
        if wrong is other:
            cause = "it was cropped or turned (an EXIF orientation is not followed), not scaled"
            raise InputError(f"photo {path} is {size} but its camera is {camera}: {cause}; {remedy}")
        if wrong is small:
            raise InputError(f"photo {path} is {size}, too small to be undistorted by a camera of {camera}: {remedy}")
        note = f"{wrong.sum()} photos in another size than their cameras: intrinsics rescaled from {camera} to {size}"
    reduction = re.fullmatch(rf"{IMAGES}_(\d+)", capture.photo_folder.name)
    already = int(reduction[1]) if reduction and cameras[0, 0] > 1.5 * sizes[0, 0] else 1
    # Images of lenses are smaller for smaller photos, never larger.
    undistorted = np.floor(capture.sizes * (sizes / cameras).clip(max=1.0) + 0.5).astype(np.int64).clip(min=1)
    return paths, sizes, reduced_sizes(np.where(bent[:, None], undistorted, sizes), max(1.0, factor / already)), note


def read_capture(scene: Path) -> Capture:
    """The capture in a folder, of the first kind that can be read, in the order that `load_scene` states. Notes say
    which other kinds are not used, and why where they come before. Raises `InputError` where the folder is no capture,
    with what to do; or no kind can be read: what the first lacks."""
    if not scene.is_dir():
        trouble = f"{scene} is a file" if scene.is_file() else f"{scene} does not exist"
        raise InputError(f"no such scene: {unread(scene) or f'{trouble}: give the folder of a capture, or of photos'}")
    kinds, failed = _kinds(scene), []
    for place, (_, read) in enumerate(kinds):
        try:
            capture = read()
        except InputError as error:
            failed.append(error)
            continue
        splits = (name for name in SPLITS if (scene / name).is_file() and name not in capture.notes[0])
        unused = ", ".join([*(name for name, _ in kinds[place + 1 :]), *splits])
        notes = [*([f"{unused} not used"] if unused else []), *(f"not used: {error}" for error in failed)]
        return replace(capture, notes=(*capture.notes, *notes))
    photos = find_photos(scene)[1]
    if where := "" if failed and photos else _elsewhere(scene):
        raise InputError(where)
    if failed:
        raise failed[0]
    if inner := _captures_in(scene):
        raise InputError(f"{scene} is no capture, but has {len(inner)} in it: give {' or '.join(map(str, inner[:3]))}")
    poses, call = other_poses(scene), f"turbogs reconstruct {shlex.quote(str(scene))} --out SCENE"
    if photos:
        known = f"{poses}; or" if poses else "nothing that says where they were taken from:"
        raise InputError(f"{scene} has {len(photos)} photos and {known} find the cameras, then use SCENE:  {call}")
    raise InputError(
        f"{scene} has neither a COLMAP reconstruction (cameras, images and points3D as .bin or .txt in sparse/0) nor a "
        f"{', a '.join(READERS)}, nor photos; "
        + (poses or unread(scene, every=True) or "give the folder of a capture, or of photos")
    )


def _kinds(scene: Path) -> list[tuple[str, Callable[[], Capture]]]:
    """Files or folders of cameras in a folder, in the order in which they are taken: names and readers."""
    model = find_model(scene)
    colmap = [] if model is None else [(str(model[0]), partial(read_colmap, scene, *model))]
    return [*colmap, *((name, partial(read, scene)) for name, read in READERS.items() if (scene / name).is_file())]


def holds_photos_alone(scene: Path) -> bool:
    """True where a folder has photos and nothing that says where they were taken from, neither in it nor around it."""
    if not scene.is_dir() or _kinds(scene) or _elsewhere(scene):
        return False
    inner = set(_captures_in(scene))
    return any(inner.isdisjoint(photo.parents) for photo in find_photos(scene)[1])


def run_folder(folder: Path) -> str:
    """A line where a folder is a run's; empty where it is none."""
    if (folder / "config.yaml").is_file() and any((folder / part).exists() for part in PARTS_OF_RUN):
        return f"{folder} is a run's folder: give the capture that it was trained on, which its config.yaml names"
    return ""


def _elsewhere(folder: Path) -> str:
    """A line where a folder is a run's, or lies in a capture; empty where it is and does neither."""
    at = folder.absolute()
    tops = [top for top in at.parents[:3] for name in MODEL_FOLDERS[:-1] if top / name in (at, at.parent)]
    around = (tops or [at.parent])[-1]  # of the folder of a model or of photos
    known = _kinds(around) and (find_photos(around)[1] or not _kinds(folder))
    return run_folder(folder) or (f"{folder} lies in the capture {around}: give that folder" if known else "")


def _captures_in(folder: Path) -> list[Path]:
    """Captures with their photos that lie in a folder."""
    inner = (place for place in sorted(folder.glob("[!.]*")) if place.is_dir() and os.access(place, os.R_OK | os.X_OK))
    return [place for place in inner if _kinds(place) and find_photos(place)[1]]


def other_poses(folder: Path) -> str:
    """A line on a file of another program's cameras in a folder, or in the one that its ``images`` are of; or empty."""
    for place in (folder, folder.absolute().parent) if folder.absolute().name == IMAGES else (folder,):
        for at, (source, forms) in product(("", "*/"), OTHER_POSES.items()):
            for file in (file for form in forms.split() for file in place.glob(at + form)):
                return f"{file} is not read, which may have cameras of {source}"
    return ""
