"""COLMAP's cameras, images and points3D files, binary or text.

pycolmap makes an object of every feature, of which captures have millions, trusts a count of 2^60 in a damaged file,
and refuses reconstructions of which a script took a part out. So the records are read here: no count allocates more
than its file holds.
"""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from turbogs_plugin.captures.capture import LONGEST_NAME, bytes_of, text_of
from turbogs_plugin.captures.starting_points import GREY, read_cloud
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.ply import read_colors

if TYPE_CHECKING:
    import pycolmap

FILES, SUFFIXES = ("cameras", "images", "points3D"), (".bin", ".txt")
CLOUD = "points3D.ply"
"""A cloud that stands for the points where a model has none of COLMAP's (InstantSplat)."""
FIRST_OF_CLOUD = np.uint64(2**63)
"""First identifier of its points, which no feature names."""
FEATURE = np.dtype([("pixel", "<f8", 2), ("point", "<u8")])
"""A place in an image, and the identifier of the point that it shows, or `NO_POINT`."""
POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("color", "u1", 3), ("error", "<f8")])
"""A point, without its track. Its error is not used."""
NO_POINT = np.uint64(2**64 - 1)
TRACK_ELEMENT_BYTES = 8
BITS = {"B": 8, "I": 32, "Q": 64}
"""Bits of unsigned numbers, by their codes in the struct module."""
SENSORS = {"CAMERA": 0, "IMU": 1}
"""Kinds of sensors of a rig."""
SMALLEST_IMAGE, SMALLEST_CAMERA = 73, 24
"""Bytes of an image with a name of one letter and without features; of a camera without parameters."""
NO_FEATURES = np.zeros(0, FEATURE)
NUMBER = re.compile(r"[-+.\de]+|[-+]?(nan|inf)", re.IGNORECASE)
IMAGE = re.compile(r"\s*" + r"(\S+)\s+" * 8 + r"(\S+)[ \t](.+)")
"""The line of an image in text: the name is the rest of it, with its spaces."""


@dataclass(frozen=True)
class ModelImage:
    """A photo of a reconstruction.

    Args:
        number: COLMAP's identifier.
        camera: identifier of its camera.
        name: as the file has it, below the folder of the photos.
        pose: [7] float64, world to camera: quaternion wxyz of any length, translation. `read_poses` has the frames'.
        features: [n] of `FEATURE`.
    """

    number: int
    camera: int
    name: str
    pose: np.ndarray
    features: np.ndarray


@dataclass(frozen=True)
class ColmapModel:
    """A reconstruction: cameras by their identifiers, images in the file's order, points [M] of `POINT` by theirs."""

    cameras: dict[int, pycolmap.Camera]
    images: list[ModelImage]
    points: np.ndarray


def read_model(folder: Path, suffix: str) -> ColmapModel:
    """The reconstruction in a folder.

    Args:
        suffix: '.bin' or '.txt'.

    Raises:
        InputError: a file is damaged, or an image has a camera that is not there; the line names file and place.
    """
    cameras, images, points = (folder / f"{file}{suffix}" for file in FILES)
    points = points if points.is_file() or not (folder / CLOUD).is_file() else folder / CLOUD
    if absent := [path.name for path in (cameras, images, points) if not path.is_file()]:
        raise InputError(
            f"{folder} has no {' and no '.join(absent)}: bring back what is missing, or take that folder away and find "
            "the cameras by 'turbogs reconstruct'"
        )
    read_images, read_points = (_binary_images, _binary_points) if suffix == ".bin" else (_text_images, _text_points)
    known = _cloud_points(points) if points.name == CLOUD else read_points(points)
    model = ColmapModel(_read_cameras(cameras), list(read_images(images)), known)
    for image in model.images:
        if image.camera not in model.cameras:
            trouble = f"image {image.number} has camera {image.camera}, which {cameras.name} does not have"
            raise _damaged(images, trouble)
    if twice := [number for number, times in Counter(image.number for image in model.images).items() if times > 1]:
        raise _damaged(images, f"two images have the number {twice[0]}")
    return ColmapModel(model.cameras, model.images, model.points[np.argsort(model.points["id"], kind="stable")])


