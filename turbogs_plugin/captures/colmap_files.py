"""COLMAP's cameras, images, points3D, rigs and frames files, binary or text.

pycolmap makes an object of every feature, of which captures have millions (caliterra: .6 s, here .03 s), trusts a count
of 2^60 in a damaged file, and refuses 10 of the 13 texts of scripts that the tests have, and reconstructions of which a
script took a part out. So the records are read here: no count allocates more than its file holds.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from turbogs_plugin.captures.capture import bytes_of, text_of
from turbogs_plugin.captures.starting_points import read_cloud
from turbogs_plugin.captures.undistort import load_pycolmap
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.ply import read_colors

if TYPE_CHECKING:
    import pycolmap

FILES, SUFFIXES = ("cameras", "images", "points3D"), (".bin", ".txt")
CLOUD = "points3D.ply"  # a cloud that stands for the points where a model has none of COLMAP's (InstantSplat)
FIRST_OF_CLOUD = np.uint64(2**63)  # first identifier of its points, which no feature names
FEATURE = np.dtype([("pixel", "<f8", 2), ("point", "<u8")])
"""A place in an image, and the identifier of the point that it shows, or `NO_POINT`."""
POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("color", "u1", 3)])
"""A point. In a file its error (float64) and its track follow: a uint64 count, and 8 bytes for each element."""
NO_POINT = np.uint64(2**64 - 1)
SENSORS = {"CAMERA": 0, "IMU": 1}  # kinds of sensors of a rig
NUMBER = re.compile(r"[-+.\de]+|[-+]?(nan|inf)", re.IGNORECASE)
NAME = re.compile(r"\s*(?:\S+\s+){8}\S+[ \t](.+)")  # the line of an image in text: nine numbers and its name


@dataclass
class ModelImage:
    """A photo of a reconstruction."""

    number: int  # COLMAP's identifiers, its own and the camera's
    camera: int
    name: str  # as the file has it, below the folder of the photos
    viewmat: np.ndarray  # [4, 4] float64, world to camera; NaN where the numbers are no pose
    features: np.ndarray  # [n] of `FEATURE`


class ColmapModel(NamedTuple):
    """A reconstruction."""

    cameras: dict[int, pycolmap.Camera]  # by their identifiers
    images: list[ModelImage]  # in the file's order
    points: np.ndarray  # [M] of `POINT`, by their identifiers
    doubt: str  # a line where images' own poses are not those of their frames


def read_model(folder: Path, suffix: str) -> ColmapModel:
    """The reconstruction in a folder, of files with a suffix, or with the other one where a file has that alone. Raises
    `InputError` where a file is damaged, or an image has a camera that is not there; the line names file and place."""
    given = {file: [folder / f"{file}{end}" for end in (suffix, *SUFFIXES)] for file in FILES}
    cameras, images, points = (next(filter(Path.is_file, paths), paths[0]) for paths in given.values())
    points = points if points.is_file() or not (folder / CLOUD).is_file() else folder / CLOUD
    for absent, other in ((cameras, images), (images, cameras)):
        if not absent.is_file():
            remedy = f"bring it back, or take {other.name} away and find the cameras by 'turbogs reconstruct'"
            raise InputError(f"{folder} has no {absent.name}: {remedy}")
    known_cameras = _read_cameras(cameras)
    known_points = _read_points(points) if points.is_file() else np.zeros(0, POINT)
    known_images: dict[int, ModelImage] = {}
    for record in _records(images):
        number, *pose, camera = record.take("I7dI")
        if number in known_images:
            raise _damaged(images, f"two images have the number {number}")
        if camera not in known_cameras:
            raise _damaged(images, f"image {number} has camera {camera}, which {cameras.name} does not have")
        name, features = record.name(), record.features()
        known_images[number] = ModelImage(number, camera, name, _viewmat(np.array(pose)), features)
    doubt = _take_poses_of_frames(known_images, *(folder / f"{file}{images.suffix}" for file in ("rigs", "frames")))
    order = np.argsort(known_points["id"], kind="stable")
    return ColmapModel(known_cameras, [*known_images.values()], known_points[order], doubt)


def _take_poses_of_frames(images: dict[int, ModelImage], rigs: Path, frames: Path) -> str:
    """Give images, by their identifiers, the pose of their frame and their camera's place in the rig, where both files
    are there and have the image (COLMAP 3.12 and later). A line where an image's own pose is another; or empty."""
    if not (rigs.is_file() and frames.is_file()):
        alone = next((file.name for file in (rigs, frames) if file.is_file()), "")
        return f"{alone} is not used: of {rigs.name} and {frames.name} one is missing" if alone else ""
    others = 0
    in_rig: dict[int, dict[tuple[int, int], np.ndarray]] = {}  # of each rig, its sensors' places but the first one's
    for record in _records(rigs):
        rig, count = record.take("II")
        places = in_rig.setdefault(rig, {})
        for position in range(count):
            sensor = record.take("iI")
            if position and record.take("B")[0]:
                places[sensor] = _viewmat(np.array(record.take("7d")))
    for record in _records(frames):
        frame, rig, *pose, count = record.take("II7dI")
        if rig not in in_rig:
            raise _damaged(frames, f"frame {frame} has rig {rig}, which {rigs.name} does not have")
        from_world = _viewmat(np.array(pose))
        for kind, sensor, image in (record.take("iIQ") for _ in range(count)):
            if image in images and kind == SENSORS["CAMERA"]:
                place = in_rig[rig].get((kind, sensor))
                viewmat = from_world if place is None else place @ from_world
                others += not np.allclose(images[image].viewmat, viewmat, 1e-4, 1e-3, equal_nan=True)
                images[image].viewmat = viewmat
    if not others:
        return ""
    remedy = f"take {frames.name} away if a program moved the images alone"
    return f"poses are of {frames.name}, and {others} of images{frames.suffix} are others: {remedy}"


