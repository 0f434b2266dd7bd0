"""COLMAP captures: what is read, in which frame, at which size; and what is refused, with which words."""

import re
import shutil
import unicodedata
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from helpers.captures import rotation, write_capture
from helpers.refusals import assert_refused
from PIL import Image

from turbogs_plugin.captures import load_scene
from turbogs_plugin.captures.colmap import find_model, read_colmap
from turbogs_plugin.captures.load import holds_photos_alone
from turbogs_plugin.scene.geometry import camera_centers


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
@pytest.mark.parametrize("model", ["sparse/0", "sparse", "colmap/sparse/0"])
def test_reads_cameras_points_and_photos(tmp_path, model, suffix):
    scene = load_scene(write_capture(tmp_path / "cup", model=model, suffix=suffix))
    assert scene.name == "cup"
    assert scene.test.names == ("photo00.png", "photo08.png")
    assert scene.train.names == tuple(f"photo{view:02d}.png" for view in range(1, 8))
    assert scene.points.shape == (20, 3) and scene.points.dtype == torch.float32 and not scene.drawn_points
    assert scene.point_colors.dtype == torch.uint8 and scene.point_colors[:, 0].tolist() == list(range(20))
    centers = scene.frame.restore_points(scene.train.cameras.centers.numpy())
    np.testing.assert_allclose(centers, [[view, 0, -5] for view in range(1, 8)], atol=1e-5)
    for view, viewmat in zip(range(1, 8), scene.train.cameras.viewmats, strict=True):
        np.testing.assert_allclose(viewmat[:3, :3], rotation(0.1 * view), atol=1e-6)
    np.testing.assert_array_equal(scene.train.cameras.sizes, [[40, 24]] * 7)
    np.testing.assert_allclose(scene.train.cameras.Ks[2], [[50, 0, 21], [0, 52, 11], [0, 0, 1]])
    image = scene.train.photos.image(3)
    assert image.shape == (24, 40, 3)
    np.testing.assert_allclose(image[5, 7] * 255, [42, 30, 80], atol=1e-4)


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
def test_place_and_unit_of_the_capture_do_not_matter(tmp_path, scale):
    """Means at 10^6 from the origin and any unit give the same normalised scene as near the origin."""
    near = load_scene(write_capture(tmp_path / "near"))
    far = load_scene(write_capture(tmp_path / "far", scale=scale, shift=(1e6, -2e6, 3e5)))
    # A float64 at 2e6 resolves 2e-10, and the poses hold sums of products of such numbers.
    tolerance = 1e-6 + 5e-9 / scale
    np.testing.assert_allclose(far.points, near.points, atol=tolerance)
    np.testing.assert_allclose(far.train.cameras.viewmats, near.train.cameras.viewmats, atol=tolerance)
    assert far.frame.scale == pytest.approx(scale * near.frame.scale, rel=tolerance)


@pytest.mark.parametrize("case", ["used", "one is missing", "wrong size"])
def test_reduced_copies_are_used_only_where_all_fit(tmp_path, case):
    folder = write_capture(tmp_path / "cup")
    (folder / "images_2").mkdir()
    for view in range(9):
        Image.new("RGB", (20, 12), (1, 2, 3)).save(folder / "images_2" / f"photo{view:02d}.png")
    if case == "one is missing":
        (folder / "images_2" / "photo04.png").unlink()
    elif case == "wrong size":
        Image.new("RGB", (17, 12), (1, 2, 3)).save(folder / "images_2" / "photo04.png")
    scene = load_scene(folder, factor=2)
    assert (scene.train.photos.colors[0].tolist() == [1, 2, 3]) is (case == "used")
    assert scene.train.cameras.sizes[0].tolist() == [20, 12]


def link_photos(folder: Path) -> None:
    for path in sorted((folder / "images").iterdir()):
        path.unlink()
        path.symlink_to(Path("/gone") / path.name)


def link_folder(folder: Path) -> None:
    shutil.rmtree(folder / "images")
    (folder / "images").symlink_to("/gone")


DEEP, WRONG = Image.fromarray(np.full((24, 40), 3000, dtype=np.uint16)), Image.new("RGB", (24, 40))
"""Photos of 16 bits, and of another size than their camera's."""


