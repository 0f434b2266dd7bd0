"""From photos to cameras, on rendered photos whose cameras are known; what is said of those that cannot be solved."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from helpers.refusals import assert_refused
from helpers.textured_corner import camera_centers, render_corner, write_photos
from PIL import Image

from turbogs_plugin.captures import load_scene
from turbogs_plugin.captures.kinds import holds_photos_alone
from turbogs_plugin.errors import InputError
from turbogs_plugin.reconstruct import Solution, reconstruct, run, scene_beside, solver
from turbogs_plugin.reconstruct.agreement import Agreement, consistent_groups
from turbogs_plugin.reconstruct.effort import DEFAULTS, DOUBLED, QUICK, efforts_for
from turbogs_plugin.reconstruct.photos import read_photos
from turbogs_plugin.reconstruct.workspace import Workspace

COUNT = 7


def noise(seed: int) -> Image.Image:
    """A photo of nothing that another one shows."""
    values = np.random.default_rng(seed).integers(0, 256, (60, 80, 3), dtype=np.uint8)
    return Image.fromarray(values).resize((320, 240), Image.Resampling.BICUBIC)


@pytest.fixture(scope="module")
def solved(tmp_path_factory) -> tuple[Path, Solution]:
    """Photos of a corner, some of them stored sideways, and one of something else; and what came of them."""
    folder = tmp_path_factory.mktemp("reconstruct")
    photos = folder / "corner" / "images"
    write_photos(photos, COUNT)
    for view in (2, 5):
        exif = Image.Exif()
        exif[0x0112] = 6
        path = photos / f"view_{view:02d}.jpg"
        render_corner(camera_centers(COUNT)[view]).transpose(Image.Transpose.ROTATE_90).save(
            path, quality=95, exif=exif
        )
    noise(5).save(photos / "other.jpg")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solver, "MANY", COUNT + 1)  # enough for OPENCV's camera model
        return photos, reconstruct(photos, folder / "scene")


def test_cameras_are_where_the_photos_were_taken_from(solved):
    _, solution = solved
    model = pycolmap.Reconstruction(solution.scene / "sparse/0")
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    assert [image.name for image in images] == [f"view_{view:02d}.jpg" for view in range(COUNT)]
    found = np.array([image.projection_center() for image in images])
    true = camera_centers(COUNT)
    moved = np.array([pycolmap.estimate_sim3d(found, true) * center for center in found])
    assert np.linalg.norm(moved - true, axis=1).max() < 0.02  # of 4 from the corner
    (camera,) = model.cameras.values()
    assert (camera.model.name, camera.width, camera.height) == ("OPENCV", 320, 240)
    assert camera.focal_length_x == pytest.approx(300, rel=0.03)


def test_the_solution_says_what_was_done_and_names_what_did_not_register(solved):
    _, solution = solved
    assert (solution.photos, solution.registered, solution.left_out) == (COUNT + 1, COUNT, ["other.jpg"])
    text = solution.text()
    assert f"{COUNT + 1} photos of 1 lens, 2 turned upright by EXIF; matched each with each" in text
    assert (
        f"{COUNT} of {COUNT + 1} photos registered" in text
        and "1 photo did not register: other.jpg; add photos between it and" in text
    )
    assert "ghost" not in text and "wrong place" not in text


def test_the_scene_loads(solved):
    _, solution = solved
    scene = load_scene(solution.scene)
    assert len(scene.train) + len(scene.test) == COUNT and len(scene.points) == solution.points > 300
    assert scene.train.photos.sizes[0].tolist() == pytest.approx([320, 240], abs=6)


def test_a_second_call_tells_the_solution_again(solved, monkeypatch):
    photos, solution = solved
    monkeypatch.setattr(run, "solver", None)
    assert reconstruct(photos, solution.scene) == solution


def test_a_stopped_call_is_gone_on_with(solved, tmp_path, monkeypatch):
    """Stopped in the mapping: features and matches are those of the first call, and the cameras come out the same."""
    photos, _ = solved
    few = tmp_path / "few"
    few.mkdir()
    for view in range(4):
        shutil.copy(photos / f"view_{view:02d}.jpg", few)

    def stop(*arguments) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(solver, "solve_cameras", stop)
        with pytest.raises(KeyboardInterrupt):
            reconstruct(few, tmp_path / "scene")
    database = Workspace(tmp_path / "scene").database(DOUBLED)
    with pycolmap.Database.open(database) as opened:
        before = opened.num_keypoints(), opened.num_matches(), len(opened.read_all_cameras())
        opened.delete_matches(1, 2)
        opened.delete_two_view_geometry(1, 2)
    assert reconstruct(few, tmp_path / "scene").registered == 4
    with pycolmap.Database.open(database) as opened:
        assert (opened.num_keypoints(), opened.num_matches(), len(opened.read_all_cameras())) == before


def test_features_that_a_stopped_call_left_out_are_of_the_same_camera(solved, tmp_path):
    photos, solution = solved
    few, database = read_photos(photos)[1:4], tmp_path / "features.db"  # upright ones, of one lens
    for known in (few[:1], few):
        solver.extract_features(database, Workspace(solution.scene).images, known, DOUBLED)
    with pycolmap.Database.open(database) as opened:
        assert (len(opened.read_all_images()), len(opened.read_all_cameras())) == (3, 1)


def test_other_photos_are_not_mixed_in(solved, tmp_path):
    photos, solution = solved
    fewer = shutil.copytree(photos, tmp_path / "fewer")
    (fewer / "other.jpg").unlink()
    with pytest.raises(InputError, match=r"begun with other photos \(0 new, 1 gone, 0 changed since\)"):
        reconstruct(fewer, solution.scene)
    (fewer / "new.jpg").write_bytes((fewer / "view_00.jpg").read_bytes())
    (fewer / "view_00.jpg").touch()
    with pytest.raises(InputError, match=r"\(1 new, 1 gone, 1 changed since\)"):
        reconstruct(fewer, solution.scene)


def blank(folder: Path, size: tuple[int, int] = (320, 240)) -> str:
    for number in range(3):
        Image.new("RGB", size, (90, 90, 90)).save(folder / f"{number}.jpg")
    return "none of the 3 photos shows anything that could be found again"


def large_and_blank(folder: Path) -> str:
    """Nothing is found at the photos' size, and nothing at twice that."""
    return blank(folder, (1040, 16))


