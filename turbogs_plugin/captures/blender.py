"""NeRF-synthetic captures: ``transforms_train.json`` and its like, as Blender's exporters write them.

Photos are named without a suffix and are often transparent. Training and test photos are told apart by file, and the
validation photos are not used where there are test photos.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from turbogs_plugin.captures.capture import Capture, left_out, require_enough, sizes_text
from turbogs_plugin.captures.decoding import is_transparent, opened_image
from turbogs_plugin.captures.transforms import FrameViews, capture_of_views, read_frame_views
from turbogs_plugin.captures.undistort import Lens
from turbogs_plugin.errors import InputError

TRAIN_FILE = "transforms_train.json"
TEST_FILES = ("transforms_test.json", "transforms_val.json")
"""The first of them that is there names the test photos."""
FILES = (TRAIN_FILE, *TEST_FILES)


def read_blender(scene: Path) -> Capture:
    """Read a capture with the split of its files, whose frames are read by `read_frame_views`.

    Where there are no test photos, the split is left to the order of the photos. There are no points: random ones are
    drawn (`starting_points`) about what the training cameras look at.

    Raises:
        InputError: see `read_frame_views`; one photo in both files.
    """
    source = scene / TRAIN_FILE
    if not source.is_file():
        raise InputError(f"{scene} has no {TRAIN_FILE}, which names the photos to train on: bring it back")
    lenses: dict[tuple, Lens] = {}
    remedy = "export again, from a camera of scale 1 in Blender"
    _, train = read_frame_views(scene, source, lenses, remedy)
    require_enough(scene, source, train.absent, len(train.views) + len(train.absent), train.unclear)
    test_file = next((scene / name for name in TEST_FILES if (scene / name).is_file()), None)
    test = FrameViews() if test_file is None else read_frame_views(scene, test_file, lenses, remedy)[1]
    if test_file and (in_both := sorted(train.views.keys() & test.views.keys())):
        raise InputError(
            f"{scene}: {len(in_both)} photos stand both in {TRAIN_FILE} and in {test_file.name} ({in_both[0]}): take "
            f"them out of one; without {' and '.join(TEST_FILES)} every 8th photo is for testing"
        )
    views = {**train.views, **test.views}
    tested = np.array([name in test.views for name in sorted(views)]) if test.views else None
    capture = capture_of_views(scene, scene, views, tested, np.empty((0, 3)), None)
    split = f"{len(train.views)} photos, none for testing,"
    if test.views:
        split = f"{len(train.views)} training and {len(test.views)} test photos"
    with opened_image(scene / min(train.views)) as photo:
        alpha = ", RGBA" if is_transparent(photo) else ""
    notes = [
        f"{source}{f' and {test_file.name}' if test_file else ''} (NeRF-synthetic): {split} "
        f"{sizes_text(capture.photo_sizes)}{alpha}; no points, so {len(capture.points):,} random ones (seed 0) "
        f"{capture.notes[0]}",
        *train.notes,
        *test.notes,
    ]
    if absent := [*train.absent, *test.absent]:
        notes.append(left_out(absent, len(views) + len(absent), "frames"))
    capture.notes = tuple(notes)
    return capture.checked(source)