def remove_photos(folder: Path) -> None:
    for view in range(2, 9):
        (folder / "images" / f"photo{view:02d}.png").unlink()


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda folder: (folder / "sparse/0/images.bin").unlink(), "no images.bin: bring it back, or take cameras.bin"),
        (remove_photos, r"sparse/0 names 9 photos, of which 7 are missing in .*cup \(photo02.png, .*\): at least 3"),
        (link_photos, "photo00.png is a link to /gone/photo00.png, which"),
        (link_folder, "images is a link to /gone, which is not there: copy that here"),
        (lambda folder: (folder / "images/photo03.png").write_bytes(b"\xff"), "cannot read the photo .*photo03.png"),
        (lambda folder: WRONG.save(folder / "images/photo03.png"), "photo03.png is 24x40 but its camera is 40x24: it"),
        (lambda folder: DEEP.save(folder / "images/photo03.png"), "photo03.png has more than 8 bits a channel"),
    ],
)
def test_bad_files_are_named(tmp_path, damage, words):
    damage(folder := write_capture(tmp_path / "cup"))
    assert_refused(words, load_scene, folder)


@pytest.mark.parametrize(
    ("capture", "arguments", "words"),
    [
        ({"views": 2}, {}, "has 2 images: at least 3"),
        ({}, {"test_every": 1}, "every image of .* would be a test image"),
        ({}, {"test_every": 0}, "test_every is 0"),
        ({}, {"factor": 2.5}, "factor is 2.5"),
        ({"cameras": (("PINHOLE", 40, 24, [np.nan, 52.0, 21.0, 11.0]),)}, {}, "intrinsics|VerifyParams"),
    ],
)
def test_bad_captures_are_refused(tmp_path, capture, arguments, words):
    assert_refused(words, load_scene, write_capture(tmp_path / "cup", **capture), **arguments)


def test_photos_of_a_capture_name_the_capture(tmp_path, monkeypatch):
    folder = write_capture(tmp_path / "far/from/others/cup")
    photos = folder / "images"
    monkeypatch.chdir(photos)
    assert_refused(f"is no capture, but has 1 in it: give {folder}$", load_scene, folder.parent)
    for given in (photos, Path(), folder / "sparse", folder / "sparse/0"):
        assert not holds_photos_alone(given)
        assert_refused(f"{re.escape(str(given))} lies in the capture {folder}: give that folder", load_scene, given)


def test_without_points_random_ones_are_drawn(tmp_path):
    scene, again = load_scene(write_capture(tmp_path / "cup", num_points=0)), load_scene(tmp_path / "cup")
    assert len(scene.points) == len(scene.point_colors) == 50_000 and scene.drawn_points
    assert scene.notes[0].endswith("9 images, 0 points") and torch.equal(scene.points, again.points)
    (tmp_path / "cup/sparse/0/points3D.bin").unlink()
    assert load_scene(tmp_path / "cup").notes[:2] == (f"{scene.notes[0]} (there is no points3D)", scene.notes[1])
    pycolmap.Reconstruction().write_binary(tmp_path / "cup/sparse/0")
    assert_refused("no images with a pose", load_scene, tmp_path / "cup")


def test_of_several_models_the_largest_is_taken_and_said(tmp_path):
    for name, views in (("2", 7), ("0", 4), ("10", 9), ("1", 9)):
        suffix = ".txt" if name == "2" else ".bin"
        folder = write_capture(tmp_path / "cup", views=views, model=f"sparse/{name}", suffix=suffix)
    scene = load_scene(folder)
    assert len(scene.train) + len(scene.test) == 9
    assert re.fullmatch("4 reconstructions in .*sparse: 1 is taken, the largest; 0, 2, 10 not used", scene.notes[1])
    assert re.fullmatch("COLMAP reconstruction .*sparse/1 .binary.: 9 images, 20 points", scene.notes[0])


def test_files_in_binary_and_in_text_make_one_model(tmp_path):
    folder = write_capture(tmp_path / "cup")
    whole, model = load_scene(folder), folder / "sparse/0"
    pycolmap.Reconstruction(model).write_text(model)
    for name in ("cameras.bin", "images.txt", "points3D.bin", "frames.txt", "rigs.txt"):
        (model / name).unlink()
    scene = load_scene(folder)
    assert torch.equal(scene.train.cameras.viewmats, whole.train.cameras.viewmats)
    assert "(binary and text): 9 images, 20 points" in scene.notes[0] and len(scene.points) == 20


