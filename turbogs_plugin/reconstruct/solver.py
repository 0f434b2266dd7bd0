"""Steps of a reconstruction, each by pycolmap: features, matches, cameras, and how matches agree with cameras."""

from __future__ import annotations

import shutil
import sys
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
import torch

from turbogs_plugin.captures.matches import EPIPOLAR_SHARE, epipolar_distances
from turbogs_plugin.captures.undistort import load_pycolmap
from turbogs_plugin.reconstruct.ghosts import Agreement
from turbogs_plugin.reconstruct.photos import PhotoFile

if TYPE_CHECKING:
    import pycolmap

LONG_SIDE = 1600
"""Longer side to which larger photos are reduced for their features, px; features stay in pixels of the whole photo."""
MANY, DEFAULT_MODEL = 10, "SIMPLE_RADIAL"
"""A lens with at least this many photos gets COLMAP's OPENCV model (two radial and two tangential coefficients), other
lenses its default, one radial coefficient. On fox OPENCV halves the error of the cameras."""
GROWTH, TOLERANCE, REFINEMENTS = 1.3, 1e-4, 1
"""Growth of a model after which all its cameras and points are adjusted; relative gain at which an adjustment ends;
adjustments of what is near a new photo. COLMAP's 1.1, 0 and 2 take twice as long in all, for the same cameras."""
BLOCK = 128
"""Pairs that are matched, verified and written together: a stop loses no more than these."""


def extract_features(database: Path, images: Path, photos: Sequence[PhotoFile], doubled: bool) -> None:
    """SIFT features of all photos into the database, one camera for each lens; `doubled` at twice the size, too, as
    COLMAP does by default: two to three times as many in three times the time. A database that has all photos stays;
    another one, of a call that was stopped, is made anew."""
    pycolmap = _pycolmap()
    if database.is_file():
        with pycolmap.Database.open(database) as opened:
            if opened.num_images() == len(photos):
                return
        database.unlink()
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size, options.num_threads = LONG_SIDE, torch.get_num_threads()
    options.sift.first_octave = -1 if doubled else 0
    lenses: dict[str, list[str]] = defaultdict(list)
    for photo in photos:
        lenses[photo.lens].append(photo.name)
    for names in lenses.values():
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = "OPENCV" if len(names) >= MANY else DEFAULT_MODEL
        pycolmap.extract_features(database, images, names, pycolmap.CameraMode.SINGLE, reader, options)
    _tell(f"features of {len(photos)} photos")


def match_features(database: Path, scratch: Path, pairs: Sequence[tuple[str, str]]) -> None:
    """Match and verify pairs of photos' names, which a file in `scratch` lists; pairs that are done already are passed
    over."""
    pycolmap = _pycolmap()
    options, geometry = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    options.num_threads, geometry.ransac.random_seed = torch.get_num_threads(), 0
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path, pairing.block_size = scratch / "pairs.txt", BLOCK
    pairing.match_list_path.write_text("".join(f"{first} {second}\n" for first, second in pairs), encoding="utf-8")
    pycolmap.match_image_pairs(database, options, pairing, geometry)
    _tell(f"{len(pairs):,} pairs of photos matched")


def solve_cameras(database: Path, images: Path, scratch: Path) -> list[pycolmap.Reconstruction]:
    """Models by COLMAP's incremental mapping from one seed, the one with most photos first."""
    pycolmap = _pycolmap()
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = torch.get_num_threads(), 0
    options.ba_global_frames_ratio = options.ba_global_points_ratio = GROWTH
    options.ba_global_function_tolerance = options.ba_local_function_tolerance = TOLERANCE
    options.ba_local_max_refinements = REFINEMENTS
    place = scratch / "models"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    models = pycolmap.incremental_mapping(database, images, place, options)
    _tell("cameras solved")
    return sorted(models.values(), key=lambda model: -model.num_reg_images())


def measure_agreement(model: pycolmap.Reconstruction, database: Path) -> Agreement:
    """How the verified matches of all pairs of registered photos agree with the cameras of a model."""
    pycolmap = _pycolmap()
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    index = {image.name: view for view, image in enumerate(images)}
    viewmats = np.tile(np.eye(4), (len(images), 1, 1))  # [V, 4, 4]
    rays, limits, counts = [], [], []
    with pycolmap.Database.open(database) as opened:
        views = {image.image_id: index[image.name] for image in opened.read_all_images() if image.name in index}
        numbers = {view: number for number, view in views.items()}
        for view, image in enumerate(images):
            camera = model.cameras[image.camera_id]
            viewmats[view, :3] = image.cam_from_world().matrix()
            keypoints = opened.read_keypoints(numbers[view])[:, :2].astype(np.float64)
            plane = np.array(camera.cam_from_img(keypoints)).reshape(-1, 2)  # NaN where the camera has no ray
            rays.append(np.concatenate([plane, np.ones((len(plane), 1))], axis=1))  # [N, 3]
            limits.append(EPIPOLAR_SHARE * max(camera.width, camera.height) / camera.mean_focal_length())
        for number, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            first, second = (views.get(identifier) for identifier in pycolmap.pair_id_to_image_pair(number))
            matches = geometry.inlier_matches
            if first is None or second is None or not len(matches):
                continue
            distances = epipolar_distances(
                viewmats[second] @ np.linalg.inv(viewmats[first]),
                rays[first][matches[:, 0]],
                rays[second][matches[:, 1]],
            )
            agree = int((distances <= max(limits[first], limits[second])).sum())
            counts.append((min(first, second), max(first, second), agree, len(matches) - agree))
    table = np.array(counts, dtype=np.int64).reshape(-1, 4)
    return Agreement(tuple(image.name for image in images), table[:, :2], table[:, 2], table[:, 3])


def without_pairs(database: Path, copy: Path, pairs: Sequence[tuple[str, str]]) -> None:
    """Copy a database, but for the verified matches of these pairs of photos."""
    shutil.copyfile(database, copy)
    with _pycolmap().Database.open(copy) as opened:
        numbers = {image.name: image.image_id for image in opened.read_all_images()}
        for first, second in pairs:
            opened.delete_two_view_geometry(numbers[first], numbers[second])


def read_positions(database: Path, names: Sequence[str]) -> np.ndarray:
    """[V, 2] degrees of latitude and longitude by the photos' GPS; NaN where a photo has none."""
    pycolmap = _pycolmap()
    positions = np.full((len(names), 2), np.nan)
    with pycolmap.Database.open(database) as opened:
        names_of = {image.image_id: image.name for image in opened.read_all_images()}
        for prior in opened.read_all_pose_priors():
            name, place = names_of.get(prior.corr_data_id.id), prior.position[:2]
            # (0, 0) is what devices without a fix write.
            if name in names and prior.coordinate_system == pycolmap.PosePriorCoordinateSystem.WGS84 and place.any():
                positions[names.index(name)] = place
    return positions


def _pycolmap() -> ModuleType:
    """The module, silent and seeded."""
    module = load_pycolmap()
    module.logging.minloglevel = module.logging.FATAL.value
    module.set_random_seed(0)
    return module


def _tell(step: str) -> None:
    """Say on stderr which step has ended."""
    print(step, file=sys.stderr, flush=True)