def of_different_things(folder: Path) -> str:
    for number in range(3):
        noise(number).save(folder / f"{number}.jpg")
    return "no cameras were found for 3 photos: of 3 pairs of photos 0 match; take photos that overlap"


def copies_of_one(folder: Path) -> str:
    for number in range(3):
        render_corner(camera_centers(COUNT)[3]).save(folder / f"{number}.jpg", quality=95)
    return "no cameras were found for 3 photos: 3 of 3 pairs match, but they show no depth, .*move between the photos"


@pytest.mark.parametrize("case", [blank, large_and_blank, of_different_things, copies_of_one])
def test_photos_that_cannot_be_solved_end_in_one_line_and_leave_nothing(case, tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    words = case(photos)
    assert_refused(words, reconstruct, photos, tmp_path / "deep" / "scene")
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


def test_a_place_that_holds_something_else_is_refused(solved, tmp_path):
    photos, _ = solved
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="holds something else"):
        reconstruct(photos, tmp_path)
    with pytest.raises(InputError, match="would lie among the photos"):
        reconstruct(photos, photos / "scene")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


class FakeModel:
    """A model of which only the photos and their places are known."""

    def __init__(self, places: str) -> None:
        self.places = places

    def num_reg_images(self) -> int:
        return len(self.places)


def agreement_of(places: str) -> Agreement:
    """Of photos on a line, each with 200 matches with its neighbours; those at g agree with the 12 others by 40."""
    rows = []
    for first in range(len(places)):
        for second in range(first + 1, len(places)):
            agree = places[first] == places[second]
            near = second - first < 3
            rows.append((first, second, (200 if near else 40), agree == near))
    table = np.array(rows)
    true, agree = table[:, 2], table[:, 3].astype(bool)
    names = tuple(f"{view}.jpg" for view in range(len(places)))
    return Agreement(names, table[:, :2], np.where(agree, true, 0), np.where(agree, 0, true))


