"""`turbogs export --cameras`: the cameras and points that it writes, what stays as it was, and what is refused."""

import re
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers.refusals import assert_refused
from helpers.tracked import HEIGHT, WIDTH, tracked, write_tracked
from PIL import Image

from turbogs_plugin.captures import load_scene
from turbogs_plugin.captures.bundle_adjustment import Pinholes, refine_cameras
from turbogs_plugin.export import refined_capture
from turbogs_plugin.export.refined_capture import write_refined

NOISE = 0.1
CASE = tracked(views=6, points=80, noise=NOISE)


@pytest.fixture(scope="module")
def given(tmp_path_factory) -> Path:
    """Not to be changed."""
    return write_tracked(tmp_path_factory.mktemp("tracked") / "cup", CASE)


@pytest.fixture(scope="module")
def refined(given) -> Path:
    folder = given.with_name("refined")
    write_refined(given, folder)
    return folder


@pytest.fixture
def copy(given, tmp_path) -> Path:
    """A capture to change."""
    return Path(shutil.copytree(given, tmp_path / "cup"))


def model_of(capture: Path) -> pycolmap.Reconstruction:
    return pycolmap.Reconstruction(capture / "sparse/0")


def images_of(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    return sorted(model.images.values(), key=lambda image: image.name)


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_each_photo_gets_the_camera_that_took_it(turbogs, tmp_path, suffix):
    capture, new = write_tracked(tmp_path / "cup", CASE, suffix), tmp_path / "new"
    code, out, err = turbogs("export", capture, "--cameras", "--out", new)
    assert (code, err) == (0, "")
    pattern = r"6 of 6 cameras refined, .* ([\d.]+) pixels from where photos show them, ([\d.]+) before \(medians\)\n"
    after, before = map(float, re.fullmatch(rf"{pattern}scene  {re.escape(str(new))}\n", out).groups())
    assert after < 1.5 * NOISE < 1.0 < before
    model = model_of(new)
    poses = np.stack([image.cam_from_world().matrix() for image in images_of(model)])
    lenses = np.stack([model.cameras[image.camera_id].params for image in images_of(model)])
    half_widths = np.full(len(poses), 0.5 * WIDTH)
    cameras = Pinholes(poses[:, :, :3], poses[:, :, 3], lenses[:, :2], lenses[:, 2:], half_widths)
    assert CASE.misplaced(cameras) < 0.1 * CASE.misplaced(CASE.given)
    for name in ("focal", "centers"):  # a turn of the camera takes a part of their errors
        truth, first, now = (getattr(each, name) for each in (CASE.true, CASE.given, cameras))
        assert np.abs(now - truth).mean() < 0.9 * np.abs(first - truth).mean()
    np.testing.assert_allclose(cameras.rotations, CASE.true.rotations, atol=0.01)
    np.testing.assert_allclose(cameras.translations, CASE.true.translations, atol=0.05)


def test_the_new_capture_has_the_same_photos_and_points(given, refined):
    before, after = load_scene(given), load_scene(refined)
    for views, others in ((before.train, after.train), (before.test, after.test)):
        assert others.names == views.names and others.photos.stored.equal(views.photos.stored)
        assert len(others.observations) == len(views.observations) and not others.cameras.Ks.equal(views.cameras.Ks)
    assert after.points.shape == before.points.shape and after.point_colors.equal(before.point_colors)
    assert not after.drawn_points and refine_cameras(after, training=False).reprojection_error < 2.0 * NOISE


def test_features_tracks_and_colours_stay(given, refined):
    before, after = model_of(given), model_of(refined)
    assert after.is_valid() and len(after.cameras) == len(after.images) == 6
    kinds = {(camera.model.name, camera.width, camera.height) for camera in after.cameras.values()}
    assert kinds == {("PINHOLE", WIDTH, HEIGHT)}
    for old, new in zip(images_of(before), images_of(after), strict=True):
        assert (new.image_id, new.name) == (old.image_id, old.name)
        assert [point.point3D_id for point in new.points2D] == [point.point3D_id for point in old.points2D]
        np.testing.assert_array_equal([point.xy for point in new.points2D], [point.xy for point in old.points2D])
    assert set(after.points3D) == set(before.points3D)
    pairs = [(point, before.points3D[number]) for number, point in after.points3D.items()]
    assert all(point.track == old.track and (point.color == old.color).all() for point, old in pairs)
    assert all(0.0 < point.error < 1.0 for point, _ in pairs)
    assert sum((point.xyz != old.xyz).any() for point, old in pairs) > 40


def test_images_without_a_photo_and_points_that_are_not_finite_are_left_out(copy):
    (copy / "images/03.png").unlink()
    model = model_of(copy)
    model.points3D[7].xyz = np.full(3, np.nan)
    model.write_binary(copy / "sparse/0")
    new = copy.with_name("new")
    lines = write_refined(copy, new).splitlines()
    assert lines[0].startswith("1 of 6 images are left out") and lines[2].startswith("5 of 5 cameras refined")
    assert lines[1].startswith("1 of 80 points are left out") and 7 not in model_of(new).points3D
    before, after = model_of(copy), model_of(new)
    gone = before.find_image_with_name("03.png").image_id
    assert after.is_valid() and set(after.images) == set(before.images) - {gone} == set(after.cameras)
    tracks = [point.track.elements for point in after.points3D.values()]
    assert len(tracks) == 79 and all(len(track) == 5 and gone not in {at.image_id for at in track} for track in tracks)
    assert len(load_scene(new).train) == 4


def test_reduced_copies_and_masks_come_along(copy):
    mask = np.full((HEIGHT, WIDTH), 255, dtype=np.uint8)
    mask[:100] = 0
    for name in ("masks", "images_2", "images_old"):
        (copy / name).mkdir()
    for photo in (copy / "images").iterdir():
        Image.fromarray(mask).save(copy / "masks" / photo.name)
        with Image.open(photo) as image:
            image.reduce(2).save(copy / "images_2" / photo.name)
    new = copy.with_name("new")
    write_refined(copy, new)
    links = {entry.name: entry.is_symlink() for entry in new.iterdir()}
    assert links == {"images": True, "images_2": True, "masks": True, "sparse": False}
    for factor in (1, 2):
        before, after = load_scene(copy, factor=factor), load_scene(new, factor=factor)
        assert after.train.names == before.train.names
        assert after.train.photos.image(0).equal(before.train.photos.image(0))
        assert after.train.mask(0).equal(before.train.mask(0)) and not after.train.mask(0).all()


def without_points(capture: Path) -> Path:
    model = model_of(capture)
    model.delete_all_points2D_and_points3D()
    model.write_binary(capture / "sparse/0")
    return capture


def with_distortion(capture: Path) -> Path:
    shutil.rmtree(capture)
    return write_tracked(capture, CASE, model="OPENCV", distortion=(0.01, 0.0, 0.0, 0.0))


def with_other_features(capture: Path) -> Path:
    """A reconstruction whose cameras were edited by hand for photos of another size."""
    model = model_of(capture)
    for camera in model.cameras.values():
        camera.params = 2.0 * camera.params
    model.write_binary(capture / "sparse/0")
    return capture


REFUSED = [
    (lambda capture: capture / "absent", "absent has no COLMAP reconstruction .* by  turbogs reconstruct", "new"),
    (without_points, "sparse/0 has no points that its photos show", "new"),
    (with_distortion, r"6 of 6 cameras have distortion \(OPENCV\)", "new"),
    (with_other_features, "half of its points are over 2% of a photo.* show them: reconstruct the", "new"),
    (Path, "--out .*new' would lie among the photos of .*images': choose another folder", "cup/images/new"),
    (Path, r"--out .*new' cannot be made in .* \(not a folder\): choose a folder to write", "cup/images/00.png/new"),
]


@pytest.mark.usefixtures("few_random_points")
@pytest.mark.parametrize(("change", "words", "out"), REFUSED)
def test_what_cannot_be_refined_or_written_is_refused_before_it_is_computed(copy, monkeypatch, change, words, out):
    monkeypatch.setattr(refined_capture, "refine_together", lambda *_: pytest.fail("cameras were computed"))
    given = change(copy)
    before = sorted(copy.parent.rglob("*"))
    assert_refused(words, write_refined, given, copy.parent / out)
    assert sorted(copy.parent.rglob("*")) == before