def test_copies_that_the_cameras_were_reconstructed_from(tmp_path):
    """Nothing of full size is there, neither photos nor cameras: factors count from the copies."""
    folder = write_capture(tmp_path / "cup")
    (folder / "images").rename(folder / "images_4")
    scene = load_scene(folder)
    assert scene.train.cameras.sizes[0].tolist() == [40, 24] and len(scene.notes) == 1
    assert "photos in " in scene.notes[0] and "images_4" in scene.notes[0]
    assert load_scene(folder, factor=2).train.cameras.sizes[0].tolist() == [20, 12]


@pytest.mark.parametrize(("place", "refused"), [(1e14, False), (1e30, True), (1e300, True)])
def test_a_point_that_is_too_far_for_float32_is_refused(tmp_path, place, refused):
    """Squared distances of the first that is refused would be infinite, and so would a Gaussian's size."""
    folder = write_capture(tmp_path / "cup")
    model = pycolmap.Reconstruction(folder / "sparse/0")
    model.add_point3D(np.array([place, 0.0, 0.0]), pycolmap.Track(), np.zeros(3, dtype=np.uint8))
    model.write(folder / "sparse/0")
    if refused:
        assert_refused("1 of 21 3D points lie too far from the cameras for float32: take them out", load_scene, folder)
    else:
        assert len(load_scene(folder).points) == 21


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_names_with_spaces_in_a_flat_folder(tmp_path, suffix):
    folder = write_capture(tmp_path / "cup", suffix=suffix)
    model = pycolmap.Reconstruction(folder / "sparse/0")
    for image in model.images.values():
        (folder / "images" / image.name).rename(folder / image.name.replace("photo", " my  photo "))
        image.name = image.name.replace("photo", " my  photo ")
    shutil.rmtree(folder / "sparse")
    (model.write_binary if suffix == ".bin" else model.write_text)(folder)
    capture = read_colmap(folder, *find_model(folder))
    assert capture.names == tuple(f" my  photo {view:02d}.png" for view in range(9)) and len(capture.notes) == 1
    assert capture.viewmats[3] @ [3.0, 0, -5, 1] == pytest.approx([0, 0, 0, 1])


@pytest.mark.parametrize(("size", "fits"), [((20, 12), True), ((21, 12), True), ((80, 48), True), ((20, 15), False)])
def test_photos_in_other_sizes_than_their_cameras(tmp_path, size, fits):
    folder = write_capture(tmp_path / "cup")
    for path in (folder / "images").iterdir():
        Image.open(path).resize(size, Image.Resampling.BOX).save(path)
    if not fits:
        assert_refused("photo00.png is 20x15 but its camera is 40x24: it was cropped", load_scene, folder)
        return
    scene = load_scene(folder)
    width, height = size
    assert scene.train.cameras.sizes.tolist() == [list(size)] * 7
    expected = [[50 * width / 40, 0, 21 * width / 40], [0, 52 * height / 24, 11 * height / 24], [0, 0, 1]]
    np.testing.assert_allclose(scene.train.cameras.Ks[0], expected, rtol=1e-6)
    said = f"9 photos in another size than their cameras: intrinsics rescaled from 40x24 to {width}x{height}"
    assert scene.notes[-1].endswith(said)


