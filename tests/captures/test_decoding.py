"""Sizes of reduced photos, photos as they are stored, and what ends the decoding of photos."""

import time

import numpy as np
import pytest
from helpers.bounded_memory import outcome_within
from helpers.refusals import assert_refused
from PIL import ExifTags, Image

from turbogs_plugin.captures import decoding, load_scene
from turbogs_plugin.captures.decoding import load_photos, photo_sizes, reduced_sizes

SIZES = np.array([[640, 480], [500, 90]])


def test_sizes_are_to_the_nearest_pixel_and_a_factor_that_leaves_next_to_nothing_is_refused():
    for factor, expected in ((1, SIZES.tolist()), (4, [[160, 120], [125, 23]]), (25, [[26, 19], [20, 4]])):
        assert reduced_sizes(SIZES, factor).tolist() == expected
    for factor in (26, 1000):
        assert_refused(rf"--factor {factor} .*500x90: the largest .* is 25$", reduced_sizes, SIZES, factor)


def test_a_tiff_that_pillow_would_turn_is_refused(tmp_path):
    """Cameras are by the pixels as they are stored, and Pillow turns TIFFs before it is asked to."""
    for orientation in (1, 3, 6):
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = orientation
        Image.new("RGB", (8, 6)).save(tmp_path / f"{orientation}.tif", exif=exif)
    assert photo_sizes([tmp_path / "1.tif"]).tolist() == [[8, 6]]
    for name in ("3.tif", "6.tif"):
        assert_refused("tif is a TIFF with an orientation in its EXIF data: ", photo_sizes, [tmp_path / name])


def test_a_jpeg_of_endless_scans_is_refused(tmp_path):
    Image.new("RGB", (8, 6)).save(file := tmp_path / "a.jpg", progressive=True)  # about ten scans
    file.write_bytes(file.read_bytes() + b"\xff\xda" * 195)
    assert_refused("a JPEG of more than 200 scans: save it again", photo_sizes, [file])


@pytest.mark.parametrize(
    ("start", "said"),
    [
        (b"\0\0\0\x24ftypheic\0\0\0\0mif1heic", "it is HEIC; convert it to JPEG"),
        (b"\x76\x2f\x31\x01", "it is OpenEXR; convert it to JPEG"),
        (b"\0\0\0\x18ftypmp42", "it is a video; take photos out of it"),
        (b"version https://git-lfs.github.com/spec/v1\n", "it is a pointer of Git LFS; fetch it by 'git lfs pull'"),
        (b"\n<!DOCTYPE html>", "it is a web page; download it again"),
        (b"PK\x03\x04", "it is an archive; unpack it"),
        (b"words", "it is no image of a known kind; copy it there again"),
        (b"", "the file is empty; copy it there again"),
    ],
)
def test_what_is_no_photo_is_named_by_its_content(tmp_path, start, said):
    (tmp_path / "photo.jpg").write_bytes(start + (start and bytes(100)))
    assert_refused(f"cannot read the photo .*photo.jpg: {said}", photo_sizes, [tmp_path / "photo.jpg"])


@pytest.mark.parametrize("form", [*decoding.FORMATS, "MPO", "EPS", "PDF", "GIF", "PPM", "WEBP", "TGA", "ICO", "SGI"])
def test_only_photos_are_photos(tmp_path, form, monkeypatch):
    """By their content; a format that Pillow knows and cameras do not write never comes to its decoder."""
    monkeypatch.setattr("subprocess.Popen", None)  # PostScript would start a program
    path = tmp_path / "photo.png"
    Image.new("RGB", (64, 48)).save(path, format=form)
    if form in (*decoding.FORMATS, "MPO"):
        assert decoding.photo_size(path) == (64, 48)
    else:
        assert_refused("cannot read the photo .*photo.png: it is ", decoding.photo_size, path)


@pytest.mark.parametrize("name", ["RGB.webp", "RGB.avif", "RGB.jp2", "CMYK.jpg", "CMYK.tif", "LAB.tif", "P.png"])
def test_photos_of_every_kind_have_their_colours(tmp_path, name):
    pytest.importorskip("PIL.AvifImagePlugin" if "avif" in name else "PIL")  # since Pillow 11.3
    Image.new("RGB", (8, 6), (204, 102, 51)).convert(name.split(".")[0]).save(tmp_path / name)
    photos = load_photos([tmp_path / name], np.array([[8, 6]]), [None])
    np.testing.assert_allclose(photos.colors, [[204, 102, 51]] * 48, atol=3)


def test_pixels_are_compared_with_bytes_before_they_are_decoded(tmp_path):
    for form, size, options in (("PNG", (8000, 8000), {}), ("TIFF", (8000, 6000), {"compression": "group4"})):
        Image.new("1", size, 1).save(path := tmp_path / "photo.png", form, **options)
        error = outcome_within(8 << 20, photo_sizes, [path])
        assert "bytes, which no photo has: replace it" in str(error)


def test_what_ends_it_ends_the_decoding(capture, monkeypatch):
    """Ctrl-C, for example: photos that were not begun are not decoded any more."""
    begun = []

    def stopped(*arguments):
        begun.append(arguments)
        time.sleep(0.2)
        raise KeyboardInterrupt

    monkeypatch.setattr(decoding, "opened_image", stopped)
    monkeypatch.setattr(decoding, "processor_cores", lambda: 1)
    with pytest.raises(KeyboardInterrupt):
        load_scene(capture)
    assert len(begun) <= 2
