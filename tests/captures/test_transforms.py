"""transforms.json of nerfstudio and instant-ngp."""

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.bounded_memory import outcome_within
from helpers.captures import TARGET, camera_to_world, write_transforms
from helpers.refusals import assert_refused

from turbogs_plugin.captures import load_scene
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.ply import read_colors


def edit(folder: Path, function) -> None:
    content = json.loads((folder / "transforms.json").read_text(encoding="utf-8-sig"))
    function(content)
    (folder / "transforms.json").write_text(json.dumps(content))


def test_axes_intrinsics_and_photos(tmp_path):
    scene = load_scene(write_transforms(tmp_path / "cup"))
    assert scene.test.names == ("f0.png", "f8.png") and len(scene.train) == 7
    np.testing.assert_allclose(scene.train.cameras.Ks[0], [[25, 0, 9.5], [0, 26, 5.5], [0, 0, 1]])
    expected = [camera_to_world(0.5 * view)[:3, 3] for view in range(1, 8)]
    np.testing.assert_allclose(scene.frame.restore_points(scene.train.cameras.centers.numpy()), expected, atol=1e-5)
    # The target is straight ahead; a point above it (z is up) is above in the image, at smaller y.
    target, above = scene.frame.normalise_points(np.stack([TARGET, TARGET + np.array([0, 0, 0.5])]))
    for viewmat in scene.train.cameras.viewmats.double().numpy():
        ahead = viewmat[:3, :3] @ target + viewmat[:3, 3]
        np.testing.assert_allclose(ahead[:2], 0, atol=1e-6)
        assert ahead[2] * scene.frame.scale == pytest.approx(math.sqrt(17), rel=1e-5)
        assert (viewmat[:3, :3] @ above + viewmat[:3, 3])[1] < -0.05
        assert np.linalg.det(viewmat[:3, :3]) == pytest.approx(1)
    assert scene.train.photos.colors[0].tolist() == [10, 200, 30]


@pytest.mark.parametrize(
    ("kind", "given", "read"),
    [
        ("uint8", [0, 128, 255], [0, 128, 255]),
        ("float32", [0.5, 0.25, 1.0], [128, 64, 255]),
        ("float64", [0.5, -0.1, 1.2], [128, 0, 255]),  # a bit beyond black and white
        ("float32", [127.6, 64, 255], [128, 64, 255]),
        ("uint16", [0, 256, 65535], [0, 1, 255]),
        ("uint16", [0, 128, 255], [0, 128, 255]),
        ("int32", [-1, 128, 255], [0, 128, 255]),
    ],
)
def test_colors_of_points_are_scaled_by_their_type(kind, given, read):
    def vertices(values):
        return {name: np.array([value], kind) for name, value in zip(("red", "green", "blue"), values, strict=True)}

    assert read_colors(Path("a.ply"), vertices(given)).tolist() == [read]
    if kind.startswith("float"):
        bad = vertices([0.5, math.nan, 0.5])
        assert_refused(r"a\.ply: the colours of 1 of 1 points are not finite", read_colors, Path("a.ply"), bad)


def listed(*views: int) -> list[str]:
    return [f"./images/f{view}.png" for view in views]


BAD = ("absent.png", 7, "../../secret.png")
BEYOND_FLOAT32 = (("fl_x", 3e-307), ("fl_x", 1e299), ("cy", -3e231), ("cx", 1e40), ("fl_y", 1e-45))


def set_poses(value, *views: int):
    return lambda content: [content["frames"][view].update(transform_matrix=value) for view in views or range(9)]


