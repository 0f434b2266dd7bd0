"""Depth maps that a capture names."""

import numpy as np
import pytest
from PIL import Image

from turbogs_plugin.captures.depth_files import depth_file, read_depth
from turbogs_plugin.errors import InputError

DEPTHS = np.array([[0, 1500, 65535], [20, 300, 4000]], dtype=np.uint16)


def test_images_and_arrays_of_depths(tmp_path):
    Image.fromarray(DEPTHS).save(tmp_path / "a.png")
    Image.fromarray(DEPTHS.astype(np.int32)).save(tmp_path / "a.tiff")
    np.save(tmp_path / "a.npy", np.where(DEPTHS == 20, np.nan, DEPTHS.astype(np.float32))[..., None])
    for name in ("a.png", "a.tiff", "a.npy"):
        read = read_depth(tmp_path / name)
        expected = DEPTHS / 1000 * (1 if name != "a.npy" else DEPTHS != 20)
        assert read.dtype == np.float32 and np.allclose(read, expected)


def test_a_frame_names_its_map_and_unit(tmp_path):
    (tmp_path / "d.png").touch()
    assert depth_file({"file_path": "a.png"}, tmp_path) is None
    assert depth_file({"depth_file_path": "d.png", "integer_depth_scale": 5}, tmp_path) == (tmp_path / "d.png", 1e-3)
    assert depth_file({"depth_path": "d.png", "integer_depth_scale": 0.5}, tmp_path) == (tmp_path / "d.png", 0.5)


@pytest.mark.parametrize(
    ("frame", "words"),
    [
        ({"depth_file_path": "absent.png"}, "there is no file"),
        ({"depth_path": "d.png", "integer_depth_scale": -1}, "integer_depth_scale is '-1'"),
        ({"depth_path": "d.png", "integer_depth_scale": "x"}, "integer_depth_scale is 'x'"),
    ],
)
def test_a_frame_without_a_usable_map_is_refused(tmp_path, frame, words):
    (tmp_path / "d.png").touch()
    with pytest.raises(InputError, match=words):
        depth_file(frame, tmp_path)


def test_what_is_no_depth_map_is_refused(tmp_path):
    Image.fromarray(DEPTHS.astype(np.uint8)).save(tmp_path / "grey.png")
    np.save(tmp_path / "three.npy", np.zeros((2, 3, 3)))
    np.save(tmp_path / "text.npy", np.array([["a"]]))
    for name, content in (("a.exr", b"x"), ("cut.npy", b"\x93NUMPY"), ("cut.png", b"\x89PNG"), ("empty.npy", b"")):
        (tmp_path / name).write_bytes(content)
    for file in tmp_path.iterdir():
        with pytest.raises(InputError, match=file.name):
            read_depth(file)