def read_poses(folder: Path, suffix: str, model: ColmapModel) -> tuple[dict[int, np.ndarray], str]:
    """[4, 4] float64 world to camera of each image, by its identifier; NaN where the numbers are no pose. And a line
    where an image's own pose is another than its frame's.

    A pose is by the image's frame and its camera's place in the rig, where ``rigs`` and ``frames`` are both there and
    have the image (COLMAP 3.12 and later); else the image's own.

    Raises:
        InputError: ``rigs`` or ``frames`` are damaged.
    """
    poses = {image.number: _viewmat(image.pose) for image in model.images}
    rigs, frames = folder / f"rigs{suffix}", folder / f"frames{suffix}"
    if not (rigs.is_file() and frames.is_file()):
        alone = next((file.name for file in (rigs, frames) if file.is_file()), "")
        return poses, f"{alone} is not used: of rigs{suffix} and frames{suffix} one is missing" if alone else ""
    own = dict(poses)
    in_rig: dict[int, dict[tuple[int, int], np.ndarray]] = {}  # of each rig, its sensors' places but the first one's
    for record in _records(rigs, 8):
        rig, count = record.take("II")
        places = in_rig.setdefault(rig, {})
        for position in range(count):
            sensor = record.take("iI")
            if position and record.take("B")[0]:
                places[sensor] = np.array(record.take("7d"))
    for record in _records(frames, 68):
        frame, rig, *pose, count = record.take("II7dI")
        if rig not in in_rig:
            raise _damaged(frames, f"frame {frame} has rig {rig}, which {rigs.name} does not have")
        from_world = _viewmat(np.array(pose))
        for kind, sensor, image in (record.take("iIQ") for _ in range(count)):
            if image in poses and kind == SENSORS["CAMERA"]:
                place = in_rig[rig].get((kind, sensor))
                poses[image] = from_world if place is None else _viewmat(place) @ from_world
    others = sum(not np.allclose(own[image], pose, 1e-4, 1e-3, equal_nan=True) for image, pose in poses.items())
    remedy = f"take {frames.name} away if a program moved the images alone"
    return poses, f"poses are of {frames.name}, and {others} of images{suffix} are others: {remedy}" if others else ""


def _viewmat(pose: np.ndarray) -> np.ndarray:
    """[4, 4] float64 of a quaternion of any length and a translation [7]; NaN where they are none."""
    import pycolmap

    if not np.isfinite(pose).all() or not 1e-6 < np.abs(pose[:4]).max() < 1e6:
        return np.full((4, 4), np.nan)
    rotation = pycolmap.Rotation3d(np.roll(pose[:4], -1))
    rotation.normalize()
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation.matrix(), pose[4:]
    return viewmat


def _damaged(path: Path, trouble: str) -> InputError:
    return InputError(f"{path} is damaged: {trouble}; copy or reconstruct it again")


class _Words:
    """The words of a text file's line, read one after the other as `_Binary` reads bytes."""

    def __init__(self, path: Path, line: int, words: list[str]) -> None:
        self.path, self.line, self.words = path, line, iter(words)

    def take(self, layout: str) -> tuple:
        """The next numbers, by a layout of the struct module, with ``w`` for a word. Names of sensors and camera models
        count as numbers."""
        codes = (code for count, code in re.findall(r"(\d*)(\D)", layout) for code in code * int(count or 1))
        return tuple([self._number(code) for code in codes])

    def end(self) -> None:
        if left := next(self.words, None):
            raise _damaged(self.path, f"line {self.line} has {left[:40]!r} after its last number")

    def _number(self, code: str) -> float | str:
        word = next(self.words, None)
        if word is None:
            raise _damaged(self.path, f"line {self.line} ends where a number should follow")
        try:
            if code in "wd":
                return word if code == "w" else float(word)
            if code == "i" and word.isidentifier():
                import pycolmap

                models = pycolmap.CameraModelId.__members__
                return SENSORS[word] if word in SENSORS else int(models[word.upper()])
            number = int(float(word))
            if number != float(word) or (code in BITS and not 0 <= number < 1 << BITS[code]):
                raise ValueError
            return number
        except (ValueError, OverflowError, KeyError):
            raise _damaged(self.path, f"line {self.line} has {word[:40]!r} where a number should be") from None