def _viewmat(pose: np.ndarray) -> np.ndarray:
    """[4, 4] float64 of a quaternion of any length and a translation [7]; NaN where they are none."""
    if not np.isfinite(pose).all() or not 1e-6 < np.abs(pose[:4]).max() < 1e6:
        return np.full((4, 4), np.nan)
    pycolmap = load_pycolmap()
    rotation = pycolmap.Rotation3d(np.roll(pose[:4], -1))
    rotation.normalize()
    return np.vstack([pycolmap.Rigid3d(rotation, pose[4:]).matrix(), np.eye(1, 4, 3)])


def _damaged(path: Path, trouble: str) -> InputError:
    return InputError(f"{path} is damaged: {trouble}; copy or reconstruct it again")


class _Text:
    """A text file's records, a line each, whose words are read as `_Binary` reads bytes."""

    def __init__(self, path: Path) -> None:
        self.path, self.lines, self.number = path, text_of(path).split("\n"), 0  # of the line, from 1 on

    def records(self) -> Iterator[_Text]:
        """This reader, at each line that is neither empty nor a comment."""
        while self.number < len(self.lines):
            self.number += 1
            words = self.lines[self.number - 1].split()
            if words and not words[0].startswith("#"):
                self.words = iter(words)
                yield self

    def take(self, layout: str, last: bool = False) -> tuple:
        """The next numbers, by a layout of the struct module. Names of sensors and camera models count as numbers.
        `last`: nothing follows them in their line."""
        codes = (code for count, code in re.findall(r"(\d*)(\D)", layout) for code in code * int(count or 1))
        numbers = tuple([self._number(code) for code in codes])
        if last and (left := next(self.words, None)):
            raise self._damaged(f"has {left[:40]!r} after its last number")
        return numbers

    def _number(self, code: str) -> float:
        word = next(self.words, None)
        if word is None:
            raise self._damaged("ends where a number should follow")
        try:
            if code == "d":
                return float(word)
            if code == "i" and word.isidentifier():
                models = load_pycolmap().CameraModelId.__members__
                return SENSORS[word] if word in SENSORS else int(models[word.upper()])
            number = int(float(word))
            if number != float(word) or (code != "i" and not 0 <= number < 256 ** struct.calcsize(f"<{code}")):
                raise ValueError
            return number
        except (ValueError, OverflowError, KeyError):
            raise self._damaged(f"has {word[:40]!r} where a number should be") from None

    def name(self) -> str:
        """The rest of an image's line, with its spaces. It need not be UTF-8."""
        if named := NAME.fullmatch(self.lines[self.number - 1].rstrip()):
            return named[1]
        raise self._damaged("ends where a name should follow")

    def features(self) -> np.ndarray:
        """[n] of `FEATURE`: the next line. It may be empty, or lack: then there is the next image's, which ends in a
        name or has ten words."""
        words = self.lines[self.number].split() if self.number < len(self.lines) else []
        if len(words) == 10 or (len(words) > 10 and not NUMBER.fullmatch(words[-1])):
            return np.zeros(0, FEATURE)
        self.number += 1
        try:
            numbers = np.array(words, np.float64).reshape(-1, 3)
        except (ValueError, OverflowError):
            bad = next((f" ({word[:40]!r})" for word in words if not NUMBER.fullmatch(word)), "")
            raise self._damaged(f"is not x, y and point of features, again and again{bad}") from None
        features = np.zeros(len(numbers), FEATURE)
        features["pixel"], points = numbers[:, :2], numbers[:, 2]
        known = (points >= 0) & (points < 2**63)
        features["point"] = np.where(known, np.where(known, points, 0).astype(np.uint64), NO_POINT)
        return features

    def _damaged(self, trouble: str) -> InputError:
        return _damaged(self.path, f"line {self.number} {trouble}")


