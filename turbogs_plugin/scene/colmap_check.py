"""Checks COLMAP's binary files before pycolmap sees them.

pycolmap trusts the counts in these files: a count of 2^60 becomes an allocation of that size, and a reference to
something that is not there may end the process. So every record is walked here first; nothing is allocated that the
file does not hold, and every identifier is looked up.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from turbogs_plugin.errors import InputError

NO_POINT = np.uint64(2**64 - 1)
POINT2D = np.dtype([("xy", "<f8", 2), ("point3D_id", "<u8")])
TRACK_ELEMENT = np.dtype([("image_id", "<u4"), ("point2D_id", "<u4")])
CAMERA_SENSOR = 0
LONGEST_NAME = 4096


def _parameter_counts() -> dict[int, int]:
    """Number of parameters of each camera model that pycolmap knows, by its number in the files."""
    import pycolmap

    models = pycolmap.CameraModelId.__members__.values()
    return {
        int(model): len(pycolmap.Camera.create_from_model_id(1, model, 1.0, 1, 1).params)
        for model in models
        if int(model) >= 0
    }


class _Reader:
    """Walks a file's bytes; asking for more than there are raises `InputError`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data = path.read_bytes()
        self.position = 0

    def fail(self, trouble: str) -> InputError:
        return InputError(f"{self.path} is damaged: {trouble}; copy or reconstruct it again")

    def skip(self, size: int) -> int:
        """Step over `size` bytes and return where they began."""
        start = self.position
        if size > len(self.data) - start:
            raise self.fail(f"{size} bytes are wanted at byte {start}, the file has {len(self.data)} in all")
        self.position += size
        return start

    def records(self, smallest: int) -> Iterator[int]:
        """The numbers of the records that it announces, of at least `smallest` bytes each. Nothing may follow them."""
        yield from range(self.count(smallest))
        if self.position != len(self.data):
            raise self.fail(f"{len(self.data) - self.position} bytes follow its last record")

    def unpack(self, format: str) -> tuple:
        layout = struct.Struct("<" + format)
        return layout.unpack_from(self.data, self.skip(layout.size))

    def count(self, smallest: int) -> int:
        """A uint64 count of records that take at least `smallest` bytes each."""
        (count,) = self.unpack("Q")
        if count > (len(self.data) - self.position) // smallest:
            raise self.fail(f"it announces {count} records, more than its {len(self.data)} bytes can hold")
        return count

    def array(self, dtype: np.dtype) -> np.ndarray:
        """As many elements as it announces."""
        count = self.count(dtype.itemsize)
        return np.frombuffer(self.data, dtype, count, self.skip(count * dtype.itemsize))

    def name(self) -> None:
        end = self.data.find(b"\0", self.position, self.position + LONGEST_NAME)
        if end < 0:
            raise self.fail(f"the image name at byte {self.position} has no end")
        try:
            self.data[self.position : end].decode()
        except UnicodeDecodeError:
            raise self.fail(f"the image name at byte {self.position} is not UTF-8") from None
        self.position = end + 1

    def new(self, kind: str, number: int, known: dict | set) -> None:
        if number in known:
            raise self.fail(f"{kind} {number} is there twice")

    def pose(self, owner: str) -> None:
        """A unit-free quaternion and a translation."""
        values = np.array(self.unpack("7d"))
        if not np.isfinite(values).all() or not 1e-6 < np.abs(values[:4]).max() < 1e6:
            raise InputError(f"{self.path}: {owner} has a pose that is not finite, or a zero rotation")


def check_binary_model(folder: Path) -> None:
    """Raise `InputError` unless the reconstruction in `folder` is whole and consistent.

    Reads ``cameras.bin``, ``images.bin``, ``points3D.bin`` and, where they are, ``rigs.bin`` and ``frames.bin``.
    """
    cameras = _check_cameras(_Reader(folder / "cameras.bin"))
    images = _check_images(_Reader(folder / "images.bin"), cameras)
    points = _check_points(_Reader(folder / "points3D.bin"), images)
    for image_id, (_, observed) in images.items():
        unknown = ~np.isin(observed, np.append(points, NO_POINT))
        if unknown.any():
            raise InputError(
                f"{folder / 'images.bin'} is damaged: image {image_id} sees point {observed[unknown][0]}, which "
                "points3D.bin does not have; copy or reconstruct it again"
            )
    rigs, frames = folder / "rigs.bin", folder / "frames.bin"
    if rigs.exists() != frames.exists():
        raise InputError(f"{folder} has one of rigs.bin and frames.bin: it must have both or neither")
    if rigs.exists():
        _check_frames(_Reader(frames), _check_rigs(_Reader(rigs), cameras), images)