class _Binary:
    """A file's bytes, read from front to end; asking for more than there are raises `InputError`."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.position = path, bytes_of(path), 0

    def skip(self, size: int) -> int:
        """Step over `size` bytes and return where they began."""
        start = self.position
        if size > len(self.data) - start:
            raise _damaged(self.path, f"{size} bytes are wanted at byte {start}, the file has {len(self.data)} in all")
        self.position += size
        return start

    def take(self, layout: str) -> tuple:
        """The next numbers, by a layout of the struct module."""
        numbers = struct.Struct("<" + layout)
        return numbers.unpack_from(self.data, self.skip(numbers.size))

    def end(self) -> None:
        """The next record follows."""

    def count(self, smallest: int) -> int:
        """A uint64 count of records that take at least `smallest` bytes each."""
        (count,) = self.take("Q")
        if count > (len(self.data) - self.position) // smallest:
            raise _damaged(self.path, f"it announces {count} records, more than its {len(self.data)} bytes can hold")
        return count

    def records(self, smallest: int) -> Iterator[int]:
        """The numbers of the records that the file announces. Nothing may follow them."""
        yield from range(self.count(smallest))
        if self.position != len(self.data):
            raise _damaged(self.path, f"{len(self.data) - self.position} bytes follow its last record")

    def name(self) -> str:
        start = self.position
        end = self.data.find(b"\0", start, start + LONGEST_NAME)
        if end < 0:
            raise _damaged(self.path, f"the image name at byte {start} has no end")
        self.position = end + 1
        return self.data[start:end].decode(errors="surrogateescape")


def _records(path: Path, smallest: int) -> Iterator[_Words | _Binary]:
    """A reader of each record of a file: of a line of a text file, or of the binary file.

    Args:
        smallest: bytes of the smallest binary record.
    """
    if path.suffix == ".txt":
        yield from (_Words(path, line, words) for line, words in _text_records(path))
    else:
        file = _Binary(path)
        yield from (file for _ in file.records(smallest))


def _read_cameras(path: Path) -> dict[int, pycolmap.Camera]:
    import pycolmap

    models = {int(model): name for name, model in pycolmap.CameraModelId.__members__.items() if int(model) >= 0}
    cameras = {}
    for record in _records(path, SMALLEST_CAMERA):
        number, model, width, height = record.take("IiQQ")
        if model not in models:
            raise _damaged(path, f"camera {number} has the unknown model {model}")
        if not (0 < width < 2**31 and 0 < height < 2**31):
            raise _damaged(path, f"camera {number} is {width}x{height} pixels")
        camera = pycolmap.Camera.create_from_model_name(number, models[model], 1.0, width, height)
        camera.params = list(record.take(f"{len(camera.params)}d"))
        record.end()
        cameras[number] = camera
    return cameras


def _binary_images(path: Path) -> Iterator[ModelImage]:
    file = _Binary(path)
    for _ in file.records(SMALLEST_IMAGE):
        number, *pose, camera = file.take("I7dI")
        name = file.name()
        count = file.count(FEATURE.itemsize)
        features = np.frombuffer(file.data, FEATURE, count, file.skip(count * FEATURE.itemsize))
        yield ModelImage(number, camera, name, np.array(pose), features)


def _binary_points(path: Path) -> np.ndarray:
    """[M] of `POINT`, by one number of each record and in one go: captures have millions of them."""
    file = _Binary(path)
    smallest, length, starts = POINT.itemsize + 8, struct.Struct("<Q").unpack_from, []
    for _ in file.records(smallest):
        starts.append(file.skip(smallest))
        file.skip(TRACK_ELEMENT_BYTES * length(file.data, file.position - 8)[0])
    if not starts:
        return np.zeros(0, POINT)
    records = np.lib.stride_tricks.sliding_window_view(np.frombuffer(file.data, "u1"), POINT.itemsize)
    return records[starts].view(POINT)[:, 0]


def _text_records(path: Path) -> Iterator[tuple[int, list[str]]]:
    """The number and the words of each line that is neither empty nor a comment. A name need not be UTF-8."""
    for number, line in enumerate(text_of(path).split("\n"), start=1):
        if (words := line.split()) and not words[0].startswith("#"):
            yield number, words


def _text_images(path: Path) -> Iterator[ModelImage]:
    """A line an image, and one of its features, which may be empty or lack."""
    lines = list(enumerate([*text_of(path).split("\n"), ""], start=1))[::-1]  # taken from the end
    while lines:
        line, text = lines.pop()
        if text.strip() and not text.startswith("#"):
            words = IMAGE.fullmatch(text.rstrip())
            numbers = list(words.groups()) if words else text.split()
            number, *pose, camera, name = _Words(path, line, numbers).take("I7dIw")
            features = _text_features(path, line + 1, lines[-1][1].split())
            if features is not None:
                lines.pop()
            yield ModelImage(number, camera, name, np.array(pose), features if features is not None else NO_FEATURES)


def _text_features(path: Path, line: int, words: list[str]) -> np.ndarray | None:
    """[n] of `FEATURE`; None where the line is the next image's: it ends in a name, or has ten numbers."""
    if len(words) == 10 or (len(words) > 10 and not NUMBER.fullmatch(words[-1])):
        return None
    try:
        numbers = np.array(words, np.float64).reshape(-1, 3)
    except (ValueError, OverflowError):
        bad = next((f" ({word[:40]!r})" for word in words if not NUMBER.fullmatch(word)), "")
        raise _damaged(path, f"line {line} is not x, y and point of features, again and again{bad}") from None
    features = np.zeros(len(numbers), FEATURE)
    features["pixel"], points = numbers[:, :2], numbers[:, 2]
    known = (points >= 0) & (points < 2**63)
    features["point"] = np.where(known, np.where(known, points, 0).astype(np.uint64), NO_POINT)
    return features


def _cloud_points(path: Path) -> np.ndarray:
    """[M] of `POINT` of a .ply beside cameras and images."""
    xyz, colors = read_cloud(path)
    points = np.zeros(len(xyz), POINT)
    points["id"] = np.arange(len(xyz), dtype=np.uint64) + FIRST_OF_CLOUD
    points["xyz"], points["color"] = xyz, GREY if colors is None else colors
    return points


def _text_points(path: Path) -> np.ndarray:
    """[M] of `POINT`. Colours may have decimals, as shares of white, too, and errors may lack."""
    records = [_Words(path, line, words).take("Q6d") for line, words in _text_records(path)]
    points = np.zeros(len(records), POINT)
    points["id"] = np.array([number for number, *_ in records], np.uint64)
    values = np.array([numbers for _, *numbers in records]).reshape(-1, 6)
    colors = values[:, 3:]
    if np.isfinite(colors).all() and (colors == np.rint(colors)).all():
        colors = colors.astype(np.int64)
    points["color"] = read_colors(path, dict(zip(("red", "green", "blue"), colors.T, strict=True)))
    points["xyz"] = values[:, :3]
    return points
