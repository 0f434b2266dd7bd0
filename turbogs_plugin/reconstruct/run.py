"""From photos alone to a capture with cameras and points."""

from __future__ import annotations

import errno
import json
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from filelock import FileLock, Timeout

from turbogs_plugin.captures.capture import FEWEST_PHOTOS, named
from turbogs_plugin.captures.colmap import load_pycolmap
from turbogs_plugin.captures.decoding import photo_sizes, reduced_sizes
from turbogs_plugin.captures.mask_files import misnamed
from turbogs_plugin.captures.photo_files import find_photos, unread
from turbogs_plugin.config.configuration import Config
from turbogs_plugin.errors import InputError
from turbogs_plugin.files import read_text, require_writable, write_text_atomically
from turbogs_plugin.reconstruct import solver
from turbogs_plugin.reconstruct.agreement import (
    DOUBT,
    Agreement,
    consistent_groups,
    ghost_pairs,
)
from turbogs_plugin.reconstruct.masks import find_photo_masks, place_masks
from turbogs_plugin.reconstruct.matching import FEW, choose_pairs
from turbogs_plugin.reconstruct.photos import PhotoFile, list_photos, place_photos, read_photos

if TYPE_CHECKING:
    import pycolmap

SMALL = 1000
"""Photos whose longer side is shorter, in px, show too little without features at twice their size."""
ENOUGH_OF_MANY = 0.95
"""Share of more than `FEW` photos that is enough; of fewer, all must register, or more features are looked for."""
SMALLEST_SHARE = 0.5
"""A model with a smaller share of the photos is not taken for the scene."""
NAMED_AT_MOST = 10
REMEDY = (
    "take sharp photos that overlap by two thirds with their neighbours, of one scene, from different places, not by "
    "turning in one place"
)


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


@dataclass(frozen=True)
class Solve:
    """A model with what the matches say about it.

    Args:
        model: the one with most photos.
        sizes: photos of each model, the largest first.
        agreement: of all matches with the model.
        groups: photos that the matches put together, as indices into the agreement's names, the largest group first.
    """

    model: pycolmap.Reconstruction
    sizes: tuple[int, ...]
    agreement: Agreement
    groups: list[list[int]]

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
    """Find the cameras of photos, and write a COLMAP capture: ``images`` and ``sparse/0``.

    A call for photos of an earlier call that was stopped repeats no features and matches; a finished reconstruction is
    told again. Masks of the photos go with them, as they are now.

    Args:
        photos: a folder of photos, or a folder whose ``images`` are.
        out: the capture's folder, new or of an earlier call.

    Raises:
        InputError: photos or folder are not usable, or the photos cannot be solved. Then what this call began is gone.
        OSError: the disk is full; what was finished is kept.
    """
    load_pycolmap()  # where it is absent, that is said before photos are read
    found = read_photos(photos)
    place, _ = find_photos(photos)
    if place.resolve() in (out.resolve(), *out.resolve().parents):
        raise InputError(f"the scene '{out}' would lie among the photos of '{place}': choose an --out elsewhere")
    masks = find_photo_masks(photos, place, found)
    missing = [parent for parent in (out, *out.parents) if not parent.exists()]
    scratch = out / "reconstruction"
    new = _begin(found, out, scratch / "photos.json")
    unused = "" if masks else misnamed(dict.fromkeys((photos, place.parent, place)))
    solution = _read_solution(out)
    with _held(scratch) if solution is None else nullcontext():  # a finished one may lie where nothing can be written
        place_masks(masks, out / "masks", scratch / "masks.txt")
        try:
            solution = solution or _reconstruct(found, out, unread(photos))
        except InputError:
            if new:
                shutil.rmtree(missing[-1] if missing else scratch, ignore_errors=True)
                for folder in (out / "images", out / "masks"):
                    shutil.rmtree(folder, ignore_errors=True)
            raise
    return replace(solution, notes=[*solution.notes, unused]) if unused else solution


def scene_beside(photos: Path, run: Path) -> Path:
    """Where training puts the capture of photos: beside its run, where the next run beside that finds it."""
    folder = photos.resolve()
    name = folder.parent.name if folder.name == "images" and folder.parent.name else folder.name
    return run.absolute().parent / f"{name}-scene"


def reconstruct_beside(config: Config, run: Path) -> Path:
    """Find the cameras of a capture of photos alone (`holds_photos_alone`) for a run; folder of the reconstruction.

    Raises:
        InputError: the photos cannot be solved, or are too small for the factor.
    """
    photos = Path(config.scene.path)
    _, paths = list_photos(photos)  # too few are refused before anything is said
    if config.scene.factor > 1:
        reduced_sizes(photo_sizes(paths), config.scene.factor)  # as is a factor that is too large
    scene = scene_beside(photos, run)
    print(f"{photos} has photos alone: their cameras are found first, into {scene}", file=sys.stderr, flush=True)
    print("\n".join(reconstruct(photos, scene).notes), file=sys.stderr, flush=True)
    return scene


def _begin(photos: Sequence[PhotoFile], out: Path, listed: Path) -> bool:
    """Make the folder of a scene and list its photos, or see that an earlier call listed them, too; whether it is new.

    Raises:
        InputError: the folder holds something else, or a reconstruction of other photos.
    """
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