@pytest.fixture
def attempts(monkeypatch, tmp_path):
    """Solves that are made up: each takes the next of the given models; the pairs taken out are noted, and what is said
    of each solve."""

    def prepare(*models: str | None) -> tuple[list, list, Path, Workspace]:
        waiting, removed, said = list(models), [], []

        def attempt(database, evidence, workspace, again):
            said.append(again)
            places = waiting.pop(0)
            if places is None:
                return None
            agreement = agreement_of(places)
            return run.Solve(FakeModel(places), (len(places),), agreement, consistent_groups(agreement))

        monkeypatch.setattr(run, "_attempt", attempt)
        monkeypatch.setattr(solver, "without_pairs", lambda database, copy, pairs: removed.append(pairs))
        return removed, said, tmp_path / "some.db", Workspace(tmp_path / "scene")

    return prepare


GOOD, GHOST = "oooooooooo", "gggooooooo"


def test_a_ghost_is_solved_again_without_the_pairs_that_made_it(attempts):
    removed, said, *places = attempts(GHOST, GOOD)
    best, moved = run._solve(*places, " again, with more features")
    assert said == [" again, with more features", " again, without the pairs that led to a ghost"]
    assert best.model.places == GOOD and best.ghosts == [] and moved == ["0.jpg", "1.jpg", "2.jpg"]
    (pairs,) = removed
    assert pairs and all((first < "3") != (second < "3") for first, second in pairs)


def test_a_repair_that_fails_leaves_the_first_solve_with_its_ghosts_named(attempts):
    for outcome in (None, GHOST):
        removed, _, *places = attempts(GHOST, outcome)
        best, moved = run._solve(*places)
        assert best.model.places == GHOST and moved == [] and len(removed) == 1
        assert best.ghosts == ["0.jpg", "1.jpg", "2.jpg"]


def test_a_solve_without_ghosts_is_taken_as_it_is(attempts):
    removed, _, *places = attempts(GOOD)
    best, moved = run._solve(*places)
    assert (best.model.places, moved, removed) == (GOOD, [], [])


def test_cameras_that_are_told_as_solved_are_those_of_the_largest_model(monkeypatch, tmp_path, capsys):
    """COLMAP begins many times where photos do not connect, and registers some each time."""

    def map_in_vain(*_, initial_image_pair_callback, next_image_callback, cancellation_token):
        for _ in range(40):
            initial_image_pair_callback()
            next_image_callback()
        return {0: FakeModel("ooo"), 1: FakeModel("oooo")}

    monkeypatch.setattr(pycolmap, "incremental_mapping", map_in_vain)
    models = solver.solve_cameras(tmp_path / "none.db", tmp_path, tmp_path / "scratch")
    assert [model.num_reg_images() for model in models] == [4, 3]
    assert capsys.readouterr().err.startswith("cameras solved: 4 in ")


def fake_steps(monkeypatch) -> tuple[list, list]:
    """Steps that do nothing: the efforts that features were looked for with, and what is said of each solve."""
    efforts, said = [], []
    monkeypatch.setattr(solver, "extract_features", lambda *arguments: efforts.append(arguments[3]))
    monkeypatch.setattr(solver, "match_features", lambda *arguments: None)
    monkeypatch.setattr(solver, "with_default_cameras", lambda *arguments: efforts.append(DEFAULTS))
    monkeypatch.setattr(solver, "read_names", lambda database: {"a"})
    monkeypatch.setattr(solver, "count_verified_pairs", lambda database: 3)

    def solve(database: Path, images: Path, scratch: Path, again: str) -> list:
        said.append(again)
        return []

    monkeypatch.setattr(solver, "solve_cameras", solve)
    return efforts, said