def larger(content):
    content.update({key: 3000 * content[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")}, k1=0.01)


def of_all_poses(function):
    return lambda content: [f.update(transform_matrix=function(f["transform_matrix"])) for f in content["frames"]]


def opencv(pose):
    return (np.array(pose) @ np.diag([1, -1, -1, 1])).tolist()


@pytest.mark.parametrize(
    "change",
    [
        lambda content: content.update(k1=None, p1=None, ply_file_path=None, train_filenames=None, val_filenames=[]),
        lambda content: content.update(w="20", h="10", fl_x="25.0", k1="0"),
        lambda content: content.update(camera_model="pinhole"),
        lambda content: content["frames"].append(content["frames"][3]),
        lambda content: (of_all_poses(opencv)(content), content.update(axes="OpenCV")),
        of_all_poses(lambda pose: np.ravel(pose).tolist()),
        of_all_poses(lambda pose: np.transpose(pose).tolist()),
        of_all_poses(lambda pose: np.ravel(pose)[:12].tolist()),
        of_all_poses(lambda pose: [[str(number) for number in row] for row in pose]),
    ],
)
def test_json_of_other_writers(tmp_path, change):
    """Null is what is absent; numbers may be text, and a matrix be in a row or of columns."""
    folder = write_transforms(tmp_path / "cup")
    right = load_scene(folder)
    edit(folder, change)
    if (text := (folder / "transforms.json").read_text()) and "pinhole" in text:
        (folder / "transforms.json").write_text(text, encoding="utf-16")
    scene = load_scene(folder)
    assert torch.equal(scene.train.cameras.viewmats, right.train.cameras.viewmats)
    assert torch.equal(scene.train.cameras.Ks, right.train.cameras.Ks) and scene.notes == right.notes


@pytest.mark.parametrize("value", [[[-math.inf] * 4] * 4, [[math.nan] * 4] * 3, None, 7, np.zeros((4, 4)).tolist()])
def test_damaged_poses_are_left_out_and_counted(tmp_path, value):
    folder = write_transforms(tmp_path / "cup", test_filenames=["./images/f3.png", "./images/f5.png"])
    edit(folder, set_poses(value, 3, 4))
    scene = load_scene(folder)
    assert scene.test.names == ("f5.png",) and scene.train.names == tuple(f"f{view}.png" for view in (0, 1, 2, 6, 7, 8))
    said = "2 of 9 images are left out as damaged: 'f3.png' has a pose that is not a finite rotation and translation"
    assert scene.notes[1] == said


def write_cloud(path: Path, names=("red", "green", "blue"), end: str = "<", first: float = 1.0) -> None:
    """5 points at (i, 0, 0), but for the first one's x, of colours (i, 50, 100)."""
    rows = np.zeros(5, [(axis, f"{end}f4") for axis in "xyz"] + [(name, "u1") for name in names])
    rows["x"] = first, 1, 2, 3, 4
    for name, values in zip(names, (np.arange(5), 50, 100), strict=False):
        rows[name] = values
    kinds = (*(f"float {axis}" for axis in "xyz"), *(f"uchar {name}" for name in names))
    types = "".join(f"property {kind}\n" for kind in kinds)
    head = f"ply\nformat binary_{'little' if end == '<' else 'big'}_endian 1.0\nelement vertex 5\n{types}end_header\n"
    path.write_bytes(head.encode() + rows.tobytes())


@pytest.mark.parametrize(
    ("options", "left", "said"),
    [
        ({"end": ">"}, 5, "): 9 photos"),
        ({"names": ("diffuse_red", "diffuse_green", "diffuse_blue")}, 5, "): 9 photos"),
        ({"names": ("R", "G", "B"), "first": math.nan}, 4, "1 of 5 points are left out, as they are not finite"),
        ({"names": ()}, 5, "5 points of sparse_pc.ply, grey as it has no colours"),
    ],
)
def test_clouds_of_other_programs(tmp_path, options, left, said):
    folder = write_transforms(tmp_path / "cup", ply_file_path="sparse_pc.ply")
    write_cloud(folder / "sparse_pc.ply", **options)
    scene = load_scene(folder)
    expected = [[128] * 3] * 5 if options.get("names") == () else [[view, 50, 100] for view in range(5)]
    assert scene.point_colors.tolist() == expected[-left:] and any(said in note for note in scene.notes)


@pytest.mark.parametrize("name", ["sparse_pc.ply", "init.ply", "points3d.PLY"])
def test_clouds_that_are_not_named_are_said(tmp_path, name):
    folder = write_transforms(tmp_path / "cup")
    write_cloud(folder / name)
    scene = load_scene(folder)
    assert scene.drawn_points and f"{name} not used: name one as ply_file_path in transforms.json" in scene.notes[1]


def test_frames_to_test_on(tmp_path):
    """ScanNet++'s are not among the others."""
    folder = write_transforms(tmp_path / "cup")
    edit(folder, lambda content: content.update(test_frames=content["frames"][6:], frames=content["frames"][:6]))
    (folder / "transforms_test.json").write_text("{}")
    scene = load_scene(folder)
    assert scene.test.names == ("f6.png", "f7.png", "f8.png") and len(scene.train) == 6
    assert "with test_frames" in scene.notes[0] and "transforms_test.json not used" in scene.notes


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda content: content.update(camera_model="EQUIRECTANGULAR"), "known are OPENCV.* flat cuts of pan"),
        (lambda content: content.update(k4=0.1, k5=0.1), "f0.png has k4 and k5, which OPENCV does not"),
        *((lambda content, n=n, v=v: content.update({n: v}), "beyond 1e.09 pixels") for n, v in BEYOND_FLOAT32),
        (lambda content: content.update(k1="much"), "k1 is 'much': it must be a finite number"),
        (lambda content: content["frames"][4].update(k1=-1e9), "f4.png is OPENCV with parameters that are not those"),
        (lambda content: content.pop("fl_x"), "neither fl_x nor a camera_angle_x"),
        (lambda content: content.update(w=2**60), "camera of f0.png is .*: write the photo's size as w and h"),
        (lambda content: content.update(frames=3), "no list of frames"),
        (lambda content: content.update(axes="up"), "its axes are 'up': write"),
        (larger, "f0.png is .*, too small to be undistorted by a camera of "),
        (lambda content: content["frames"][1].update(file_path="/a" * 5000), "an image name has 10000 letters: rename"),
        (lambda content: content["frames"][0].pop("file_path"), "a frame without a file_path"),
        (
            lambda content: [frame.update(file_path=f"none{i}.png") for i, frame in enumerate(content["frames"][2:])],
            r"names 9 photos, of which 7 are missing in .* \(none0.png, .*\): at least 3",
        ),
        (lambda content: content.update(ply_file_path="../points.ply"), "'../points.ply', is not there: bring it back"),
        (set_poses(None), "f0.png' is no matrix of 4x4 numbers"),
        (set_poses(np.diag([1, 1, -1, 1]).tolist()), "f0.png' is not a rotation"),
        (lambda content: content.update(test_frames=[{}]), "a frame without a file_path"),
        (lambda content: content.update(test_filenames=["images/f3.png", "g"]), "test_filenames are no split: give"),
        (lambda content: content.update(train_filenames=listed(*range(9))), "train_filenames.* are no split"),
        (lambda content: content.update(train_filenames=listed(1, 2, 3), test_filenames=listed(3, 4)), "are no split"),
        (lambda content: content.update(train_filenames=listed(1, 2), test_filenames=listed(3)), "2 training images"),
        *((lambda content, p=p: content["frames"][1].update(mask_path=p), f"mask_path of .*{p}., is not") for p in BAD),
    ],
)
def test_what_is_refused(tmp_path, change, words):
    folder = write_transforms(tmp_path / "cup")
    edit(folder, change)
    assert_refused(words, load_scene, folder)


