"""Loaders against damaged and hostile files: a clear error or a correct result, in bounded memory, never a crash."""

import random
import re
import shutil
import struct
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers.bounded_memory import damaged, outcome_within
from helpers.framework_runs import thin_out_points
from helpers.models import random_gaussians

from turbogs_plugin.captures import write_demo_capture
from turbogs_plugin.captures.colmap import read_colmap
from turbogs_plugin.errors import InputError
from turbogs_plugin.model.ply import read_ply, save_ply

NAN, INF = struct.pack("<d", np.nan), struct.pack("<d", np.inf)
FILES = ("cameras", "images", "points3D", "rigs", "frames")
MEMORY = 32 * 2**20
"""Python and numpy may allocate this much for files of some 50 kB, however large their counts."""


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    """A capture whose model is there twice: sparse/0 in binary, text as text."""
    folder = write_demo_capture(tmp_path_factory.mktemp("hostile") / "demo", views=4, width=32, height=24)
    thin_out_points(folder, 8)
    (folder / "text").mkdir()
    pycolmap.Reconstruction(folder / "sparse/0").write_text(folder / "text")
    return folder


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
@pytest.mark.parametrize("file", FILES)
def test_mutated_models(capture, tmp_path, file, suffix):
    """What is read in spite of a mutation is finite and whole; most mutations are noticed."""
    shutil.copytree(capture / ("text" if suffix == ".txt" else "sparse/0"), tmp_path, dirs_exist_ok=True)
    choice = random.Random(f"{file}{suffix}")
    target = tmp_path / f"{file}{suffix}"
    content, errors, cases = target.read_bytes(), 0, 60
    for _ in range(cases):
        target.write_bytes(damaged(content, choice))
        result = outcome_within(MEMORY, read_colmap, capture, tmp_path, suffix)
        if isinstance(result, InputError):
            errors += 1
        else:
            assert all(np.isfinite(array).all() for array in (result.viewmats, result.Ks, result.points))
    # A number changed into another, or a comment, is no damage that one could see.
    assert errors > (0.5 if suffix == ".bin" else 0.15) * cases


@pytest.mark.parametrize(
    ("file", "place", "replacement", "words"),
    [
        ("images", 8 + 60, struct.pack("<I", 7), "has camera 7, which"),
        ("images", 8, struct.pack("<I", 2), "images.bin is damaged: two images have the number 2"),
        ("images", 0, b"version https://git-lfs.github.com/spec/v1", "images.bin is a pointer of Git LFS: fetch it by"),
        ("cameras", 8 + 4, struct.pack("<i", 99), "unknown model 99"),
        ("cameras", 8 + 8, struct.pack("<Q", 10**6), "a size outside 1 .. 65535 .*: export or reconstruct it"),
        ("cameras", 8 + 24, struct.pack("<d", -5.0), "positive focal lengths|not a COLMAP"),
    ],
)
def test_bad_values(capture, tmp_path, file, place, replacement, words):
    replace_in_copy(capture, tmp_path, file, place, replacement)
    with pytest.raises(InputError, match=words):
        read_colmap(capture, tmp_path, ".bin")


def replace_in_copy(capture, folder, file, place, replacement) -> None:
    """Copy a binary model, in which some bytes of a file are others."""
    shutil.copytree(capture / "sparse/0", folder, dirs_exist_ok=True)
    with (folder / f"{file}.bin").open("r+b") as target:
        target.seek(place)
        target.write(replacement)


@pytest.mark.parametrize(
    ("file", "place", "replacement", "said"),
    [
        ("images", 8 + 4, NAN, "1 of 4 images are left out as damaged: 'view_000.png' has a pose that is not a finite"),
        ("images", 8 + 4, bytes(32), "1 of 4 images are left out as damaged: 'view_000.png' has a pose"),
        ("frames", 8 + 8 + 32, INF, "1 of 4 images are left out as damaged: 'view_000.png' has a pose"),
        ("points3D", 8 + 8, NAN, "1 of .* points are left out, as they are not finite"),
    ],
)
def test_damaged_numbers_are_left_out_and_counted(capture, tmp_path, file, place, replacement, said):
    whole = read_colmap(capture, capture / "sparse/0", ".bin")
    replace_in_copy(capture, tmp_path, file, place, replacement)
    if file != "frames":  # or an image has its frame's pose
        (tmp_path / "frames.bin").unlink()
    left = read_colmap(capture, tmp_path, ".bin")
    assert re.match(said, left.notes[-1]) and np.isfinite(left.viewmats).all() and np.isfinite(left.points).all()
    views, points = len(whole.names) - len(left.names), len(whole.points) - len(left.points)
    assert (views, points) == ((0, 1) if file == "points3D" else (1, 0))
    shown, before = left.observations, whole.observations
    rows = (before.view_ids >= views) & (before.point_ids >= points)  # the first view or point is gone
    np.testing.assert_array_equal(shown.pixels, before.pixels[rows])
    np.testing.assert_array_equal(shown.point_ids + points, before.point_ids[rows])
    np.testing.assert_array_equal(shown.view_ids + views, before.view_ids[rows])


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (b"element vertex 30", b"element vertex 1152921504606846976", "not a whole .ply file"),
        (b"element vertex 30", b"element vertex -1", "not a whole .ply file"),
        (b"property float x", b"property list uchar int x", "not a whole .ply file"),
        (b"property float nx", b"property float f_rest_9", "10 properties f_rest_"),
        (b"property float opacity", b"property float opacities", "lacks the properties opacity"),
        (b"property float x", b"property float packed", "it has no x, y, z: of a compressed model, take what  npx"),
        (b"ply\n", b"version https://git-lfs.github.com/spec/v1\n", "it is a pointer of Git LFS: fetch it by"),
        (b"end_header\n", b"", "not a whole .ply file"),
    ],
)
def test_bad_ply_headers(tmp_path, old, new, words):
    save_ply(random_gaussians(30, sh_degree=1), target := tmp_path / "bad.ply")
    content = target.read_bytes()
    target.write_bytes(content.replace(old, new, 1))
    error = outcome_within(MEMORY, read_ply, target)
    assert old in content and isinstance(error, InputError) and re.search(words, str(error))
