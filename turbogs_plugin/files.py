"""Reading text, and writing files so that a reader sees the old one or the new one, and never a part."""

from __future__ import annotations

import glob
import itertools
import os
import secrets
import socket
import tempfile
from collections.abc import Callable, Container, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from turbogs_plugin.errors import InputError
from turbogs_plugin.yaml_json import require_json_size


def require_writable(folder: Path, given: str) -> None:
    """Raise `InputError` where a folder, or the nearest one above it that is there, takes no new entries. `given` is
    what names the place, for the message. Nothing stays behind."""
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
    require_json_size(path)
    try:
        return path.read_bytes().decode("utf-8")
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read '{path}': {error}; write or copy it again") from None


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


def write_atomically(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write a new file of a random name beside its destination, bring it to the disk, and put it in place by one
    rename, which replaces a link and follows none.

    Whatever interrupts this (a full disk, a kill), `path` is what it was before or is complete. Several processes may
    write the same file: one of the writes stays. A write first removes what a killed process of this host has left.

    Args:
        path: the destination; its folder exists.
        write: is given the open file.

    Raises:
        OSError: from the disk, with the name of the file; then nothing is left behind.
    """
    prefix = f".{path.name}.{socket.gethostname()}."  # of the partial files that this host writes
    for leftover in path.parent.glob(f"{glob.escape(prefix)}*.part"):
        if not _runs(leftover.name.removeprefix(prefix).partition(".")[0]):
            leftover.unlink(missing_ok=True)
    temporary = path.with_name(f"{prefix}{os.getpid()}.{secrets.token_hex(8)}.part")
    try:
        with naming(path), open(temporary, "xb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        with naming(path):
            os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    descriptor = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(descriptor)  # brings the rename itself to the disk
    finally:
        os.close(descriptor)


def _runs(process: str) -> bool:
    """Whether a process of this host has this number."""
    try:
        os.kill(int(process), 0)
    except (ValueError, OverflowError, ProcessLookupError):
        return False
    except OSError:  # of another user
        pass
    return True


def new_file(path: Path) -> BinaryIO:
    """A new file in the place of any file or link that is there, for pictures, which need not be whole."""
    path.unlink(missing_ok=True)
    return open(path, "xb")


def unused_name(name: str, taken: Container[str]) -> str:
    """The name, with a number behind it where that is taken."""
    names = (name if number == 1 else f"{name}-{number}" for number in itertools.count(1))
    return next(name for name in names if name not in taken)


def write_text_atomically(path: Path, text: str) -> None:
    """`write_atomically` for UTF-8 text; half of a pair of surrogates, which JSON can name, becomes a ``?``."""
    write_atomically(path, lambda file: file.write(text.encode("utf-8", "replace")))