def _check_cameras(reader: _Reader) -> set[int]:
    parameter_counts = _parameter_counts()
    cameras: set[int] = set()
    for _ in reader.records(24):
        camera, model, width, height = reader.unpack("IiQQ")
        reader.new("camera", camera, cameras)
        if model not in parameter_counts:
            raise reader.fail(f"camera {camera} has the unknown model {model}")
        if not (0 < width < 2**31 and 0 < height < 2**31):
            raise reader.fail(f"camera {camera} is {width}x{height} pixels")
        reader.skip(8 * parameter_counts[model])
        cameras.add(camera)
    return cameras


def _check_images(reader: _Reader, cameras: set[int]) -> dict[int, tuple[int, np.ndarray]]:
    """Image -> (its camera, the 3D point of each of its 2D points)."""
    images: dict[int, tuple[int, np.ndarray]] = {}
    for _ in reader.records(73):
        (image,) = reader.unpack("I")
        reader.new("image", image, images)
        reader.pose(f"image {image}")
        (camera,) = reader.unpack("I")
        if camera not in cameras:
            raise reader.fail(f"image {image} has camera {camera}, which cameras.bin does not have")
        reader.name()
        images[image] = camera, reader.array(POINT2D)["point3D_id"]
    return images


def _check_points(reader: _Reader, images: dict[int, tuple[int, np.ndarray]]) -> np.ndarray:
    """Identifiers of the points, [M] uint64."""
    points: set[int] = set()
    for _ in reader.records(51):
        (point, *_) = reader.unpack("Q3d3Bd")
        reader.new("point", point, points)
        points.add(point)
        for image, point2D in reader.array(TRACK_ELEMENT).tolist():
            if image not in images or point2D >= len(images[image][1]) or images[image][1][point2D] != point:
                raise reader.fail(f"point {point} is said to be 2D point {point2D} of image {image}, which it is not")
    return np.fromiter(points, dtype=np.uint64, count=len(points))


def _check_rigs(reader: _Reader, cameras: set[int]) -> dict[int, set[int]]:
    """Rig -> its cameras."""
    rigs: dict[int, set[int]] = {}
    for _ in reader.records(8):
        rig, sensors = reader.unpack("II")
        reader.new("rig", rig, rigs)
        members: set[int] = set()
        for position in range(sensors):
            kind, camera = reader.unpack("iI")
            if kind == CAMERA_SENSOR and camera not in cameras:
                raise reader.fail(f"rig {rig} has camera {camera}, which cameras.bin does not have")
            reader.new(f"sensor of rig {rig}", camera, members)
            if position and reader.unpack("B")[0]:
                reader.pose(f"rig {rig}")
            members.add(camera)
        rigs[rig] = members
    return rigs


def _check_frames(reader: _Reader, rigs: dict[int, set[int]], images: dict[int, tuple[int, np.ndarray]]) -> None:
    frames: set[int] = set()
    for _ in reader.records(68):
        frame, rig = reader.unpack("II")
        reader.new("frame", frame, frames)
        frames.add(frame)
        if rig not in rigs:
            raise reader.fail(f"frame {frame} has rig {rig}, which rigs.bin does not have")
        reader.pose(f"frame {frame}")
        for _ in range(reader.unpack("I")[0]):
            kind, sensor, image = reader.unpack("iIQ")
            if kind != CAMERA_SENSOR:
                continue
            if sensor not in rigs[rig] or image not in images or images[image][0] != sensor:
                raise reader.fail(f"frame {frame} has image {image} of camera {sensor}, which the others do not have")
