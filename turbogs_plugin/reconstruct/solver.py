"""The steps of a reconstruction, each by pycolmap: features, matches, cameras, and how matches agree with cameras."""

from __future__ import annotations

import errno
import shutil
import sqlite3
from collections import defaultdict
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
import torch

from turbogs_plugin.captures.colmap import load_pycolmap
from turbogs_plugin.errors import InputError
from turbogs_plugin.reconstruct.agreement import Agreement
from turbogs_plugin.reconstruct.effort import Effort
from turbogs_plugin.reconstruct.matching import Matching
from turbogs_plugin.reconstruct.photos import PhotoFile
from turbogs_plugin.reconstruct.watch import row_counter, watched

if TYPE_CHECKING:
    import pycolmap

MANY, DEFAULT_MODEL = 10, "SIMPLE_RADIAL"
"""A lens with so many photos gets COLMAP's OPENCV model (two radial and two tangential coefficients), others its
default, one radial coefficient. On fox OPENCV halves the error of the cameras."""
EPIPOLAR_SHARE = 3e-3
"""A match agrees with two cameras that are nearer to its epipolar line than this share of the photos' longer side."""
GROWTH, TOLERANCE, REFINEMENTS = 1.3, 1e-4, 1
"""All cameras and points are adjusted whenever a model has grown by so much; an adjustment ends when it gains less than
this share; and what is near a new photo is adjusted so many times. COLMAP's 1.1, 0 and 2 take twice as long in all, for
the same cameras (docs/captures.md)."""
BLOCK = 128
"""Pairs that are matched, verified and written together: a stop waits for them."""
BYTES_OF_A_PHOTO, BYTES_OF_A_JOURNAL = 1_200_000, 5_000_000
"""Of a database, at most, and of what SQLite writes beside it. Measured: on fox, caliterra and snowmiku .2 to .6 MB a
photo, and .6 to 1.2 MB with features at twice the size; 4.4 MB of journal, on rendered photos."""
FEATURES_OF_A_PHOTO = 1000
FEATURES_OF_A_WORD = 40
MOST_WORDS = 16384
"""Of each photo, so many features are taken; the vocabulary for likeness has a word for so many of them."""
EMBEDDING = 64
"""Dimensions of COLMAP's own vocabularies for SIFT."""


def extract_features(database: Path, images: Path, photos: Sequence[PhotoFile], effort: Effort) -> None:
    """SIFT features of all photos into the database, one camera for each lens; photos that have them are left alone.

    Raises:
        InputError: the database is damaged.
        OSError: there is no room for it: on a full disk pycolmap ends the process.
    """
    _require_room(database, len(photos))
    _require_whole(database)
    pycolmap = _pycolmap()
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size, options.num_threads = effort.long_side, torch.get_num_threads()
    options.sift.first_octave = -1 if effort.doubled else 0
    lenses: dict[str, list[str]] = defaultdict(list)
    for photo in photos:
        lenses[photo.lens].append(photo.name)

    def step(token: pycolmap.CancellationToken) -> None:
        for names in lenses.values():
            if token.is_cancelled:
                return
            reader = pycolmap.ImageReaderOptions()
            reader.camera_model = "OPENCV" if len(names) >= MANY and not effort.default_cameras else DEFAULT_MODEL
            known = _cameras(database, names)
            if known:  # of an earlier call that was stopped
                reader.existing_camera_id = known[0]
            pycolmap.extract_features(
                database,
                images,
                image_names=names,
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=options,
                cancellation_token=token,
            )

    watched("features of photos", len(photos), row_counter(database, "descriptors"), step)


