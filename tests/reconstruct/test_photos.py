"""What photos' files say, and upright copies."""

import io

import numpy as np
import pytest
from helpers.refusals import assert_refused
from PIL import Image

from turbogs_plugin.captures.decoding import load_photos, photo_sizes
from turbogs_plugin.captures.photo_files import unread
from turbogs_plugin.reconstruct import solver
from turbogs_plugin.reconstruct.photos import place_photos, read_photos

TURNS = {1: None, 3: Image.Transpose.ROTATE_180, 6: Image.Transpose.ROTATE_90, 8: Image.Transpose.ROTATE_270}
"""How an upright picture is stored for each orientation."""


def picture(seed: int = 0, size: tuple[int, int] = (48, 32)) -> Image.Image:
    """Picture of coarse blocks, which JPEG nearly keeps."""
    width, height = size
    blocks = np.random.default_rng(seed).integers(0, 256, (height // 16, width // 16, 3), dtype=np.uint8)
    return Image.fromarray(blocks.repeat(16, axis=0).repeat(16, axis=1))


def stored(form: str = "JPEG", **options) -> bytes:
    """A photo's file."""
    picture().save(file := io.BytesIO(), form, **options)
    return file.getvalue()


def write(path, orientation: int = 1, gps=None, model: str = "", focal: float = 0.0, **options) -> Image.Image:
    """Write a photo as a camera would that was held so; the upright picture."""
    path.parent.mkdir(parents=True, exist_ok=True)
    upright = picture(len(path.name))
    exif = Image.Exif()
    exif[0x0112] = orientation
    if model:
        exif[0x0110] = model
        exif[0x8769] = entries = exif.get_ifd(0x8769)
        entries[0xA405] = int(focal)
    if gps is not None:
        latitude, longitude = gps
        exif[0x8825] = entries = exif.get_ifd(0x8825)
        for tag, value, letters in ((1, latitude, "NS"), (3, longitude, "EW")):
            entries[tag] = letters[value < 0]
            entries[tag + 1] = (float(int(abs(value))), (abs(value) % 1) * 60, 0.0)
        entries[5], entries[6] = b"\0", 30.0  # altitude, without which COLMAP takes no position
    turn = TURNS[orientation]
    stored = upright if turn is None else upright.transpose(turn)
    stored.save(path, exif=exif, **({"quality": 95} if path.suffix == ".jpg" else {}))
    return upright


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_photos_are_upright_for_everybody(suffix, tmp_path):
    import pycolmap

    shown = {f"{'x' * turn}{suffix}": write(tmp_path / "raw" / f"{'x' * turn}{suffix}", turn) for turn in TURNS}
    photos = read_photos(tmp_path / "raw")
    assert [photo.turned for photo in photos] == [False, True, True, True]
    assert {photo.size for photo in photos} == {(48, 32)} and len({photo.lens for photo in photos}) == 1
    place_photos(photos, tmp_path / "images")
    paths = [tmp_path / "images" / photo.name for photo in photos]
    loaded = load_photos(paths, photo_sizes(paths), [None] * len(paths))
    for view, path in enumerate(paths):
        assert Image.open(path).getexif().get(0x0112, 1) == 1
        for seen in (loaded.image(view).numpy() * 255, pycolmap.Bitmap.read(path, True).to_array()):
            assert np.abs(seen - np.asarray(shown[path.name], dtype=np.float32)).mean() < 4, path
    assert paths[0].read_bytes() == photos[0].path.read_bytes()


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_upright_copies_keep_focal_length_and_gps(suffix, tmp_path):
    import pycolmap

    for number, turn in enumerate((1, 6, 8)):
        write(tmp_path / "raw" / f"{number}{suffix}", turn, gps=(-33.5, 151.25), model="Phone", focal=28)
    photos = read_photos(tmp_path / "raw")
    place_photos(photos, tmp_path / "images")
    upright, turned, _ = (pycolmap.Bitmap.read(tmp_path / "images" / photo.name, True) for photo in photos)
    assert turned.exif_focal_length() == pytest.approx(upright.exif_focal_length()) and upright.exif_focal_length() > 30
    assert turned.exif_latitude() == pytest.approx(-33.5) and turned.exif_longitude() == pytest.approx(151.25)


def test_a_photo_whose_exif_cannot_be_written_again_is_turned(tmp_path):
    """Its GPS speed is a text: the tag of the GPS date is given the number of the speed's."""
    exif = Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8825)[0x1D] = "72 dots"
    spoilt = exif.tobytes().replace(b"\0\x1d\0\2", b"\0\x0d\0\2")
    (tmp_path / "raw").mkdir()
    for view in range(3):
        picture().transpose(TURNS[6]).save(tmp_path / f"raw/{view}.jpg", exif=spoilt)
    place_photos(read_photos(tmp_path / "raw"), tmp_path / "images")
    assert photo_sizes(sorted((tmp_path / "images").iterdir())).tolist() == [[48, 32]] * 3


def test_a_phones_photo_with_a_second_one_behind_it_is_a_jpeg(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 8
    (tmp_path / "raw").mkdir()
    for number in range(3):
        content = stored("MPO", save_all=True, append_images=[picture(1)], exif=exif, quality=95)
        (tmp_path / f"raw/{number}.jpg").write_bytes(content)
    place_photos(read_photos(tmp_path / "raw"), tmp_path / "images")
    with Image.open(tmp_path / "images/0.jpg") as upright:
        assert (upright.format, upright.size) == ("JPEG", (32, 48))


def test_lenses_are_told_apart_by_exif_and_size(tmp_path):
    for name, focal in (("a", 28), ("b", 28), ("c", 85)):
        write(tmp_path / f"{name}.jpg", model="Phone", focal=focal)
    picture(3, (64, 32)).save(tmp_path / "d.jpg")
    lenses = [photo.lens for photo in read_photos(tmp_path)]
    assert lenses[0] == lenses[1] and len(set(lenses)) == 3


def test_gps_is_read_from_upright_copies_and_photos_without_a_fix_have_none(tmp_path):
    for number, gps in enumerate([(-33.5, 151.25), None, (0.0, 0.0), (-33.5, 151.25)]):
        write(tmp_path / f"raw/{number}.jpg", 6 if number == 3 else 1, gps=gps)
    photos, database = read_photos(tmp_path / "raw"), tmp_path / "features.db"
    place_photos(photos, tmp_path / "images")
    solver.extract_features(database, tmp_path / "images", photos, doubled=True)
    found = solver.read_positions(database, [photo.name for photo in photos])
    np.testing.assert_allclose(found, [(-33.5, 151.25), (np.nan,) * 2, (np.nan,) * 2, (-33.5, 151.25)])


def test_names_have_no_spaces_and_folders_are_kept(tmp_path):
    for name in ("a b.jpg", "left/1.JPG", "left/2.png", "images_4/1.jpg", "masks/1.png", ".thumbs/1.jpg"):
        write(tmp_path / name)
    photos = read_photos(tmp_path)
    assert [photo.name for photo in photos] == ["a_b.jpg", "left/1.JPG", "left/2.png"]
    place_photos(photos, tmp_path / "out")
    placed = sorted(path.relative_to(tmp_path / "out").as_posix() for path in (tmp_path / "out").rglob("*.*"))
    assert placed == [photo.name for photo in photos]


def test_maps_of_photos_are_no_photos(tmp_path):
    maps = ("0.jpg.mask.png", "1_mask.png", "2-depth.PNG", "r_0_normal_0001.png", "dynamic_mask_1.png", "1_alpha.png")
    others = ("depth/0.jpg", "normals/1.png", "sky_masks/2.png", "masks/0.png")
    photos = ("0.jpg", "1.jpg", "2.jpg", "r_0.png", "mask_9.jpg", "left/depth_1.png")  # the last are of no photo here
    for name in (*maps, *others, *photos):
        write(tmp_path / name)
    assert {photo.name for photo in read_photos(tmp_path)} == set(photos)
    assert unread(tmp_path).split("; ") == [
        "5 files are masks or maps of photos by their names, no photos (1_alpha.png)",
        *(f"{name}/ holds no photos by its name" for name in ("depth", "normals", "sky_masks")),
    ]


PANORAMA = b'<rdf:Description GPano:ProjectionType="equirectangular"/>'


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "has 0 photos: at least 3"),
        ({"IMG_1.HEIC": b"x"}, r"has 0 photos \(1 file is of a kind that is not read \(IMG_1.HEIC\)"),
        ({"3.jpg": stored()[:-200]}, "cannot read the photo .*3.jpg.*replace it"),
        ({"5.jpg": stored(xmp=PANORAMA)}, "5.jpg is a panorama by its XMP .*: cut it into perspective photos"),
        ({"5.jpg": stored("GIF")}, "5.jpg: it is of another kind; convert it to JPEG"),
        ({"5.png": Image.fromarray(np.zeros((32, 48), dtype=np.uint16))}, "5.png has more than 8 bits"),
        ({"a b.jpg": picture(), "a_b.jpg": picture()}, "2 photos .*'a_b.jpg' without spaces"),
    ],
)
def test_unusable_photos_are_refused(changes, words, tmp_path):
    good = any(len(changes) > 1 or name[0] in "35" for name in changes)
    for name, content in {**{f"{n}.jpg": picture() for n in range(4) if good}, **changes}.items():
        if isinstance(content, bytes):
            (tmp_path / name).write_bytes(content)
        else:
            content.save(tmp_path / name)
    assert_refused(words, read_photos, tmp_path)
