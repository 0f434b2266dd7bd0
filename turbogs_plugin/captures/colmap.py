"""COLMAP reconstructions: which one of a folder is read, and what becomes of it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from turbogs_plugin.captures import colmap_files
from turbogs_plugin.captures.capture import FEWEST_PHOTOS, Capture, named, text_of
from turbogs_plugin.captures.colmap_files import CLOUD, FILES, ColmapModel, ModelImage, read_model
from turbogs_plugin.captures.photo_files import IMAGES, find_named
from turbogs_plugin.captures.starting_points import clouds_beside
from turbogs_plugin.captures.undistort import Lens, pinhole_of_camera
from turbogs_plugin.errors import InputError
from turbogs_plugin.types.cameras import Observations

if TYPE_CHECKING:
    import pycolmap

MODEL_FOLDERS = ("sparse", "colmap/sparse", "colmap", "colmap_sparse", "colmap_text", ".")
"""Folders of a scene's reconstructions, in order of preference; or numbered folders in them."""
TEST = "test.txt"


def find_model(scene: Path) -> tuple[Path, str] | None:
    """The scene's reconstruction and its suffix, '.bin' or '.txt'; None where there is none.

    Of the several that COLMAP writes where photos did not connect (``sparse/0``, ``sparse/1``, ...), the one with the
    largest file of images is taken. One that lacks files is taken where no other one is whole: `read_model` names them.
    """
    for needed in (FILES, FILES[:1], FILES[1:2]):
        for name in MODEL_FOLDERS:
            if models := _models_in(scene / name, needed):
                sizes = [sum(file.stat().st_size for file in place.glob(f"images{end}")) for place, end in models]
                return models[sizes.index(max(sizes))]
    return None


def _models_in(place: Path, needed: Sequence[str]) -> list[tuple[Path, str]]:
    """The reconstructions in ``place/0``, ``place/1``, ... in order of their numbers, and in `place`: folders and
    suffixes. `needed` are the files that they have."""
    folders = [folder for folder in place.glob("[0-9]*") if re.fullmatch("[0-9]{1,9}", folder.name)]
    folders = [*sorted(folders, key=lambda folder: (int(folder.name), folder.name)), place]
    pairs = [(folder, suffix) for folder in folders for suffix in colmap_files.SUFFIXES]
    return [(folder, suffix) for folder, suffix in pairs if all((folder / f"{f}{suffix}").is_file() for f in needed)]


def read_colmap(scene: Path, folder: Path, suffix: str) -> Capture:
    """Read a reconstruction that `find_model` has found, without images whose photo does not exist (`find_named`).
    Raises `InputError` for files that are damaged or inconsistent, a camera that no pinhole can take the place of, or
    fewer than `FEWEST_PHOTOS` photos."""
    model = read_model(folder, suffix)
    found = find_named(scene, [image.name for image in model.images], folder, (IMAGES, ""))
    if not (images := [model.images[place] for place in found.places]):
        raise InputError(f"{folder} has no images with a pose: reconstruct the capture again")
    ids = {image.camera for image in images}
    pinholes = {id: pinhole_of_camera(model.cameras[id], f"camera {id} of {folder}") for id in ids}
    Ks, sizes, lenses = zip(*(pinholes[image.camera] for image in images), strict=True)
    where = "" if found.folder == scene / IMAGES else f", photos in {found.folder}"
    mixed = any(not (folder / f"{file}{suffix}").is_file() for file in FILES[:2])
    kind = "binary and text" if mixed else "binary" if suffix == ".bin" else "text"
    cloud = folder / CLOUD if len(model.points) and model.points["id"][0] >= colmap_files.FIRST_OF_CLOUD else None
    of_points = f" of {CLOUD}" if cloud else "" if any(folder.glob(f"{FILES[2]}.*")) else f" (there is no {FILES[2]})"
    test, split = _own_split(scene, folder, found.names)
    beside = [other for other, _ in _models_in(folder.parent, FILES)]
    unused = named([other.name for other in beside if other != folder])
    choice = f"{len(beside)} reconstructions in {folder.parent}: {folder.name} is taken, the largest; {unused} not used"
    return Capture(
        names=found.names,
        photo_folder=found.folder,
        viewmats=np.array([image.viewmat for image in images]),
        Ks=np.array(Ks),
        sizes=np.array(sizes),
        points=model.points["xyz"].copy(),
        point_colors=model.points["color"].copy(),
        lenses=lenses,
        mask_files=(None,) * len(images),
        notes=(
            f"COLMAP reconstruction {folder} ({kind}): {len(images)} images, {len(model.points):,} points"
            f"{of_points}{where}{split}",
            *([choice] if folder in beside and unused else []),
            *found.notes,
            *clouds_beside([folder, scene], cloud, f"{CLOUD} is, in a model without points3D"),
            *filter(None, [model.doubt]),
        ),
        test=test,
        alpha="mask",
        doubt=model.doubt,
        observations=_observations(model, images, lenses) if len(model.points) else None,
    ).checked(folder)


def _own_split(scene: Path, folder: Path, names: Sequence[str]) -> tuple[np.ndarray | None, str]:
    """[V] bool: the photos that a ``test.txt`` lists, a name a line with suffix or without (Inria's), and words; None
    where there is none, or where it leaves too few for training."""
    file = next((place / TEST for place in (folder, folder.parent, scene) if (place / TEST).is_file()), None)
    if file is None:
        return None, ""
    listed = {line.strip().removeprefix(f"{IMAGES}/") for line in text_of(file).split("\n")}
    test = np.array([not listed.isdisjoint({name, str(Path(name).with_suffix(""))}) for name in names])
    if test.any() and (~test).sum() >= FEWEST_PHOTOS:
        return test, f", by {file.name} {(~test).sum()} for training, {test.sum()} for testing"
    return None, f", {file} not used: {test.sum()} of its names have a photo"


def _observations(model: ColmapModel, images: Sequence[ModelImage], lenses: Sequence[Lens | None]) -> Observations:
    """Places where images, the views, show points that are there, in pixels of their pinhole cameras. `lenses`: one an
    image, None for a pinhole."""
    ids, parts = model.points["id"].copy(), []  # not strided: else each search would copy them
    for view, (image, lens) in enumerate(zip(images, lenses, strict=True)):
        shown = image.features[image.features["point"] != colmap_files.NO_POINT]
        points = np.searchsorted(ids, shown["point"])
        pixels = shown["pixel"].astype(np.float64)
        if lens is not None and len(pixels):
            pixels = model.cameras[image.camera].cam_from_img(pixels) * lens.K[[0, 1], [0, 1]] + lens.K[:2, 2]
        known = np.isfinite(pixels).all(axis=1) & (ids[points.clip(max=len(ids) - 1)] == shown["point"])
        parts.append((pixels[known], np.full(known.sum(), view), points[known]))
    return Observations(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def write_whole(reconstruction: pycolmap.Reconstruction, folder: Path, called: Path) -> None:
    """Write the binary files of a reconstruction, and see that they are whole: of a full disk pycolmap says nothing.
    Raises `InputError` where they are not; `called` is the folder's name in its line."""
    try:
        reconstruction.write_binary(folder)
        read_model(folder, ".bin")
    except (RuntimeError, ValueError) as error:
        raise InputError(f"'{called}' cannot be written whole: make room there, or choose another place") from error