def match_features(database: Path, scratch: Path, names: Sequence[str], matching: Matching) -> None:
    """Match and verify pairs of photos; pairs that are done already are passed over.

    Args:
        scratch: a folder for the list of pairs and the vocabulary.
        names: of the photos that the pairs count.
    """
    pycolmap = _pycolmap()
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = torch.get_num_threads()
    geometry = pycolmap.TwoViewGeometryOptions()
    geometry.ransac.random_seed = 0
    pairs = [(names[first], names[second]) for first, second in matching.pairs.tolist()]
    likeness = pycolmap.VocabTreePairingOptions()

    def step(token: pycolmap.CancellationToken) -> None:
        if pairs:
            listed = scratch / "pairs.txt"
            listed.write_text("".join(f"{first} {second}\n" for first, second in pairs), encoding="utf-8")
            pairing = pycolmap.ImportedPairingOptions()
            pairing.match_list_path, pairing.block_size = listed, BLOCK
            pycolmap.match_image_pairs(database, options, pairing, geometry, cancellation_token=token)
        if matching.similar and not token.is_cancelled:
            likeness.vocab_tree_path = _build_vocabulary(database, scratch / "words.bin")
            likeness.num_images, likeness.num_threads = matching.similar + 1, options.num_threads
            pycolmap.match_vocabtree(database, options, likeness, geometry, cancellation_token=token)

    total = None if matching.similar else len(pairs)
    watched("pairs of photos matched", total, row_counter(database, "two_view_geometries"), step)


def solve_cameras(database: Path, images: Path, scratch: Path, again: str = "") -> list[pycolmap.Reconstruction]:
    """COLMAP's incremental mapping from one seed: the models, that with most photos first.

    Args:
        again: for the line of progress, where it is not the first solve: what is different.
    """
    pycolmap = _pycolmap()
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = torch.get_num_threads(), 0
    options.ba_global_frames_ratio = options.ba_global_points_ratio = GROWTH
    options.ba_global_function_tolerance = options.ba_local_function_tolerance = TOLERANCE
    options.ba_local_max_refinements = REFINEMENTS
    place = scratch / "models"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    registered = 0

    def begin() -> None:  # a model, or another attempt at one
        nonlocal registered
        registered = 2

    def count() -> None:
        nonlocal registered
        registered += 1

    def step(token: pycolmap.CancellationToken) -> list[pycolmap.Reconstruction]:
        nonlocal registered
        models = pycolmap.incremental_mapping(
            database,
            images,
            place,
            options,
            initial_image_pair_callback=begin,
            next_image_callback=count,
            cancellation_token=token,
        )
        ordered = sorted(models.values(), key=lambda model: -model.num_reg_images())
        registered = ordered[0].num_reg_images() if ordered else 0
        return ordered

    total = row_counter(database, "images")()
    return watched(f"cameras solved{again}", total, lambda: registered, step)


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
            rays.append(_rays(camera, opened.read_keypoints(numbers[view])[:, :2]))
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


