"""From photos alone to a capture with cameras and points."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from turbogs_plugin.captures.capture import FEWEST_PHOTOS, named
from turbogs_plugin.captures.colmap import load_pycolmap
from turbogs_plugin.captures.mask_files import misnamed
from turbogs_plugin.captures.photo_files import find_photos, unread
from turbogs_plugin.errors import InputError
from turbogs_plugin.reconstruct import solver
from turbogs_plugin.reconstruct.agreement import (
    DOUBT,
    Agreement,
    consistent_groups,
    fewest_links,
    ghost_pairs,
    linked_groups,
)
from turbogs_plugin.reconstruct.effort import DEFAULTS, DOUBLED, QUICK, efforts_for
from turbogs_plugin.reconstruct.masks import find_photo_masks, place_masks
from turbogs_plugin.reconstruct.matching import FEW, Matching, choose_matching
from turbogs_plugin.reconstruct.photos import PhotoFile, place_photos, read_photos
from turbogs_plugin.reconstruct.workspace import Solution, Workspace

if TYPE_CHECKING:
    import pycolmap

ENOUGH_OF_MANY = 0.95
"""Of more than `FEW` photos so many are enough; of fewer, all."""
REPAIRS = 3
"""So many times a solve with ghosts is repeated without the pairs that made them."""
SMALLEST_SHARE = 0.5
"""A model with a smaller share of the photos is not taken for the scene."""
MATCHING_SHARE = 0.5
"""Where so many pairs match and yet no camera is found, it is not for want of overlap."""
NAMED_AT_MOST = 10
_listed = partial(named, most=NAMED_AT_MOST)


@dataclass(frozen=True)
class Solve:
    """A model with what the matches say about it.

    Args:
        model: that with most photos.
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
        """Photos in the place that most matches say."""
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

    A call for the same photos goes on where an earlier one was stopped. A finished one is told again. Masks of the
    photos go with them, as they are now.

    Args:
        photos: a folder of photos, or a folder whose ``images`` are.
        out: the capture's folder, new or of an earlier call.

    Raises:
        InputError: photos or folder are not usable, or the photos cannot be solved. Then what this call began is gone.
        OSError: the disk is full; what was finished is kept.
        KeyboardInterrupt: what was finished is kept.
    """
    load_pycolmap()  # where it is absent, that is said before photos are read
    found = read_photos(photos)
    place, _ = find_photos(photos)
    if place.resolve() in (out.resolve(), *out.resolve().parents):
        raise InputError(f"the scene '{out}' would lie among the photos of '{place}': choose an --out elsewhere")
    masks = find_photo_masks(photos, place, found)
    workspace = Workspace(out)
    missing = [parent for parent in (out, *out.parents) if not parent.exists()]
    new = workspace.begin(found)
    unused = "" if masks else misnamed(dict.fromkeys((photos, place.parent, place)))
    with workspace.held():
        place_masks(masks, workspace.masks, workspace.masked)
        try:
            solution = workspace.read_solution() or _reconstruct(found, workspace, unread(photos))
        except InputError:
            if new:
                shutil.rmtree(missing[-1] if missing else workspace.scratch, ignore_errors=True)
                for folder in (workspace.images, workspace.masks):
                    shutil.rmtree(folder, ignore_errors=True)
            raise
    return replace(solution, notes=[*solution.notes, unused]) if unused else solution


def scene_beside(photos: Path, run: Path) -> Path:
    """Where training puts the capture of photos: beside its run, where the next run beside that finds it."""
    folder = photos.resolve()
    name = folder.parent.name if folder.name == "images" and folder.parent.name else folder.name
    return run.absolute().parent / f"{name}-scene"


def _reconstruct(photos: Sequence[PhotoFile], workspace: Workspace, others: str) -> Solution:
    """`others`: files beside the photos that are not read, for a note."""
    workspace.images.mkdir(exist_ok=True)
    place_photos(photos, workspace.images)
    names = [photo.name for photo in photos]
    matching = choose_matching(names, np.array([photo.position for photo in photos]))
    longest = max(max(photo.size) for photo in photos)
    enough = len(photos) if len(photos) <= FEW else ENOUGH_OF_MANY * len(photos)
    best: Solve | None = None
    repaired: list[str] = []
    efforts = efforts_for(longest)
    for effort in efforts:
        database = workspace.database(effort)
        if effort is DEFAULTS and longest <= DOUBLED.long_side:  # the features are the same
            solver.with_default_cameras(workspace.database(DOUBLED), database)
        else:
            solver.extract_features(database, workspace.images, photos, effort)
            if not solver.read_names(database):
                if effort is QUICK:
                    continue
                raise InputError(
                    f"none of the {len(photos)} photos shows anything that could be found again in another one: they "
                    "are blank, blurred or too small; take sharp photos of a scene with texture"
                )
            solver.match_features(database, workspace.scratch, names, matching)
        solve, moved = _solve(database, workspace, effort.again if effort is not efforts[0] else "")
        if solve is not None and (best is None or solve.rank > best.rank):
            best, repaired, verified = solve, moved, solver.count_verified_pairs(database)
        if best is not None and best.placed >= enough:
            break
    _require_solved(best, len(photos), solver.count_verified_pairs(database), matching)
    _leave_out(best.model, best.ghosts)
    registered = {image.name for image in best.model.images.values() if image.has_pose}
    left_out = [name for name in names if name not in registered]
    notes = [f"not used: {others}"] if others else []
    notes += _notes(photos, matching, verified, best, repaired, left_out)
    counts = len(photos), len(registered), best.model.num_points3D()
    solution = Solution(workspace.scene, *counts, left_out, notes)
    workspace.finish(best.model, solution)
    return solution


def _solve(database: Path, workspace: Workspace, again: str = "") -> tuple[Solve | None, list[str]]:
    """The best solve of a database, and the photos that a repair has moved. `again`: as in `solve_cameras`."""
    best = _attempt(database, database, workspace, again)
    if best is None:
        return None, []
    first, removed = best, set()
    working = workspace.scratch / "working.db"
    solve = best
    for _ in range(REPAIRS):
        if len(solve.groups) == 1:
            break
        agreement = solve.agreement
        ghostly = agreement.pairs[ghost_pairs(agreement, solve.groups)]
        pairs = {(agreement.names[one], agreement.names[other]) for one, other in ghostly.tolist()}
        if pairs <= removed:
            break
        removed |= pairs
        solver.without_pairs(database, working, sorted(removed))
        solve = _attempt(working, database, workspace, " again, without the pairs that led to a ghost")
        if solve is None:
            break
        if solve.rank > best.rank:
            best = solve
    working.unlink(missing_ok=True)
    placed = {best.agreement.names[view] for view in best.groups[0]}
    return best, [name for name in first.ghosts if name in placed] if best is not first else []


def _attempt(database: Path, evidence: Path, workspace: Workspace, again: str) -> Solve | None:
    """A solve of a database, judged by all the matches of another. `again`: as in `solve_cameras`."""
    models = solver.solve_cameras(database, workspace.images, workspace.scratch, again)
    if not models or models[0].num_reg_images() < FEWEST_PHOTOS:
        return None
    agreement = solver.measure_agreement(models[0], evidence)
    sizes = tuple(model.num_reg_images() for model in models)
    return Solve(models[0], sizes, agreement, consistent_groups(agreement))


def _leave_out(model: pycolmap.Reconstruction, names: Sequence[str]) -> None:
    """Take photos out of a model."""
    wanted = set(names)
    for frame in {image.frame_id for image in model.images.values() if image.name in wanted}:
        model.deregister_frame(frame)


def _require_solved(solve: Solve | None, photos: int, verified: int, matching: Matching) -> None:
    """Raise `InputError`, with the numbers and the remedy, unless the solve has enough of the photos."""
    remedy = "take photos that overlap by two thirds with their neighbours, of one scene, from different places"
    if solve is None:
        if verified >= MATCHING_SHARE * max(1, len(matching.pairs)) and len(matching.pairs):
            raise InputError(
                f"no cameras were found for {photos} photos: {verified:,} of {len(matching.pairs):,} pairs match, but "
                "they show no depth, as photos from one place or copies of one photo do; move between the photos"
            )
        asked = f"of {len(matching.pairs):,} pairs of photos " if not matching.similar else "of pairs of photos "
        sharp = "; sharp ones, not much smaller than a camera makes them"
        raise InputError(f"no cameras were found for {photos} photos: {asked}{verified:,} match; {remedy}{sharp}")
    if solve.placed >= max(FEWEST_PHOTOS, SMALLEST_SHARE * photos):
        return
    if len(solve.sizes) > 1:
        sizes = ", ".join(map(str, solve.sizes[:NAMED_AT_MOST]))
        raise InputError(
            f"{photos} photos fall into {len(solve.sizes)} scenes that do not connect, of {sizes} photos: add photos "
            "that lead from one to the other, or reconstruct the photos of each alone"
        )
    raise InputError(f"only {solve.placed} of {photos} photos connect ({verified:,} pairs match): {remedy}")


def _notes(
    photos: Sequence[PhotoFile], matching: Matching, verified: int, solve: Solve, repaired: list[str], lost: list[str]
) -> list[str]:
    model, agreement = solve.model, solve.agreement
    lenses = len({photo.lens for photo in photos})
    turned = sum(photo.turned for photo in photos)
    upright = f", {turned} turned upright by EXIF" if turned else ""
    notes = [
        f"{len(photos)} photos of {lenses} {'lens' if lenses == 1 else 'lenses'}{upright}; matched {matching.reason}: "
        f"{verified:,} pairs show the same",
        f"{len(photos) - len(lost)} of {len(photos)} photos registered, {model.num_points3D():,} points, "
        f"reprojection error {model.compute_mean_reprojection_error():.2f} px",
    ]
    if repaired:
        notes.append(
            f"{_photos(repaired)} at a ghost, as repeated structure misled the first solve; solved again without the "
            f"pairs that put {_word(repaired, 'it', 'them')} there: {_listed(repaired)}"
        )
    if solve.ghosts:
        notes.append(
            f"{_photos(solve.ghosts)} left out, as more matches contradict {_word(solve.ghosts, 'its', 'their')} place "
            f"than confirm it (repeated structure): {_listed(solve.ghosts)}"
        )
    if unplaced := [name for name in lost if name not in set(solve.ghosts)]:
        smaller = solve.sizes[1:]
        others = f", {len(smaller)} smaller {_word(smaller, 'model', 'models')} besides" if smaller else ""
        notes.append(
            f"{_photos(unplaced)} did not register{others}: {_listed(unplaced)}; add photos between "
            f"{_word(unplaced, 'it', 'them')} and the others"
        )
    if contradicting := int(agreement.contradicts.sum()):
        matches = agreement.agreeing.sum() + agreement.contradicting.sum()
        notes.append(
            f"{contradicting:,} of {len(agreement.pairs):,} pairs contradict the cameras, with "
            f"{agreement.contradicting[agreement.contradicts].sum() / max(1, matches):.1%} of the matches"
        )
    main = {agreement.names[view] for view in solve.groups[0]}
    for groups, reason in (
        (consistent_groups(agreement, DOUBT), "which many matches contradict"),
        (linked_groups(agreement), f"as no pair with the others has {fewest_links(agreement)} matches that agree"),
    ):
        doubtful = [name for group in groups[1:] for name in (agreement.names[view] for view in group) if name in main]
        if doubtful:
            notes.append(f"{_photos(doubtful)} may be in a wrong place, {reason}: {_listed(doubtful)}")
    return notes


def _photos(names: Sequence[str]) -> str:
    return f"{len(names)} {_word(names, 'photo', 'photos')}"


def _word(things: Sequence[object], one: str, more: str) -> str:
    return one if len(things) == 1 else more