@contextmanager
def _held(scratch: Path) -> Iterator[None]:
    """While entered, no other process makes the scene; the system frees the lock of a process that is killed."""
    try:
        lock = FileLock(scratch / "lock", blocking=False).acquire()
    except Timeout:
        raise InputError(f"'{scratch.parent}' is being made by another process: wait for it") from None
    with lock:
        yield


def _read_solution(out: Path) -> Solution | None:
    """What an earlier call came to; None where none was finished."""
    text = read_text(out / "reconstruction" / "solution.json")
    try:
        return Solution(out, **json.loads(text)) if text and (out / "sparse" / "0").is_dir() else None
    except (ValueError, TypeError):  # it is damaged: made anew
        return None


def _reconstruct(photos: Sequence[PhotoFile], out: Path, others: str) -> Solution:
    """Solve the photos and write the scene. `others`: files beside the photos that are not read, for a note."""
    scratch, images = out / "reconstruction", out / "images"
    images.mkdir(exist_ok=True)
    place_photos(photos, images)
    names = [photo.name for photo in photos]
    enough = len(photos) if len(photos) <= FEW else ENOUGH_OF_MANY * len(photos)
    best: Solve | None = None
    moved, said = [], "no photo shows anything that could be found again in another one: take sharp photos with texture"
    small = max(max(photo.size) for photo in photos) < SMALL
    for doubled in (True,) if small else (False, True):
        database = scratch / f"features{'-doubled' * doubled}.db"
        solver.extract_features(database, images, photos, doubled)
        if not solver.count_features(database):
            continue
        pairs, reason = choose_pairs(names, solver.read_positions(database, names))
        solver.match_features(database, scratch, [(names[first], names[second]) for first, second in pairs.tolist()])
        matched = solver.count_verified_pairs(database)
        said = f"{matched:,} of {len(pairs):,} pairs of photos match"
        solve, repaired = _solve(database, images, scratch)
        if solve is not None and (best is None or solve.rank > best.rank):
            best, moved = solve, repaired
            note = f"{_photos(len(photos))} matched {reason}: {matched:,} pairs show the same"
        if best is not None and best.placed >= enough:
            break
    if best is None:
        raise InputError(f"no cameras were found for {len(photos)} photos: {said}; {REMEDY}")
    if best.placed < max(FEWEST_PHOTOS, SMALLEST_SHARE * len(photos)):
        sizes = ", ".join(map(str, best.sizes[:NAMED_AT_MOST]))
        raise InputError(f"only {best.placed} of {len(photos)} photos connect (models of {sizes} photos): {REMEDY}")
    model, ghosts = best.model, set(best.ghosts)
    for frame in {image.frame_id for image in model.images.values() if image.name in ghosts}:
        model.deregister_frame(frame)
    registered = {image.name for image in model.images.values() if image.has_pose}
    left_out = [name for name in names if name not in registered]
    notes = [f"not used: {others}"] if others else []
    notes += [note, *_notes(best, len(photos), moved, left_out)]
    _write_model(model, out / "sparse", scratch)
    result = Solution(out, len(photos), len(registered), model.num_points3D(), left_out, notes)
    kept = {name: value for name, value in asdict(result).items() if name != "scene"}  # which may be moved
    write_text_atomically(scratch / "solution.json", json.dumps(kept, indent=1))
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
    sizes = tuple(model.num_reg_images() for model in models)
    return Solve(models[0], sizes, agreement, consistent_groups(agreement))


def _write_model(model: pycolmap.Reconstruction, sparse: Path, scratch: Path) -> None:
    """Put the model in place, whole or not at all. Raises `OSError` where the disk is full, of which pycolmap says
    nothing."""
    part = scratch / "sparse"
    for folder in (part, sparse, scratch / "models"):
        shutil.rmtree(folder, ignore_errors=True)
    (part / "0").mkdir(parents=True)
    try:
        model.write_binary(part / "0")
        whole = load_pycolmap().Reconstruction(part / "0").num_points3D() == model.num_points3D()
    except (RuntimeError, ValueError, IndexError):  # of a file that was cut
        whole = False
    if not whole:
        raise OSError(errno.ENOSPC, "it cannot be written whole", str(sparse))
    part.rename(sparse)


def _notes(solve: Solve, photos: int, moved: list[str], left_out: list[str]) -> list[str]:
    """Lines for the user about a solve."""
    model, agreement = solve.model, solve.agreement
    error = model.compute_mean_reprojection_error()
    notes = [
        f"{photos - len(left_out)} of {photos} photos registered, {model.num_points3D():,} points, reprojection error "
        f"{error:.2f} px"
    ]
    placed = {agreement.names[view] for view in solve.groups[0]}
    doubtful = [agreement.names[view] for group in consistent_groups(agreement, DOUBT)[1:] for view in group]
    unplaced = [name for name in left_out if name not in solve.ghosts]
    for names, said in (
        (moved, "moved, as repeated structure misled the first solve: solved again without the pairs that did"),
        (solve.ghosts, "left out, as more matches contradict their place than confirm it (repeated structure)"),
        (unplaced, "did not register: add photos between them and the others"),
        ([name for name in doubtful if name in placed], "may be in a wrong place, which many matches contradict"),
    ):
        if names:
            notes.append(f"{_photos(len(names))} {said}: {named(names, most=NAMED_AT_MOST)}")
    return notes


def _photos(count: int) -> str:
    return f"{count} photo{'s' * (count != 1)}"