def epipolar_distances(relative: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """[N] Sampson distances of matches from the epipolar lines of two cameras, at a focal length of 1.

    Cameras in one place have no lines: there, nothing is far.

    Args:
        relative: [4, 4], from the first camera to the second.
        first, second: [N, 3], the matches on the cameras' image planes, z = 1.
    """
    rotation, translation = relative[:3, :3], relative[:3, 3]
    length = np.linalg.norm(translation)
    if length == 0:
        return np.zeros(len(first))
    essential = np.cross(np.eye(3), translation / length).T @ rotation
    lines, back = first @ essential.T, second @ essential
    size = np.sqrt((lines[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1))
    return np.abs((second * lines).sum(axis=1)) / np.maximum(size, 1e-12)


def with_default_cameras(database: Path, copy: Path) -> None:
    """A copy of a database in which all lenses have COLMAP's default model, not solved yet."""
    pycolmap = _pycolmap()
    shutil.copyfile(database, copy)
    with pycolmap.Database.open(copy) as opened:
        for camera in opened.read_all_cameras():
            given = camera.camera_id, DEFAULT_MODEL, camera.mean_focal_length(), camera.width, camera.height
            plain = pycolmap.Camera.create_from_model_name(*given)
            plain.has_prior_focal_length = camera.has_prior_focal_length
            opened.update_camera(plain)


def without_pairs(database: Path, copy: Path, pairs: Sequence[tuple[str, str]]) -> None:
    """A copy of a database in which these pairs of photos have no verified matches."""
    pycolmap = _pycolmap()
    shutil.copyfile(database, copy)
    with pycolmap.Database.open(copy) as opened:
        numbers = {image.name: image.image_id for image in opened.read_all_images()}
        for first, second in pairs:
            opened.delete_two_view_geometry(numbers[first], numbers[second])


def read_names(database: Path) -> set[str]:
    """Of the photos that have features."""
    with _pycolmap().Database.open(database) as opened:
        images = opened.read_all_images()
        return {image.name for image in images if opened.num_keypoints_for_image(image.image_id)}


def count_verified_pairs(database: Path) -> int:
    """Pairs of photos with matches that one geometry explains."""
    with _pycolmap().Database.open(database) as opened:
        _, inliers = opened.read_two_view_geometry_num_inliers()
    return int((np.array(inliers) > 0).sum())


def _pycolmap() -> ModuleType:
    """The module, silent and seeded."""
    module = load_pycolmap()
    module.logging.minloglevel = module.logging.FATAL.value
    module.set_random_seed(0)
    return module


def _require_whole(database: Path) -> None:
    """Raise `InputError` where an earlier call left a damaged database."""
    if not database.exists():
        return
    try:
        with closing(sqlite3.connect(database)) as connection:
            whole = connection.execute("PRAGMA quick_check(1)").fetchall() == [("ok",)]
    except sqlite3.DatabaseError:
        whole = False
    if not whole:
        raise InputError(f"'{database}' is damaged: delete it and call again, which makes it anew")


def _require_room(database: Path, photos: int) -> None:
    """Raise `OSError` where the disk has no room for the features and matches of so many photos."""
    made = sum(file.stat().st_size for file in database.parent.glob(f"{database.name}*"))
    needed, free = photos * BYTES_OF_A_PHOTO + BYTES_OF_A_JOURNAL - made, shutil.disk_usage(database.parent).free
    if free < needed:
        said = f"features and matches of {photos} photos need {needed / 1e6:.0f} MB, and {free / 1e6:.0f} are free"
        raise OSError(errno.ENOSPC, said, str(database))


def _cameras(database: Path, names: Sequence[str]) -> list[int]:
    """The cameras that these photos have already."""
    if not database.is_file():
        return []
    with _pycolmap().Database.open(database) as opened:
        wanted = set(names)
        return sorted({image.camera_id for image in opened.read_all_images() if image.name in wanted})


def _rays(camera: pycolmap.Camera, keypoints: np.ndarray) -> np.ndarray:
    """[N, 3] of [N, 2] pixels; NaN where the camera has none."""
    plane = np.array(camera.cam_from_img(keypoints.astype(np.float64))).reshape(-1, 2)
    return np.concatenate([plane, np.ones((len(plane), 1))], axis=1)


def _build_vocabulary(database: Path, path: Path) -> Path:
    """COLMAP's index of likeness, whose words are learnt from these very photos: nothing is downloaded."""
    pycolmap = _pycolmap()
    generator = np.random.default_rng(0)
    samples = []
    with pycolmap.Database.open(database) as opened:
        for image in sorted(opened.read_all_images(), key=lambda image: image.name):
            features = opened.read_descriptors(image.image_id).to_float().data
            samples.append(features[generator.permutation(len(features))[:FEATURES_OF_A_PHOTO]])
    features = np.concatenate(samples).astype(np.float32)
    options = pycolmap.VisualIndex.BuildOptions()
    options.num_visual_words = int(np.clip(len(features) // FEATURES_OF_A_WORD, 64, MOST_WORDS))
    options.num_threads, options.num_iterations, options.num_rounds = torch.get_num_threads(), 10, 1
    index = pycolmap.VisualIndex.create(features.shape[1], EMBEDDING)
    index.build(options, pycolmap.FeatureDescriptorsFloat(pycolmap.FeatureExtractorType.SIFT, features))
    index.write(path)
    return path