def test_rigs(tmp_path):
    """Two cameras on one rig: an image's pose is by its frame and its camera's place, whatever images.txt says."""
    camera = ("PINHOLE", 40, 24, [50.0, 52.0, 21.0, 11.0])
    folder = write_capture(tmp_path / "cup", views=8, cameras=(camera, camera), suffix=".txt")
    w, y = np.cos(0.15), np.sin(0.15)
    (folder / "sparse/0/rigs.txt").write_text(f"# a rig\n7 2 CAMERA 1 CAMERA 2 1 {w} 0 {y} 0 1 0.5 0\n")
    turns = ((step, np.cos(0.05 * step), np.sin(0.05 * step)) for step in range(4))
    frames = [f"{i} 7 {w} 0 {y} 0 {i} 0 5 2 CAMERA 1 {2 * i + 1} CAMERA 2 {2 * i + 2}\n" for i, w, y in turns]
    (folder / "sparse/0/frames.txt").write_text("".join(frames))
    capture = read_colmap(folder, *find_model(folder))
    offset, pose = np.eye(4), np.eye(4)
    offset[:3, :3], offset[:3, 3] = rotation(0.3), [1.0, 0.5, 0.0]
    for view, viewmat in enumerate(capture.viewmats):
        pose[:3, :3], pose[:3, 3] = rotation(0.1 * (view // 2)), [view // 2, 0.0, 5.0]
        np.testing.assert_allclose(viewmat, offset @ pose if view % 2 else pose, atol=1e-9)


@pytest.mark.parametrize("other", ["depth", "segmentation", "images_backup", "images_2"])
@pytest.mark.parametrize("kept", [0, 3, 8])
def test_where_photos_were_taken_away_no_other_folder_stands_in(tmp_path, other, kept):
    """It has images of all names, which may be depth maps, copies or another capture's photos."""
    folder = write_capture(tmp_path / "cup")
    shutil.copytree(folder / "images", folder / other)
    for photo in sorted((folder / "images").iterdir())[: 9 - kept]:
        photo.unlink()
    if kept:
        capture = read_colmap(folder, *find_model(folder))
        assert capture.photo_folder == folder / "images" and len(capture.names) == kept
        np.testing.assert_allclose(camera_centers(capture.viewmats)[:, 0], range(9 - kept, 9), atol=1e-9)
        shown = ", ".join([*(f"photo0{view}.png" for view in range(5)), "..."] if kept == 3 else ["photo00.png"])
        assert capture.notes[1] == f"{9 - kept} of 9 images are left out, their photos do not exist: {shown}"
    elif not other.startswith("images"):
        assert_refused("of which 9 are missing", load_scene, folder)


@pytest.mark.parametrize("form", ["{}", "{}.PNG", "{}.jpg", "./{}.png", "images/{}.png", "C:\\images\\{}.png", "NFD"])
def test_names_of_other_programs_and_machines(tmp_path, form):
    """Suffix and letters, folders before the name, Windows' paths, forms of Unicode: the one rule of all captures."""
    folder = write_capture(tmp_path / "cup")
    model = pycolmap.Reconstruction(folder / "sparse/0")
    for image in model.images.values():
        name = image.name.replace("photo", "fot\u00f3")
        (folder / "images" / image.name).rename(folder / "images" / name)
        image.name = unicodedata.normalize("NFD", name) if form == "NFD" else form.format(name[:-4])
    model.write_binary(folder / "sparse/0")
    scene = load_scene(folder)
    assert scene.train.names == tuple(f"fot\u00f3{view:02d}.png" for view in range(1, 8))
    np.testing.assert_allclose(scene.train.photos.image(3)[5, 7] * 255, [42, 30, 80], atol=1e-4)


def each_line(change):
    return lambda text: "".join(change(line.split(), line) + "\n" for line in text.splitlines() if line[:1] != "#")


def exponential(word):
    return f"{float(word):e}"


def words_as(form, first, end):
    return each_line(lambda words, line: " ".join([*words[:first], *map(form, words[first:end]), *words[end:]]))


@pytest.mark.parametrize(
    ("file", "change"),
    [
        ("points3D", words_as(lambda color: f"{color}.0", 4, 7)),
        ("points3D", words_as(lambda color: f"{int(color) / 255:.6f}", 4, 7)),
        ("points3D", each_line(lambda words, line: " ".join(["0", *words[1:7]]))),  # nor numbers of their own
        ("cameras", lambda text: text.replace("40 24", "40.0 2.4e1").replace("PINHOLE", "pinhole")),
        ("cameras", lambda text: text.encode("utf-16")),
        ("images", lambda text: text.rstrip("\n") + "\n"),
        ("images", lambda text: "\ufeff" + text.replace("\n", "\r\n")),
        ("images", each_line(lambda words, line: line if "photo" in line else "")),
        ("images", words_as(lambda number: str(int(number) - 1), 0, 1)),  # from 0 on
        ("images", words_as(lambda number: str(2 * float(number)), 1, 5)),  # quaternions of any length
        ("images", lambda text: "\n".join(line for line in text.splitlines() if "photo" in line)),
        ("images", lambda text: "\n".join("\t".join(line.split()) + " " for line in text.splitlines())),
        ("images", each_line(lambda words, line: line if "photo" in line else " ".join(map(exponential, words)))),
    ],
)
def test_text_as_scripts_and_other_programs_leave_it(tmp_path, file, change):
    folder = write_capture(tmp_path / "cup", suffix=".txt")
    for name in ("rigs", "frames"):
        (folder / f"sparse/0/{name}.txt").unlink()
    right, path = load_scene(folder), folder / f"sparse/0/{file}.txt"
    changed = change(path.read_text())
    path.write_bytes(changed if isinstance(changed, bytes) else changed.encode())
    scene = load_scene(folder)
    assert torch.equal(scene.points, right.points) and torch.equal(scene.point_colors, right.point_colors)
    assert torch.equal(scene.train.cameras.viewmats, right.train.cameras.viewmats)
    assert torch.equal(scene.train.cameras.Ks, right.train.cameras.Ks) and scene.notes == right.notes


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        ("cameras", "50 52 ", "50 52,5 ", r"cameras.txt is damaged: line \d has '52,5' where a number should be"),
        ("cameras", "PINHOLE", "OPENCV", r"cameras.txt is damaged: line \d ends where a number should follow"),
        ("cameras", " 11\n", " 11 0.1\n", r"cameras.txt is damaged: line \d has '0.1' after its last number"),
        ("cameras", "40 24", "40.5 24", "has '40.5' where a number should be"),
        ("images", " 0 5 ", " 0 5m ", r"images.txt is damaged: line \d is not .* \('5m'\)"),
        ("points3D", " 2 3 ", " 2 white ", r"points3D.txt is damaged: line \d has 'white' where"),
        ("images", "photo03.png", "ph\udcf6to03.png", r"sparse/0: image name 'ph\\udcf6to03.png' has signs"),
    ],
)
def test_damaged_text_is_named_by_file_line_and_word(tmp_path, file, old, new, words):
    folder = write_capture(tmp_path / "cup", suffix=".txt")
    path = folder / f"sparse/0/{file}.txt"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1), errors="surrogateescape")
    assert_refused(words, load_scene, folder)