@pytest.mark.parametrize(
    ("side", "efforts", "said"),
    [
        (800, [DOUBLED, DEFAULTS], ["", DEFAULTS.again]),
        (1200, [QUICK, DOUBLED, DEFAULTS], ["", DOUBLED.again, DEFAULTS.again]),
    ],
)
def test_where_too_few_photos_register_more_is_done(monkeypatch, tmp_path, side, efforts, said):
    """Small photos begin with the second effort, as there is little to find in them."""
    for number in range(3):
        Image.new("RGB", (side, side // 2)).save(tmp_path / f"{number}.jpg")
    done, told = fake_steps(monkeypatch)
    with pytest.raises(InputError, match="no cameras were found for 3 photos"):
        reconstruct(tmp_path, tmp_path / "../scene")
    assert done == efforts and told == said and efforts_for(side) == tuple(efforts)


@pytest.mark.parametrize(("out", "word"), [(["a.jpg"], "it"), (["a.jpg", "b.jpg"], "them")])
def test_lines_about_one_photo_and_about_several(out, word):
    model = SimpleNamespace(num_points3D=lambda: 1, compute_mean_reprojection_error=lambda: 1.0)
    solve = run.Solve(model, (3, 3), agreement_of("ooo"), [[0, 1, 2]])
    matching = run.choose_matching(["0.jpg", "1.jpg", "2.jpg", *out], np.full((3 + len(out), 2), np.nan))
    (line,) = (note for note in run._notes([], matching, 3, solve, [], out) if "did not register" in note)
    assert ", 1 smaller model besides: " in line and line.endswith(f"; add photos between {word} and the others")


def test_photos_at_a_ghost_are_taken_out_of_the_model(solved, tmp_path):
    model = pycolmap.Reconstruction(solved[1].scene / "sparse/0")
    run._leave_out(model, ["view_00.jpg", "view_05.jpg"])
    model.write_binary(tmp_path)
    written = pycolmap.Reconstruction(tmp_path)
    names = {image.name for image in written.images.values() if image.has_pose}
    assert len(names) == COUNT - 2 and not names & {"view_00.jpg", "view_05.jpg"}


def test_scenes_that_do_not_connect_are_told_by_their_numbers():
    agreement = agreement_of("ooo")
    solve = run.Solve(FakeModel("ooo"), (3, 3, 3), agreement, [[0, 1, 2]])
    matching = run.choose_matching([f"{view}.jpg" for view in range(9)], np.full((9, 2), np.nan))
    with pytest.raises(InputError, match="9 photos fall into 3 scenes that do not connect, of 3, 3, 3 photos: add"):
        run._require_solved(solve, 9, 12, matching)
    alone = run.Solve(FakeModel("ooo"), (3,), agreement, [[0, 1, 2]])
    with pytest.raises(InputError, match=r"only 3 of 9 photos connect \(12 pairs match\)"):
        run._require_solved(alone, 9, 12, matching)
    run._require_solved(alone, 6, 12, matching)


def test_matches_agree_with_the_cameras_that_were_solved_and_not_with_moved_ones(solved):
    _, solution = solved
    workspace = Workspace(solution.scene)
    database = workspace.database(DOUBLED)
    model = pycolmap.Reconstruction(workspace.model)
    agreement = solver.measure_agreement(model, database)
    assert agreement.names == tuple(f"view_{view:02d}.jpg" for view in range(COUNT))
    assert agreement.agreeing.sum() > 50 * agreement.contradicting.sum()
    assert consistent_groups(agreement) == [list(range(COUNT))]
    (moved,) = (image for image in model.images.values() if image.name == "view_00.jpg")
    pose = moved.cam_from_world()
    pose.translation += np.array([1.5, 0.5, 0.0])
    moved.frame.rig_from_world = pose
    assert consistent_groups(solver.measure_agreement(model, database)) == [list(range(1, COUNT)), [0]]


def test_the_similar_photos_of_many_are_found_without_a_download(solved, tmp_path):
    """Each photo matched with the 3 most similar alone, as captures of many photos without an order are."""
    _, solution = solved
    workspace = Workspace(solution.scene)
    database = tmp_path / "features.db"
    shutil.copy(workspace.database(DOUBLED), database)
    with pycolmap.Database.open(database) as opened:
        opened.clear_matches()
        opened.clear_two_view_geometries()
    names = sorted(solver.read_names(database))
    solver.match_features(database, tmp_path, names, run.Matching(np.zeros((0, 2), dtype=np.int64), 3, "alike"))
    with pycolmap.Database.open(database) as opened:
        matched = len(opened.read_all_matches()[0])
    assert COUNT <= matched <= 3 * (COUNT + 1)
    assert solver.count_verified_pairs(database) >= COUNT - 1


def test_where_photos_are_left_colmaps_own_defaults_are_tried(solved):
    """They do not register the other photo either, so that the first solve stays."""
    workspace = Workspace(solved[1].scene)
    models = []
    for effort in (DOUBLED, DEFAULTS):  # the photos are small
        with pycolmap.Database.open(workspace.database(effort)) as opened:
            (camera,) = opened.read_all_cameras()
            models.append((camera.model.name, camera.width, camera.focal_length_x, opened.num_keypoints()))
    assert [model[0] for model in models] == ["OPENCV", "SIMPLE_RADIAL"] and models[0][1:] == models[1][1:]


def test_where_the_capture_of_a_run_lies(tmp_path):
    assert scene_beside(tmp_path / "garden", tmp_path / "runs/first") == tmp_path / "runs/garden-scene"
    assert scene_beside(tmp_path / "garden/images", tmp_path / "run") == tmp_path / "garden-scene"


def test_train_finds_the_cameras_of_photos_first(solved, tmp_path, turbogs, monkeypatch):
    """Here they are found already, by the run before: `reconstruct` itself is tested above."""
    photos, solution = solved
    shutil.copytree(solution.scene, tmp_path / "corner-scene")
    monkeypatch.setattr(run, "solver", None)
    short = ("train.iterations=2", "train.sh_degree=0", "train.evaluate_at=[]", "--factor", "4", "--device", "cpu")
    code, _, err = turbogs("train", photos, "--out", tmp_path / "run", "--no-report", *short)
    assert code == 0, err
    first, *others = err.splitlines()
    assert first == f"{photos} has photos alone: their cameras are found first, into {tmp_path / 'corner-scene'}"
    assert others[: len(solution.notes)] == list(solution.notes)
    assert f"path: {tmp_path / 'corner-scene'}" in (tmp_path / "run/config.yaml").read_text()


def test_bad_settings_are_refused_before_cameras_are_looked_for(solved, tmp_path, turbogs, monkeypatch):
    monkeypatch.setattr(run, "read_photos", lambda folder: pytest.fail("photos were read"))
    (tmp_path / "used").mkdir()
    (tmp_path / "used/file").write_text("x")
    for arguments in (("--out", tmp_path / "used"), ("--out", tmp_path / "run", "--init", "absent.ply")):
        code, out, err = turbogs("train", solved[0], *arguments, "--device", "cpu")
        assert (code, out) == (2, "") and err.count("\n") == 1, err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["used"]


def test_commands_that_cannot_look_for_cameras_say_what_does(solved, tmp_path, turbogs):
    photos, _ = solved
    code, out, err = turbogs("plan", photos, "--device", "cpu")
    assert (code, out) == (2, "") and err.count("\n") == 1
    assert f"{photos} has {COUNT + 1} photos and nothing" in err and "turbogs reconstruct" in err


def test_a_command_to_copy_is_right_for_folders_with_spaces(tmp_path, turbogs):
    photos = tmp_path / "my photos"
    photos.mkdir()
    for name in "abc":
        Image.new("RGB", (64, 48)).save(photos / f"{name}.jpg")
    code, _, err = turbogs("plan", photos, "--device", "cpu")
    assert code == 2 and f"turbogs reconstruct '{photos}' --out SCENE" in err


def test_the_command_refuses_in_one_line(tmp_path, turbogs):
    (tmp_path / "photos").mkdir()
    Image.new("RGB", (64, 48)).save(tmp_path / "photos/a.jpg")
    code, out, err = turbogs("reconstruct", tmp_path / "photos", "--out", tmp_path / "scene")
    assert (code, out) == (2, "") and err.count("\n") == 1 and "has 1 photo: at least 3 are needed" in err
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


@pytest.mark.parametrize("verb", ["train", "plan"])
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("few/a.jpg", "has 1 photo"),
        ("phone/IMG_1.HEIC", "nor photos; 1 file is of a kind that is not read (IMG_1.HEIC): convert to JPEG"),
        ("films/walk.mp4", "nor photos; walk.mp4 is a video: take photos out of it"),
        ("walk.mp4", "no such scene: walk.mp4 is a video"),
    ],
)
def test_what_is_no_capture_is_refused_in_one_line(tmp_path, turbogs, verb, name, message):
    place = tmp_path / "captures"
    (place / name).parent.mkdir(parents=True)
    Image.new("RGB", (64, 48)).save(place / name, format="JPEG")
    scene = place / name.partition("/")[0]
    out = ("--out", tmp_path / "runs" / "run") if verb == "train" else ()
    code, printed, err = turbogs(verb, scene, "--device", "cpu", *out)
    assert (code, printed) == (2, "") and err.count("\n") == 1 and message in err
    assert [path.name for path in tmp_path.iterdir()] == ["captures"]