def test_what_a_file_says_is_not_said_again_for_each_frame(tmp_path):
    folder, many = write_transforms(tmp_path / "cup"), dict.fromkeys(map(str, range(3000)), 0)
    edit(folder, lambda content: content.update(many, frames=[{"file_path": ""}] * 9000))
    assert isinstance(outcome_within(64 << 20, load_scene, folder), InputError)


@pytest.mark.parametrize(
    "written",
    [
        "images\\f{}.png",
        ".\\images\\f{}.png",
        "C:\\Users\\me\\cup\\images\\f{}.png",
        "/home/me/cup/images/f{}.png",
        "../cup/images/f{}.png",
        "images/f{}.PNG",
        "/home/me/cup/images/f{}",
    ],
)
def test_paths_of_the_machine_that_wrote_it(tmp_path, written):
    """Of Windows, absolute, or from another folder: the end that is there counts."""
    folder = write_transforms(tmp_path / "cup")
    for name in ("f3.png", "shade.png"):  # a shorter end, a mask
        shutil.copy(folder / "images/f0.png", folder / name)
    (folder / "images" / "f6.png").rename(tmp_path / "f6.png")  # outside of the capture

    def change(content):
        for view, frame in enumerate(content["frames"]):
            frame["file_path"] = written.format(view) if view != 6 else str(tmp_path / "f6.png")
            frame["mask_path"] = "D:\\cup\\shade.png"

    edit(folder, change)
    scene = load_scene(folder)
    assert scene.test.names == ("f0.png",) and len(scene.train) == 7 and "f6.png" not in scene.train.names
    np.testing.assert_allclose(scene.train.photos.image(2)[0, 0] * 255, [30, 200, 30], atol=1e-4)
    assert "masks of 8 of 8 photos" in " ".join(scene.notes)


def test_files_that_are_not_such_json(tmp_path):
    folder = write_transforms(tmp_path / "cup")
    for text in ("", "[1, 2", "[" * 100_000, "\x00\xff", "3"):
        (folder / "transforms.json").write_text(text, encoding="latin-1")
        assert_refused(r"is not valid JSON|cannot read|no list of frames", load_scene, folder)


def test_frames_without_a_photo_are_left_out_and_counted(tmp_path):
    folder = write_transforms(tmp_path / "cup")
    for view in (1, 4):
        (folder / "images" / f"f{view}.png").unlink()
    edit(folder, lambda content: content["frames"][4].pop("transform_matrix"))  # nothing is asked of what is left out
    scene = load_scene(folder)
    assert (*scene.test.names, *scene.train.names) == tuple(f"f{view}.png" for view in (0, 2, 3, 5, 6, 7, 8))
    assert scene.notes[0].endswith(": 7 photos") and len(scene.points) == 50_000 and scene.drawn_points
    assert scene.notes[1] == "2 of 9 images are left out, their photos do not exist: images/f1.png, images/f4.png"


