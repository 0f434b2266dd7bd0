"""From photos alone to a capture with cameras and points."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from filelock import FileLock

from turbogs_plugin.captures.capture import FEWEST_PHOTOS, named
from turbogs_plugin.captures.load import other_poses
from turbogs_plugin.captures.photo_files import find_photos, unread
from turbogs_plugin.captures.undistort import load_pycolmap
from turbogs_plugin.errors import InputError
from turbogs_plugin.files import read_text, require_writable, write_text_atomically
from turbogs_plugin.reconstruct import solver
from turbogs_plugin.reconstruct.ghosts import Agreement, consistent_groups, ghost_pairs
from turbogs_plugin.reconstruct.matching import FEW, choose_pairs
from turbogs_plugin.reconstruct.photos import PhotoFile, place_masks, place_photos, read_photos
from turbogs_plugin.yaml_json import parse_json

if TYPE_CHECKING:
    import pycolmap

SMALL = 1000
"""Photos whose longer side is shorter, in px, show too little without features at twice their size."""
ENOUGH_OF_MANY = 0.95
"""Share of more than `FEW` photos that is enough; of fewer, all must register, or more features are looked for."""
PHOTO_BYTES = 2 << 20
"""Room for a photo in a database: 8192 features of 152 bytes at most, and their matches."""
SMALLEST_SHARE = 0.5
"""A model with a smaller share of the photos is not taken for the scene."""


@dataclass(frozen=True)
class Solution:
    """What a reconstruction came to."""

    scene: Path  # the capture's folder: images and sparse/0
    photos: int  # their number, and those of photos in the model and of its points
    registered: int
    points: int
    left_out: list[str]  # names of the photos that are not in the model
    notes: list[str]  # lines for the user

    def text(self) -> str:
        return "\n".join([*self.notes, f"scene  {self.scene}"])


@dataclass(frozen=True)
class Solve:
    """A model with what the matches say about it."""

    model: pycolmap.Reconstruction  # the one with most photos
    agreement: Agreement  # of all matches with the model
    groups: list[list[int]]  # photos, by their places among the agreement's names, that the matches put together

    @property
    def placed(self) -> int:
        """Number of photos in the place that most matches say."""
        return len(self.groups[0])

    @property
    def ghosts(self) -> list[str]:
        """Photos in another place."""
        return [self.agreement.names[view] for group in self.groups[1:] for view in group]

    @property
    def rank(self) -> tuple[int, int]:
        """The larger, the better."""
        return self.placed, -len(self.ghosts)


def reconstruct(photos: Path, out: Path) -> Solution:
    """Find the cameras of photos (a folder of them, or one whose ``images`` are), and write a COLMAP capture to `out`,
    new or of an earlier call: ``images``, ``sparse/0`` and, where the photos have them, ``masks``.

    A call for photos of an earlier call that was stopped repeats no finished step; a finished reconstruction is told
    again. Masks are put in place at each call; a mask that is gone stays in the capture. Raises `InputError`: photos or
    folder are not usable, or the photos cannot be solved, and a new folder `out` is gone; or pycolmap failed."""
    load_pycolmap()  # an absent package is told before photos are read
    found = read_photos(photos)
    place, _ = find_photos(photos)
    if place.resolve() in (out.resolve(), *out.resolve().parents):
        raise InputError(f"the scene '{out}' would lie among the photos of '{place}': choose an --out elsewhere")
    new = _begin(found, out)
    try:
        place_masks(photos, place, found, out / "masks")
        if solution := _read_solution(out):
            return solution
        with FileLock(out / "reconstruction" / "lock"):  # freed by the system where a process is killed
            others = "; ".join(filter(None, (unread(photos), other_poses(photos))))
            return _read_solution(out) or _reconstruct(found, out, others)
    except InputError:
        if new:
            shutil.rmtree(out)
        raise
    except RuntimeError as error:  # pycolmap's
        remedy = f"make room on its disk and repeat the call, which goes on; if that fails, too, remove '{out}'"
        raise InputError(f"pycolmap failed in '{out / 'reconstruction'}' ({error}): {remedy}") from error


def scene_beside(photos: Path, run: Path) -> Path:
    """Where training puts the capture of photos: beside its run, where the next run beside that finds it."""
    folder = photos.resolve()
    name = folder.parent.name if folder.name == "images" and folder.parent.name else folder.name
    return run.absolute().parent / f"{name}-scene"


def reconstruct_beside(photos: Path, run: Path) -> Path:
    """Find the cameras of a folder of photos alone (`holds_photos_alone`) for a run (`reconstruct`); their capture."""
    scene = scene_beside(photos, run)
    print(f"{photos} has photos alone: their cameras are found first, into {scene}", file=sys.stderr, flush=True)
    print("\n".join(reconstruct(photos, scene).notes), file=sys.stderr, flush=True)
    return scene


def _begin(photos: Sequence[PhotoFile], out: Path) -> bool:
    """Make the folder of a scene and list its photos, or see that an earlier call listed them, too; whether it is new.
    Raises `InputError` where the folder holds something else, or a reconstruction of other photos."""
    listed = out / "reconstruction" / "photos.json"
    text = json.dumps({photo.name: photo.stamp for photo in photos}, indent=1)
    known = read_text(listed)
    if known is not None and known != text:
        raise InputError(f"'{out}' was begun with other photos, or they changed: choose a new --out, or delete it")
    if known is None:
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise InputError(f"--out '{out}' holds something else: choose a new folder")
        require_writable(out, f"--out '{out}'")
        listed.parent.mkdir(parents=True)
        write_text_atomically(listed, text)
    return known is None


def _read_solution(out: Path) -> Solution | None:
    """What an earlier call came to; None where none was finished."""
    text = read_text(out / "reconstruction" / "solution.json")
    if not text or not (out / "sparse" / "0").is_dir():
        return None
    try:
        return Solution(**parse_json(text, "it") | {"scene": out})  # which may have been moved
    except (InputError, TypeError) as error:
        raise InputError(f"'{out}/reconstruction/solution.json' is no record of cameras ({error}): remove it") from None


def _reconstruct(photos: Sequence[PhotoFile], out: Path, others: str) -> Solution:
    """Solve the photos and write the scene. `others`: files beside the photos that are not read, for a note."""
    scratch, images, names = out / "reconstruction", out / "images", [photo.name for photo in photos]
    efforts = (True,) if max(max(photo.size) for photo in photos) < SMALL else (False, True)
    needed = PHOTO_BYTES * len(efforts) * len(photos) - sum(file.stat().st_size for file in scratch.glob("*.db"))
    if (free := shutil.disk_usage(scratch).free) < needed:  # SQLite's error could end the process
        room = f"needs about {needed / 2**20:,.0f} MiB for features and matches, and its disk has {free / 2**20:,.0f}"
        raise InputError(f"'{scratch}' {room} MiB free: make room there, or choose an --out on another disk")
    images.mkdir(exist_ok=True)
    place_photos(photos, images)
    enough = len(photos) if len(photos) <= FEW else ENOUGH_OF_MANY * len(photos)
    best: Solve | None = None
    moved: list[str] = []
    for doubled in efforts:
        database = scratch / f"features{'-doubled' * doubled}.db"
        solver.extract_features(database, images, photos, doubled)
        pairs, reason = choose_pairs(names, solver.read_positions(database, names))
        solver.match_features(database, scratch, [(names[first], names[second]) for first, second in pairs.tolist()])
        solve, repaired = _solve(database, images, scratch)
        if solve is not None and (best is None or solve.rank > best.rank):
            best, moved = solve, repaired
        if best is not None and best.placed >= enough:
            break
    if best is None or best.placed < max(FEWEST_PHOTOS, SMALLEST_SHARE * len(photos)):
        placed = best.placed if best else 0
        remedy = "with their neighbours, of one scene, from different places, not by turning in one place"
        found = f"cameras were found for only {placed} of {len(photos)} photos"
        raise InputError(f"{found}: take sharp photos that overlap by two thirds {remedy}")
    model, ghosts = best.model, set(best.ghosts)
    for frame in {image.frame_id for image in model.images.values() if image.name in ghosts}:
        model.deregister_frame(frame)
    registered = {image.name for image in model.images.values() if image.has_pose}
    left_out = [name for name in names if name not in registered]
    notes = [f"not used: {others}"] if others else []
    notes += [f"{len(photos)} photos matched {reason}", *_notes(best, len(photos), moved, left_out)]
    for folder in (scratch / "sparse", out / "sparse", scratch / "models"):
        shutil.rmtree(folder, ignore_errors=True)
    (scratch / "sparse" / "0").mkdir(parents=True)
    model.write_binary(scratch / "sparse" / "0")
    (scratch / "sparse").rename(out / "sparse")  # whole or not at all
    result = Solution(out, len(photos), len(registered), model.num_points3D(), left_out, notes)
    write_text_atomically(scratch / "solution.json", json.dumps(asdict(result), indent=1, default=str))
    return result


def _solve(database: Path, images: Path, scratch: Path) -> tuple[Solve | None, list[str]]:
    """The best solve of a database, and the photos that a repair has moved: where the first solve has ghosts, it is
    repeated once without the pairs that made them."""
    first = _attempt(database, database, images, scratch)
    if first is None or len(first.groups) == 1:
        return first, []
    agreement, working = first.agreement, scratch / "working.db"
    ghostly = agreement.pairs[ghost_pairs(agreement, first.groups)].tolist()
    solver.without_pairs(database, working, [(agreement.names[one], agreement.names[other]) for one, other in ghostly])
    second = _attempt(working, database, images, scratch)
    working.unlink(missing_ok=True)
    if second is None or second.rank <= first.rank:
        return first, []
    placed = {second.agreement.names[view] for view in second.groups[0]}
    return second, [name for name in first.ghosts if name in placed]


def _attempt(database: Path, evidence: Path, images: Path, scratch: Path) -> Solve | None:
    """A solve of a database, judged by all the matches of another."""
    models = solver.solve_cameras(database, images, scratch)
    if not models or models[0].num_reg_images() < FEWEST_PHOTOS:
        return None
    agreement = solver.measure_agreement(models[0], evidence)
    return Solve(models[0], agreement, consistent_groups(agreement))


def _notes(solve: Solve, photos: int, moved: list[str], left_out: list[str]) -> list[str]:
    """Lines for the user about a solve."""
    notes = [
        f"{photos - len(left_out)} of {photos} photos registered, {solve.model.num_points3D():,} points, reprojection "
        f"error {solve.model.compute_mean_reprojection_error():.2f} px"
    ]
    unplaced = [name for name in left_out if name not in solve.ghosts]
    for names, said in (
        (moved, "moved, as repeated structure misled the first solve: solved again without the pairs that did"),
        (solve.ghosts, "left out, as more matches contradict their place than confirm it (repeated structure)"),
        (unplaced, "did not register: add photos between them and the others"),
    ):
        if names:
            notes.append(f"{len(names)} {'photo' if len(names) == 1 else 'photos'} {said}: {named(names, most=10)}")
    return notes
