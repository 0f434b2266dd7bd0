"""Checks COLMAP's binary files before pycolmap sees them, and after it wrote them.

pycolmap trusts the counts in these files: a count of 2^60 becomes an allocation of that size. So every record is walked
here first, and nothing is allocated that the file does not hold. What one record says of another one, pycolmap checks.
"""

from __future__ import annotations

import errno
import struct
from collections.abc import Container, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from turbogs_plugin.errors import InputError

if TYPE_CHECKING:
    import pycolmap

FEATURE = np.dtype([("pixel", "<f8", 2), ("point", "<u8")])
"""Where an image shows something, and the identifier of the point that it is."""
TRACK_ELEMENT_BYTES = 8
POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("color", "u1", 3), ("error", "<f8")])
"""A point, without its track."""
SENSOR_BYTES, FRAME_MEMBER_BYTES = 8, 16
SMALLEST_IMAGE = 73
"""Bytes of an image with a name of one letter and without points."""
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
    """Walks a file's bytes; asking for more than there are raises `InputError`, which names the file `called`."""

    def __init__(self, path: Path, called: Path | None = None) -> None:
        self.called = called or path
        self.data = path.read_bytes()
        self.position = 0

    def fail(self, trouble: str) -> InputError:
        return InputError(f"{self.called} is damaged: {trouble}; copy or reconstruct it again")

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
        self.end()

    def end(self) -> None:
        """Nothing may follow the last record."""
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

    def name(self) -> None:
        end = self.data.find(b"\0", self.position, self.position + LONGEST_NAME)
        if end < 0:
            raise self.fail(f"the image name at byte {self.position} has no end")
        try:
            self.data[self.position : end].decode()
        except UnicodeDecodeError:
            raise self.fail(f"the image name at byte {self.position} is not UTF-8") from None
        self.position = end + 1

    def pose(self, owner: str) -> None:
        """Step over a quaternion of any length and a translation, both finite."""
        values = np.array(self.unpack("7d"))
        if not np.isfinite(values).all() or not 1e-6 < np.abs(values[:4]).max() < 1e6:
            raise self.fail(f"{owner} has a pose that is not finite, or a zero rotation")


def write_whole(reconstruction: pycolmap.Reconstruction, folder: Path, named: Path) -> None:
    """Write the binary files of a reconstruction, and see that they are whole: of a full disk pycolmap says nothing.

    Args:
        named: what they are called in the message.

    Raises:
        OSError: they are not.
    """
    try:
        reconstruction.write_binary(folder)
        check_binary_model(folder)
    except (RuntimeError, ValueError) as error:
        raise OSError(errno.ENOSPC, "it cannot be written whole", str(named)) from error


def check_binary_model(folder: Path) -> np.ndarray:
    """[M] of `POINT`: the points of the reconstruction in `folder`, if its files are whole, with finite poses.

    Reads ``cameras.bin``, ``images.bin``, ``points3D.bin`` and, where they are, ``rigs.bin`` and ``frames.bin``.

    Raises:
        InputError: a file is damaged.
    """
    cameras = _check_cameras(_Reader(folder / "cameras.bin"))
    for _ in features_of_images(folder / "images.bin", cameras):
        pass
    points = read_points(folder / "points3D.bin")
    rigs, frames = folder / "rigs.bin", folder / "frames.bin"
    if rigs.exists() != frames.exists():
        raise InputError(f"{folder} has one of rigs.bin and frames.bin: bring the other one back")
    if rigs.exists():
        _check_rigs(_Reader(rigs))
        _check_frames(_Reader(frames))
    return points


def _check_cameras(reader: _Reader) -> set[int]:
    """Gives the identifiers."""
    parameter_counts = _parameter_counts()
    cameras: set[int] = set()
    for _ in reader.records(24):
        camera, model, width, height = reader.unpack("IiQQ")
        if model not in parameter_counts:
            raise reader.fail(f"camera {camera} has the unknown model {model}")
        if not (0 < width < 2**31 and 0 < height < 2**31):
            raise reader.fail(f"camera {camera} is {width}x{height} pixels")
        reader.skip(8 * parameter_counts[model])
        cameras.add(camera)
    return cameras


def features_of_images(
    path: Path, cameras: Container[int] | None = None, called: Path | None = None
) -> Iterator[tuple[int, np.ndarray]]:
    """Each image's identifier, and its features [n] of `FEATURE`.

    Args:
        path: of ``images.bin``.
        cameras: identifiers of those that there are; None: they are not compared.
        called: the user's file that it was made of; None: it is the user's own.

    Raises:
        InputError: the file is damaged.
    """
    reader = _Reader(path, called)
    for _ in reader.records(SMALLEST_IMAGE):
        (image,) = reader.unpack("I")
        reader.pose(f"image {image}")
        (camera,) = reader.unpack("I")
        if cameras is not None and camera not in cameras:
            raise reader.fail(f"image {image} has camera {camera}, which cameras.bin does not have")
        reader.name()
        count = reader.count(FEATURE.itemsize)
        yield image, np.frombuffer(reader.data, FEATURE, count, reader.skip(count * FEATURE.itemsize))


def read_points(path: Path) -> np.ndarray:
    """[M] of `POINT`, of ``points3D.bin``, by one number of each record and in one go: captures have millions of them.

    Raises:
        InputError: the file is damaged.
    """
    reader = _Reader(path)
    smallest, length = POINT.itemsize + 8, struct.Struct("<Q").unpack_from
    data, last = reader.data, len(reader.data) - smallest
    count = reader.count(smallest)
    position, starts = reader.position, []
    for _ in range(count):
        if position > last:
            reader.skip(position + smallest - reader.position)  # raises
        starts.append(position)
        position += smallest + TRACK_ELEMENT_BYTES * length(data, position + POINT.itemsize)[0]
    reader.skip(position - reader.position)
    reader.end()
    if not starts:
        return np.zeros(0, POINT)
    return np.lib.stride_tricks.sliding_window_view(np.frombuffer(data, "u1"), POINT.itemsize)[starts].view(POINT)[:, 0]


def _check_rigs(reader: _Reader) -> None:
    for _ in reader.records(8):
        rig, sensors = reader.unpack("II")
        for position in range(sensors):
            reader.skip(SENSOR_BYTES)
            if position and reader.unpack("B")[0]:
                reader.pose(f"rig {rig}")


def _check_frames(reader: _Reader) -> None:
    for _ in reader.records(68):
        frame, _ = reader.unpack("II")
        reader.pose(f"frame {frame}")
        (members,) = reader.unpack("I")
        reader.skip(FRAME_MEMBER_BYTES * members)