@pytest.mark.parametrize(
    ("written", "lie"),
    [
        ("images/f{}.png", "f{}.png"),
        ("images/f{}.png", "rgb/f{}.png"),
        ("images/f{}.jpg", "DJI_001/f{}.PNG"),
        ("/home/me/all/f{}", "out/rgb/f{}.png"),
        ("..\\photos\\f{}.png", "images/f{}.png"),
        ("all/cam{}/f.png", "rgb/cam{}/f.png"),
    ],
)
def test_photos_in_another_folder_are_found_by_their_names(tmp_path, written, lie):
    folder = write_transforms(tmp_path / "cup", test_filenames=[written.format(3)])
    for view in range(9):
        (folder / lie.format(view)).parent.mkdir(parents=True, exist_ok=True)
        (folder / f"images/f{view}.png").rename(folder / lie.format(view))
    for beside in ("shade/f3.png", "depth/f3.png"):
        (folder / beside).parent.mkdir()
        shutil.copy(folder / lie.format(3), folder / beside)
    edit(folder, lambda content: [f.update(file_path=written.format(i)) for i, f in enumerate(content["frames"])])
    edit(folder, lambda content: content["frames"][3].update(mask_path="shade/f3.png"))
    scene = load_scene(folder)
    assert len(scene.train) == 8
    np.testing.assert_allclose(scene.test.photos.image(0)[0, 0] * 255, [30, 200, 30], atol=1e-4)


def test_photos_in_another_folder_that_may_be_others_are_not_taken(tmp_path):
    """Where a name has two files, or a file two names."""
    folder = write_transforms(tmp_path / "cup")
    (folder / "images").rename(folder / "old")
    (folder / "rgb").mkdir()
    shutil.copy(folder / "old/f2.png", folder / "rgb")
    left_out = "1 of 9 images are left out, their photos do not exist: images/f2.png"
    assert left_out in load_scene(folder).notes
    (folder / "rgb/f2.png").unlink()
    assert len(load_scene(folder).train) == 7
    edit(folder, lambda content: content["frames"][1].update(file_path="other/f0.png"))
    gone = "images/f0.png, other/f0.png"
    assert f"2 of 9 images are left out, their photos do not exist: {gone}" in load_scene(folder).notes


def test_neighbours_with_another_suffix_that_are_no_photos(tmp_path):
    """Not what another frame names, or one of two."""
    folder = write_transforms(tmp_path / "cup")
    photo = (folder / "images/f4.png").read_bytes()
    (folder / "images/f4.png").rename(folder / "images/f4.jpg")
    left_out = "1 of 9 images are left out, their photos do not exist: images/f4.png"
    assert load_scene(folder).notes[1].startswith("1 photos are not where transforms.json says: images/f4.jpg")
    (folder / "images/f4.JPEG").write_bytes(photo)
    assert load_scene(folder).notes[1] == f"{left_out}; 2 photos are not used: images/f4.JPEG, images/f4.jpg"
    (folder / "images/f4.JPEG").unlink()
    edit(folder, lambda content: content["frames"].append({**content["frames"][0], "file_path": "images/f4.jpg"}))
    assert load_scene(folder).notes[1] == left_out.replace("of 9", "of 10")


@pytest.mark.parametrize(
    ("lists", "train", "test", "said"),
    [
        ({"train": (0, 1, 2, 3), "val": (4, 5), "test": (6, 7)}, "0123", "67", "): 6 photos, by its own split 4 for"),
        ({"train": (0, 1, 2, 3), "val": (4, 5)}, "0123", "45", "3 others not used): 6 photos, "),
        ({"train": (8, 1, 2)}, "128", "034567", "by its own split 3 for training, 6 for testing"),
        ({"test": (8,)}, "01234567", "8", "by its own split 8 for training, 1 for testing"),
        ({"test": (8,), "val": (7,)}, "0123456", "8", "1 others not used): 8 photos"),
        ({"train": (0, 1, 2), "val": (3, 4), "test": (3, 4)}, "012", "34", "4 others not used"),
    ],
)
def test_lists_of_file_names_are_the_split(tmp_path, lists, train, test, said):
    """As nerfstudio reads them; photos in neither part are not even looked for."""
    content = {f"{part}_filenames": listed(*views) for part, views in lists.items()}
    folder = write_transforms(tmp_path / "cup", **content)
    for view in set(range(9)) - {int(view) for view in train + test}:
        (folder / "images" / f"f{view}.png").unlink()
    scene = load_scene(folder, test_every=2)
    assert scene.train.names == tuple(f"f{view}.png" for view in train)
    assert scene.test.names == tuple(f"f{view}.png" for view in test)
    assert said in scene.notes[0]