def test_a_cloud_stands_for_points_that_are_not_there(tmp_path):
    folder = write_capture(tmp_path / "cup", num_points=3)
    rows = "".join(f"{view} 0 0 {view} 50 100\n" for view in range(4))
    header = "".join(f"property float {axis}\n" for axis in ("x", "y", "z", "red", "green", "blue"))
    cloud = folder / "sparse/0/points3D.ply"
    cloud.write_text(f"ply\nformat ascii 1.0\nelement vertex 4\n{header}end_header\n{rows}")
    assert len(load_scene(folder).points) == 3 and load_scene(folder).notes[-1].startswith("points3D.ply not used: ")
    (folder / "sparse/0/points3D.bin").unlink()
    scene = load_scene(folder)
    assert scene.point_colors.tolist() == [[view, 50, 100] for view in range(4)] and not scene.drawn_points
    assert scene.notes[0].endswith("9 images, 4 points of points3D.ply") and not len(scene.train.observations)


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "."])
def test_a_list_of_test_photos_is_the_split(tmp_path, place):
    folder = write_capture(tmp_path / "cup")
    (folder / place / "test.txt").write_text("photo03.png\r\n\nimages/photo05\nanother.png\n")
    scene = load_scene(folder)
    assert scene.test.names == ("photo03.png", "photo05.png") and len(scene.train) == 7
    assert scene.notes[0].endswith("20 points, by test.txt 7 for training, 2 for testing")
    (folder / place / "test.txt").write_text("another.png")
    scene = load_scene(folder)
    assert scene.test.names == ("photo00.png", "photo08.png") and "test.txt not used: 0 of its" in scene.notes[0]


def test_files_that_a_script_changed_alone(tmp_path):
    """Poses of frames that images contradict are said; what names points or images that are gone does not count."""
    folder = write_capture(tmp_path / "cup", suffix=".txt")
    images = folder / "sparse/0/images.txt"
    moved = each_line(lambda words, line: " ".join([*words[:7], "9", *words[8:]]) if "photo" in line else line)
    images.write_text(moved(images.read_text()))
    scene = load_scene(folder)
    assert scene.doubt in scene.notes and scene.doubt.startswith("poses are of frames.txt, and ")
    for file, kept in ((images, slice(2, None)), (images.with_name("points3D.txt"), slice(4, -1))):
        file.write_text("\n".join(file.read_text().splitlines()[kept]))
    views = load_scene(folder).test
    assert views.names == ("photo01.png",) and views.observations.point_ids.tolist() == [*range(18)]
    (folder / "sparse/0/rigs.txt").unlink()
    assert load_scene(folder).doubt == "frames.txt is not used: of rigs.txt and frames.txt one is missing"


def test_validation_photos_are_among_the_training_photos(capture):
    whole = load_scene(capture, test_every=4)
    chosen = load_scene(capture, test_every=4, validation=True)
    assert chosen.test.names == whole.train.names[::4]
    assert sorted((*chosen.train.names, *chosen.test.names)) == sorted(whole.train.names)
    assert f"{len(whole.test)} test photos are left out" in "".join(chosen.notes)
    assert len(chosen.points) == len(whole.points)
