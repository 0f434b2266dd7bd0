"""The files of a reconstruction on the disk, which a later call goes on with."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from turbogs_plugin.captures.colmap import write_whole
from turbogs_plugin.errors import InputError
from turbogs_plugin.files import read_text, require_writable, write_text_atomically
from turbogs_plugin.reconstruct.effort import Effort
from turbogs_plugin.reconstruct.photos import PhotoFile

try:
    import fcntl
except ImportError:  # Windows, where nothing is held
    fcntl = None

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True)
class Solution:
    """What a reconstruction came to.

    Args:
        scene: the capture's folder: ``images`` and ``sparse/0``.
        photos, registered, points: their numbers.
        left_out: names of the photos that are not in the model.
        notes: lines for the user.
    """

    scene: Path
    photos: int
    registered: int
    points: int
    left_out: list[str]
    notes: list[str]

    def text(self) -> str:
        return "\n".join([*self.notes, f"scene  {self.scene}"])


class Workspace:
    """The paths of a reconstruction in a capture's folder.

    Attributes:
        images, masks, model: what a capture consists of.
        scratch: what only a later call needs: the lists of photos and masks, databases, the solver's output.
    """

    def __init__(self, scene: Path) -> None:
        self.scene = scene
        self.images = scene / "images"
        self.masks = scene / "masks"
        self.model = scene / "sparse" / "0"
        self.scratch = scene / "reconstruction"
        self.listed = self.scratch / "photos.json"
        self.masked = self.scratch / "masks.txt"
        self.solved = self.scratch / "solution.json"

    def database(self, effort: Effort) -> Path:
        return self.scratch / f"{effort.name}.db"

    def begin(self, photos: Sequence[PhotoFile]) -> bool:
        """Make the folder, or open that of an earlier call.

        Returns:
            Whether it is new.

        Raises:
            InputError: the folder holds something else, or a reconstruction of other photos.
        """
        listed = {photo.name: list(photo.stamp) for photo in photos}
        text = read_text(self.listed)
        if text is None:
            if self.scene.exists() and (not self.scene.is_dir() or any(self.scene.iterdir())):
                raise InputError(f"--out '{self.scene}' holds something else: choose a new folder")
            require_writable(self.scene, f"--out '{self.scene}'")
            self.scratch.mkdir(parents=True)
            write_text_atomically(self.listed, json.dumps(listed, indent=1))
            return True
        try:
            known = dict(json.loads(text))
        except (ValueError, TypeError):
            known = {}
        added, removed = len(listed.keys() - known.keys()), len(known.keys() - listed.keys())
        changed = sum(known[name] != stamp for name, stamp in listed.items() if name in known)
        if added or removed or changed:
            raise InputError(
                f"'{self.scene}' was begun with other photos ({added} new, {removed} gone, {changed} changed since): "
                "choose a new --out, or delete it"
            )
        return False

    @contextmanager
    def held(self) -> Iterator[None]:
        """While entered, no other process makes the scene; one that is killed holds it no longer.

        Raises:
            InputError: another process makes it. Where it is finished, others take moments and are waited for.
        """
        finished = self.read_solution() is not None
        with open(self.listed, "rb" if finished else "r+b") as lock:  # NFS locks only what is open for writing
            if fcntl is not None:
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX if finished else fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    raise InputError(f"'{self.scene}' is being made by another process: wait for it") from None
                except OSError:  # a disk without locks
                    pass
            yield

    def read_solution(self) -> Solution | None:
        """What an earlier call came to; None where none was finished."""
        text = read_text(self.solved)
        if text is None or not self.model.is_dir():
            return None
        try:
            return Solution(self.scene, **json.loads(text))
        except (ValueError, TypeError):
            return None

    def finish(self, model: pycolmap.Reconstruction, solution: Solution) -> None:
        """Put the model in place, whole or not at all, then the solution.

        Raises:
            OSError: the disk is full.
        """
        part = self.scratch / "sparse"
        for folder in (part, self.model.parent, self.scratch / "models"):
            shutil.rmtree(folder, ignore_errors=True)
        (part / "0").mkdir(parents=True)
        write_whole(model, part / "0", self.model)
        part.rename(self.model.parent)
        found = asdict(solution)
        del found["scene"]  # it may be moved
        write_text_atomically(self.solved, json.dumps(found, indent=1))