def test_photos_that_are_not_read_are_noted(solved, tmp_path, monkeypatch):
    photos = Path(shutil.copytree(solved[0].parent, tmp_path / "photos"))
    (photos / "images" / "IMG_1.HEIC").write_bytes(b"x")
    monkeypatch.setattr(run, "_reconstruct", lambda found, workspace, others: others)
    assert (
        reconstruct(photos, tmp_path / "scene") == "1 file is of a kind that is not read (IMG_1.HEIC): convert to JPEG"
    )


def test_masks_go_with_their_photos(solved, tmp_path, monkeypatch):
    """Those of photos that are stored sideways are sideways too."""
    photos = Path(shutil.copytree(solved[0].parent, tmp_path / "corner")) / "images"
    scene = shutil.copytree(solved[1].scene, tmp_path / "scene")
    monkeypatch.setattr(run, "solver", None)
    (tmp_path / "corner/masks").mkdir()
    upright = np.full(render_corner(camera_centers(COUNT)[0]).size[::-1], 255, np.uint8)
    upright[:, :20] = 0
    for view in range(COUNT):
        turn = Image.Transpose.ROTATE_90 if view == 2 else None  # that of 5, also sideways, is upright already
        mask = Image.fromarray(upright)
        (mask.transpose(turn) if turn is not None else mask).save(tmp_path / f"corner/masks/view_{view:02d}.png")
    for _ in range(2):
        reconstruct(photos, scene)
    for view in range(COUNT):
        np.testing.assert_array_equal(Image.open(scene / f"masks/view_{view:02d}.png"), upright)
    loaded = load_scene(scene, factor=2)
    assert f"masks of {COUNT} of {COUNT} photos" in "".join(loaded.notes)
    shares = loaded.train.masks.pixel_counts / loaded.train.cameras.sizes.prod(axis=1)
    assert (shares < 0.95).all() and (shares > 0.5).all()
    shutil.rmtree(tmp_path / "corner/masks")
    reconstruct(photos, scene)
    assert not (scene / "masks").exists()


