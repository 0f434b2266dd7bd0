"""Sizes of reduced photos, photos as they are stored, and what is done while photos are decoded."""

from threading import Event

import numpy as np
import pytest
from PIL import ExifTags, Image

from turbogs_plugin.captures import decoding, load, load_scene
from turbogs_plugin.captures.decoding import (
    load_photos,
    opened_image,
    photo_array,
    photo_sizes,
    reduced_sizes,
)
from turbogs_plugin.errors import InputError

SIZES = np.array([[640, 480], [500, 90]])


@pytest.mark.parametrize(("factor", "expected"), [(1, SIZES), (4, [[160, 120], [125, 23]]), (25, [[26, 19], [20, 4]])])
def test_sizes_are_to_the_nearest_pixel(factor, expected):
    assert reduced_sizes(SIZES, factor).tolist() == np.asarray(expected).tolist()


def test_photos_that_are_small_already_are_taken_as_they_are():
    assert reduced_sizes(np.array([[3, 2]]), 1).tolist() == [[3, 2]]


@pytest.mark.parametrize("factor", [26, 1000])
def test_a_factor_that_leaves_next_to_nothing_is_refused(factor):
    with pytest.raises(InputError, match=rf"--factor {factor} .*500x90: the largest .* is 25$"):
        reduced_sizes(SIZES, factor)


def test_a_photo_of_more_pixels_than_a_draw_tells_apart_is_refused(capture, monkeypatch):
    monkeypatch.setattr(load, "MOST_PIXELS", 48 * 40 - 1)
    with pytest.raises(InputError, match="a photo would have 48x40 pixels, more than 1919: use --factor 2"):
        load_scene(capture)
    assert load_scene(capture, factor=2).train.cameras.sizes.max() == 24


def test_a_tiff_is_taken_as_stored_whatever_its_orientation(tmp_path):
    """Pillow turns TIFFs itself, before it is asked to."""
    pixels = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    paths = [tmp_path / f"{orientation}.tif" for orientation in range(1, 9)]
    for orientation, path in enumerate(paths, 1):
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = orientation
        Image.fromarray(pixels).save(path, exif=exif)
    sizes = photo_sizes(paths)
    assert (sizes == (8, 6)).all()
    loaded = load_photos(paths, sizes, sizes, [None] * len(paths), photo_array(sizes), lambda: None)
    for view, path in enumerate(paths):
        np.testing.assert_array_equal(loaded.image(view).mul(255).round().numpy(), pixels, err_msg=path.name)
        with opened_image(path) as image:
            np.testing.assert_array_equal(np.asarray(image), pixels, err_msg=path.name)


def test_what_is_done_meanwhile_comes_before_the_last_photo(capture, monkeypatch):
    done, decode, seen = Event(), decoding._decode, []

    def waiting(*arguments):
        assert done.wait(60), "done while the photos are decoded"
        return decode(*arguments)

    def meanwhile(train, test, points):
        seen.append((len(train.cameras.sizes), len(test.cameras.sizes), len(points)))
        done.set()

    monkeypatch.setattr(decoding, "_decode", waiting)
    scene = load_scene(capture, meanwhile=meanwhile)
    assert seen == [(len(scene.train), len(scene.test), len(scene.points))]


def test_what_ends_it_ends_the_decoding(capture, monkeypatch):
    """Ctrl-C, for example: photos that were not begun are not decoded any more."""
    go, begun, decode = Event(), [], decoding._decode

    def waiting(*arguments):
        begun.append(arguments)
        go.wait(0.2)
        return decode(*arguments)

    def meanwhile(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(decoding, "_decode", waiting)
    monkeypatch.setattr(decoding, "processor_cores", lambda: 1)
    with pytest.raises(KeyboardInterrupt):
        load_scene(capture, meanwhile=meanwhile)
    assert len(begun) <= 1