class _Binary:
    """A binary file's records, read from front to end; asking for more than there are bytes raises `InputError`."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.position = path, bytes_of(path), 0

    def records(self) -> Iterator[_Binary]:
        """This reader, at each record that the file announces. Nothing may follow them."""
        for _ in range(self.take("Q")[0]):
            yield self
        if left := len(self.data) - self.position:
            raise _damaged(self.path, f"{left} bytes follow its last record")

    def skip(self, size: int) -> int:
        """Step over `size` bytes and return where they began."""
        start = self.position
        if size > len(self.data) - start:
            raise _damaged(self.path, f"{size} bytes are wanted at byte {start}, the file has {len(self.data)} in all")
        self.position += size
        return start

    def take(self, layout: str, last: bool = False) -> tuple:
        return struct.unpack_from(f"<{layout}", self.data, self.skip(struct.calcsize(f"<{layout}")))

    def name(self) -> str:
        if (end := self.data.find(b"\0", self.position)) < 0:
            raise _damaged(self.path, f"the image name at byte {self.position} has no end")
        start = self.skip(end + 1 - self.position)
        return self.data[start:end].decode(errors="surrogateescape")

    def features(self) -> np.ndarray:
        (count,) = self.take("Q")
        return np.frombuffer(self.data, FEATURE, count, self.skip(count * FEATURE.itemsize))


def _records(path: Path) -> Iterator[_Text] | Iterator[_Binary]:
    return _Text(path).records() if path.suffix == ".txt" else _Binary(path).records()


def _read_cameras(path: Path) -> dict[int, pycolmap.Camera]:
    pycolmap = load_pycolmap()
    models = {int(model): name for name, model in pycolmap.CameraModelId.__members__.items() if int(model) >= 0}
    cameras = {}
    for record in _records(path):
        number, model, width, height = record.take("IiQQ")
        if model not in models:
            raise _damaged(path, f"camera {number} has the unknown model {model}")
        if not (0 < width < 2**31 and 0 < height < 2**31):
            raise _damaged(path, f"camera {number} is {width}x{height} pixels")
        camera = pycolmap.Camera.create_from_model_name(number, models[model], 1.0, width, height)
        camera.params = list(record.take(f"{len(camera.params)}d", last=True))
        cameras[number] = camera
    return cameras


def _read_points(path: Path) -> np.ndarray:
    """[M] of `POINT`. In text, colours may have decimals, as shares of white, too, and errors may lack."""
    if path.suffix == ".bin":
        file, starts, length = _Binary(path), [], struct.Struct("<Q").unpack_from
        for record in file.records():  # in one go, of one number each: captures have millions of them
            starts.append(record.skip(POINT.itemsize + 16))
            record.skip(8 * length(file.data, file.position - 8)[0])
        if not starts:
            return np.zeros(0, POINT)
        rows = np.lib.stride_tricks.sliding_window_view(np.frombuffer(file.data, "u1"), POINT.itemsize)
        return rows[starts].view(POINT)[:, 0]
    if path.suffix == ".txt":
        records = [record.take("Q6d") for record in _records(path)]
        numbers = np.array([number for number, *_ in records], np.uint64)
        values = np.array(records, np.float64).reshape(-1, 7)[:, 1:]
        colors = values[:, 3:]
        if np.isfinite(colors).all() and (colors == np.rint(colors)).all():
            colors = colors.astype(np.int64)
        given = dict(zip(("red", "green", "blue"), colors.T, strict=True))
        xyz, rgb = values[:, :3], read_colors(path, given)
    else:
        xyz, rgb, _ = read_cloud(path)
        numbers = np.arange(len(xyz), dtype=np.uint64) + FIRST_OF_CLOUD
    points = np.zeros(len(xyz), POINT)
    points["id"], points["xyz"], points["color"] = numbers, xyz, rgb
    return points
