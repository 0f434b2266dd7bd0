"""Reading text, and writing files so that a reader sees the old one or the new one, and never a part; which of the
processes that write them still run."""

from __future__ import annotations

import glob
import itertools
import os
import secrets
import socket
import tempfile
import threading
from collections.abc import Callable, Container, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import BinaryIO

from turbogs_plugin.errors import InputError
from turbogs_plugin.yaml_json import JSON_LIMIT

PAUSE = 0.02
"""Seconds between two times that a large file is brought to the disk while it is written."""


def require_writable(folder: Path, given: str) -> None:
    """Try to make an entry in a folder, or in the nearest one above it that is there; nothing stays behind.

    Args:
        given: what names the place, for the message.

    Raises:
        InputError: the folder takes no new entries.
    """
    place = folder.absolute()
    while not os.path.lexists(place):
        place = place.parent
    try:
        with tempfile.TemporaryDirectory(dir=place):
            pass
    except OSError as error:
        reason = error.strerror if place.is_dir() else "not a folder"
        raise InputError(f"{given} cannot be made in '{place}' ({reason}): choose a folder to write to") from None


def require_new_file(path: Path, option: str) -> None:
    """Raise `InputError`, which names the option, where a file exists or has no folder to be made in."""
    if path.exists():
        raise InputError(f"{option} '{path}' exists: choose a new file")
    if not path.absolute().parent.is_dir():
        raise InputError(f"{option} '{path}': there is no folder '{path.parent}'")


def read_text(path: Path) -> str | None:
    """The UTF-8 text of a file, or None where there is none. Raises `InputError` where it cannot be read, or is longer
    than `JSON_LIMIT`."""
    if path.exists() and not path.is_file():
        raise InputError(f"cannot read '{path}': it is no file")
    try:
        with open(path, "rb") as file:
            text = file.read(JSON_LIMIT + 1).decode("utf-8")
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read '{path}': {error}; write or copy it again") from None
    if len(text) > JSON_LIMIT:
        raise InputError(f"cannot read '{path}': it has more than {JSON_LIMIT >> 20} MiB")
    return text


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Give an `OSError` the name of the file that is written: a write knows none, and a partial file's says nothing."""
    try:
        yield
    except OSError as error:
        if error.filename is None or str(error.filename).endswith(".part"):
            error.filename = str(path)
            del error.filename2
        raise


def write_atomically(path: Path, write: Callable[[BinaryIO], object], large: bool = False) -> None:
    """Write a new file of a random name beside its destination, bring it to the disk, and put it in place by one
    rename, which replaces a link and follows none.

    Whatever interrupts this (a full disk, a kill), `path` is what it was before or is complete. Several processes may
    write the same file: one of the writes stays. A write first removes what a killed process of this host has left.

    Args:
        path: the destination; its folder exists.
        write: is given the open file.
        large: a thread brings it to the disk while it is written, so that less is left to wait for.

    Raises:
        OSError: from the disk, with the name of the file; then nothing is left behind.
    """
    prefix = f".{path.name}.{socket.gethostname()}."  # of the partial files that this host writes
    for leftover in path.parent.glob(f"{glob.escape(prefix)}*.part"):
        writer = leftover.name.removeprefix(prefix).partition(".")[0]
        if not writer.isdecimal() or process_started(int(writer)) == "gone":
            leftover.unlink(missing_ok=True)
    temporary = path.with_name(f"{prefix}{os.getpid()}.{secrets.token_hex(8)}.part")
    try:
        with naming(path), open(temporary, "xb") as file:
            with _brought_to_disk(file) if large else nullcontext():
                write(file)
            file.flush()
            os.fsync(file.fileno())
        with naming(path):
            os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)


def new_file(path: Path) -> BinaryIO:
    """A new file in the place of any file or link that is there, for pictures, which need not be whole."""
    path.unlink(missing_ok=True)
    return open(path, "xb")


@contextmanager
def _brought_to_disk(file: BinaryIO) -> Iterator[None]:
    """While entered, a thread brings what is written of a file to the disk. Leaving raises its `OSError`."""
    bring, ended = getattr(os, "fdatasync", os.fsync), threading.Event()

    def repeat() -> None:
        while not ended.wait(PAUSE):
            bring(file.fileno())

    with ThreadPoolExecutor(1) as pool:
        repeated = pool.submit(repeat)
        try:
            yield
        finally:
            ended.set()
    repeated.result()  # a failure that was told here is not told again at the end


def unused_name(name: str, taken: Container[str]) -> str:
    """The name, with a number behind it where that is taken."""
    names = (name if number == 1 else f"{name}-{number}" for number in itertools.count(1))
    return next(name for name in names if name not in taken)


def write_text_atomically(path: Path, text: str) -> None:
    """`write_atomically` for UTF-8 text."""
    write_atomically(path, lambda file: file.write(text.encode("utf-8")))


def _sync_folder(folder: Path) -> None:
    """Bring the rename itself to the disk, where the platform can."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def process_started(process: int) -> str:
    """Start time of a process of this host, which tells it from a later process of its number; "gone" where there is
    none, "" where nothing is known."""
    try:
        return Path(f"/proc/{process}/stat").read_text(errors="replace").rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        pass
    try:  # a system without /proc
        os.kill(process, 0)
    except ProcessLookupError:
        return "gone"
    except OSError:
        pass
    return ""
