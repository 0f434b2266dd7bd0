"""Large arrays of the host: in its memory, or in a file on a disk where they would take too much of it.

Photos and error maps of a large capture may be larger than the memory. A file that is mapped into memory is an array
like any other: the system keeps the parts in memory that were used last, as many as fit, and reads and writes the rest.
"""

from __future__ import annotations

import ctypes
import math
import mmap
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from turbogs_plugin.errors import InputError

MEMORY_SHARE = 0.5
"""An array takes at most this share of the memory that is free when it is made."""
LARGE_FILES = Path("/var/tmp")
"""Folder of large temporary files: /tmp often lies in memory."""


def host_array(shape: Sequence[int], dtype: torch.dtype, what: str) -> Tensor:
    """An array of the host with any content, in a file where it is larger than `MEMORY_SHARE` of the free memory. The
    file lies in ``TMPDIR``, else in /var/tmp, and has no name any more: it is gone with the array, whatever ends the
    process. `InputError`, about `what`, where the array fits neither in memory nor on the disk."""
    elements = math.prod(map(int, shape))
    size = elements * dtype.itemsize
    if not too_large(size):
        return torch.empty(*shape, dtype=dtype)
    folder = _folder()
    try:
        with tempfile.NamedTemporaryFile(prefix="turbogs-", dir=folder) as file:
            # All of it now: a disk that is full later would end the process without a word.
            os.posix_fallocate(file.fileno(), 0, size)
            return torch.from_file(file.name, shared=True, size=elements, dtype=dtype).view(*shape)
    except (OSError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:160]
        raise InputError(
            f"{what} take {_gibibytes(size)} of {_gibibytes(free_host_bytes())} of free memory, and a file for them "
            f"cannot be made in {folder} ({reason}): set TMPDIR to a folder with more room, or use a larger --factor"
        ) from error


def too_large(size: int) -> bool:
    """True where an array of `size` bytes takes more than `MEMORY_SHARE` of the memory that is free now."""
    return size > MEMORY_SHARE * free_host_bytes()


def in_file(array: Tensor) -> bool:
    """True where an array lies in a file."""
    return getattr(array.untyped_storage(), "filename", None) is not None


def read_ahead(arrays: Sequence[Tensor]) -> None:
    """Have the disk read those that lie in files, all at once and in the background. They must be contiguous."""
    page = os.sysconf("SC_PAGE_SIZE")
    for array in arrays:
        if array.numel() and in_file(array):
            start = array.data_ptr() // page * page
            length = array.data_ptr() + array.nbytes - start  # advice may fail:
            ctypes.CDLL(None).madvise(ctypes.c_void_p(start), ctypes.c_size_t(length), mmap.MADV_WILLNEED)


def file_note(arrays: Sequence[Tensor], what: str) -> str:
    """A line for the user on those arrays that lie in files; empty where none does."""
    size = sum(array.nbytes for array in arrays if in_file(array))
    said = f"{what} lie in a temporary file, {_gibibytes(size)} in {_folder()}: free memory is too small"
    return said if size else ""


def free_host_bytes() -> int:
    """Memory that this process may still take: what is available, or less where a container is limited."""
    available = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    for line in _lines(Path("/proc/meminfo")):  # absent where the system is not Linux
        if line.startswith("MemAvailable:"):
            available = 1024 * int(line.split()[1])
    return max(0, min([available, *_group_rooms()]))


def _group_rooms() -> list[int]:
    """Bytes left in each control group (version 2) of this process that has a limit; files' caches count as left."""
    rooms, root = [], Path("/sys/fs/cgroup")
    own = next((line[3:] for line in _lines(Path("/proc/self/cgroup")) if line.startswith("0::")), "")
    inner = root / own.lstrip("/")
    for group in {inner, *inner.parents, root}:
        numbers = [_lines(group / name) for name in ("memory.max", "memory.current")]
        if all(lines and lines[0].isdigit() for lines in numbers):  # not "max", nor a group unseen in a container
            stat = dict(line.split() for line in _lines(group / "memory.stat"))
            rooms.append(int(numbers[0][0]) - int(numbers[1][0]) + int(stat.get("inactive_file", 0)))
    return rooms


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="ascii").splitlines()
    except (OSError, ValueError):
        return []


def _folder() -> str:
    if "TMPDIR" not in os.environ and os.access(LARGE_FILES, os.W_OK):
        return str(LARGE_FILES)
    return tempfile.gettempdir()


def _gibibytes(size: int) -> str:
    return f"{size / 2**30:,.1f} GiB"
