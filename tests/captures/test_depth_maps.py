"""Depth maps that a transforms.json names: metric ones, ones of any scale and shift, and files that are none."""

import json

import numpy as np
import pytest
import torch
from helpers.refusals import assert_refused
from helpers.rendering_scenes import make_cameras
from PIL import Image

from turbogs_plugin.captures.depth_maps import depth_maps
from turbogs_plugin.scene import Photos, PosedImages

CAMERAS = make_cameras([(64, 48)] * 2)
VIEWS = PosedImages(CAMERAS, ("a.png", "b.png"), Photos(torch.zeros(2 * 64 * 48, 3, dtype=torch.uint8), CAMERAS.sizes))
DEPTHS = 2 + np.add.outer(np.arange(24) / 24, np.arange(32) / 16)
"""Of a map of half the photo's size, in the capture's unit."""
UNIT = 4.0
CELLS = UNIT / DEPTHS[1::2, 1::2]
"""Inverse depths that the photo's cells, 12 x 16 of 4 pixels, have in the scene's unit."""


def write(folder, values, **frame):
    """Files of a capture, its map and frame; the key names the map."""
    name = {"f8": "maps/0.npy", "f4": "maps/0.exr"}.get(values.dtype.str[1:], "maps/0.png")
    (folder / "maps").mkdir()
    if name.endswith("exr"):
        exr = pytest.importorskip("OpenEXR")
        exr.File({"type": exr.scanlineimage}, {"Z": values, "Confidence": 0 * values}).write(str(folder / name))
    else:
        np.save(folder / name, values) if name.endswith("npy") else Image.fromarray(values).save(folder / name)
    frame = {"file_path": "./images/a.png", "depth_file_path": name, **frame}
    (folder / "transforms.json").write_text(json.dumps({"frames": [{"file_path": "images/b.png"}, frame]}))
    return depth_maps(folder, VIEWS, UNIT)


@pytest.mark.parametrize("known", [0.0, 1.0], ids=["no points", "points that agree"])
@pytest.mark.parametrize("values", [DEPTHS, (1000 * DEPTHS).round().astype(np.uint16), DEPTHS.astype(np.float32)])
def test_metric_maps_are_taken_as_they_are(tmp_path, values, known):
    given = write(tmp_path, values)
    assert given(1, CELLS) is None
    np.testing.assert_allclose(given(0, known * CELLS), CELLS, rtol=1e-3)


@pytest.mark.parametrize("values", [0.01 * DEPTHS, 3000 / DEPTHS - 100.0], ids=["depths", "disparities"])
def test_other_maps_are_fitted_to_the_points(tmp_path, values):
    """By a fifth of the cells, one in ten of which is wrong."""
    random = np.random.default_rng(0)
    known = np.where(random.random(CELLS.shape) < 0.2, CELLS, 0.0) * np.where(random.random(CELLS.shape) < 0.1, 1.5, 1)
    np.testing.assert_allclose(write(tmp_path, values)(0, known), CELLS, rtol=0.01)


def test_what_is_no_depth_stays_unknown(tmp_path):
    values = DEPTHS.copy()
    values[1, 1:9:2] = 0.0, np.nan, np.inf, -1.0
    found = write(tmp_path, values)(0, 0 * CELLS)
    assert (found[0, :4] == 0).all() and (found[1:] > 0).all()


@pytest.mark.parametrize(
    ("values", "frame", "words"),
    [
        (np.zeros((24, 32), np.uint8), {}, "one channel of 16 bits"),
        (np.zeros((24, 32, 3), np.uint8), {}, "one channel of 16 bits"),
        (DEPTHS, {"depth_file_path": "absent.npy"}, "cannot read the depth map"),
        (DEPTHS, {"depth_file_path": "transforms.json"}, "s.json: it is no image of a known kind; export it as"),
        (DEPTHS, {"depth_file_path": 5}, "cannot read the depth map .*/5: "),
    ],
)
def test_what_is_no_map_is_refused(tmp_path, values, frame, words):
    assert_refused(words, write(tmp_path, values, **frame), 0, CELLS)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [(b"\x1f\0\0\0\x17\0\0\0", b"\xff\xff\x0f\0" * 2, "more pixels than"), (b"v/1", b"v/2", "cannot read the depth")],
)
def test_an_exr_that_is_none_or_swells_is_refused(tmp_path, old, new, words):
    cells, file = write(tmp_path, DEPTHS.astype(np.float32)), tmp_path / "maps/0.exr"
    file.write_bytes(file.read_bytes().replace(old, new))
    assert_refused(words, cells, 0, CELLS)


def test_captures_without_maps_and_photos_with_a_lens_have_none(tmp_path):
    assert depth_maps(tmp_path, VIEWS, UNIT) is None
    assert write(tmp_path, DEPTHS, k1=0.1) is None