def test_masks_in_a_folder_of_another_name_are_noted(solved, tmp_path, monkeypatch):
    photos = Path(shutil.copytree(solved[0].parent, tmp_path / "corner")) / "images"
    scene = shutil.copytree(solved[1].scene, tmp_path / "scene")
    monkeypatch.setattr(run, "solver", None)
    before = reconstruct(photos, scene).notes
    (tmp_path / "corner/mask_images").mkdir()
    Image.new("L", (20, 10), 255).save(tmp_path / "corner/mask_images/view_00.png")
    said = "is not used: masks are read from masks/; rename it if it holds the photos' masks"
    assert reconstruct(photos, scene).notes == [*before, f"{tmp_path}/corner/mask_images {said}"]
    assert not (scene / "masks").exists()


def test_a_mask_of_another_size_is_refused_before_cameras_are_looked_for(solved, tmp_path, monkeypatch):
    photos = Path(shutil.copytree(solved[0].parent, tmp_path / "corner")) / "images"
    (tmp_path / "corner/masks").mkdir()
    Image.new("L", (20, 10), 255).save(tmp_path / "corner/masks/view_00.png")
    monkeypatch.setattr(run, "_reconstruct", lambda *_: pytest.fail("cameras were looked for"))
    with pytest.raises(InputError, match=r"mask .*view_00.png is 20x10 but photo .* is .*: make it of"):
        reconstruct(photos, tmp_path / "scene")
    assert not (tmp_path / "scene").exists()


def test_a_reconstruction_in_parts_is_not_taken_for_photos_alone(solved, tmp_path):
    scene = shutil.copytree(solved[1].scene, tmp_path / "scene")
    (scene / "sparse/0/points3D.bin").unlink()
    assert not holds_photos_alone(scene) and holds_photos_alone(scene / "images")
    assert holds_photos_alone(solved[0].parent) and not holds_photos_alone(tmp_path)
