"""From photos to cameras, on rendered photos whose cameras are known; what is said of those that cannot be solved."""

import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from helpers.refusals import assert_one_line, assert_refused
from helpers.textured_corner import camera_centers, render_corner, write_photos
from PIL import Image

from turbogs_plugin.captures import load_scene
from turbogs_plugin.captures.load import holds_photos_alone
from turbogs_plugin.reconstruct import Solution, reconstruct, run, solver
from turbogs_plugin.reconstruct.ghosts import Agreement, consistent_groups

COUNT = 7


def noise(seed: int) -> Image.Image:
    """A photo of nothing that another one shows."""
    values = np.random.default_rng(seed).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    return Image.fromarray(values).resize((180, 120), Image.Resampling.BICUBIC)


@pytest.fixture(scope="module")
def solved(tmp_path_factory) -> tuple[Path, Solution]:
    """Photos of a corner, some of them stored sideways, and one of something else; and what came of them."""
    folder = tmp_path_factory.mktemp("reconstruct")
    photos = folder / "corner" / "images"
    write_photos(photos, COUNT)
    for view in (2, 5):
        exif = Image.Exif()
        exif[0x0112] = 6
        turned = render_corner(camera_centers(COUNT)[view]).transpose(Image.Transpose.ROTATE_90)
        turned.save(photos / f"view_{view:02d}.jpg", quality=95, exif=exif)
    noise(5).resize((320, 240)).save(photos / "other.jpg")  # of the size of all
    (folder / "corner/registration.csv").write_text("#name,x,y,alt")
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
    assert np.linalg.norm(moved - true, axis=1).max() < 0.02  # the corner is 4 away
    (camera,) = model.cameras.values()
    assert (camera.model.name, camera.width, camera.height) == ("OPENCV", 320, 240)
    assert camera.focal_length_x == pytest.approx(300, rel=0.03)


def test_the_solution_says_what_was_done_and_names_what_did_not_register(solved):
    _, solution = solved
    assert (solution.photos, solution.registered, solution.left_out) == (COUNT + 1, COUNT, ["other.jpg"])
    text = solution.text()
    assert f"{COUNT + 1} photos matched each with each" in text and f"{COUNT} of {COUNT + 1} photos registered" in text
    assert "1 photo did not register: add photos between them and the others: other.jpg" in text
    assert "structure" not in text and "registration.csv is not read, which may have cameras of RealityScan" in text


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
    """A call that was stopped in the mapping: the next call keeps its features and matches."""
    photos, _ = solved
    few = tmp_path / "few"
    few.mkdir()
    for view in range(3):
        shutil.copy(photos / f"view_{view:02d}.jpg", few)

    def stop(*arguments) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(solver, "solve_cameras", stop)
        with pytest.raises(KeyboardInterrupt):
            reconstruct(few, tmp_path / "scene")
    database = tmp_path / "scene/reconstruction/features-doubled.db"
    with pycolmap.Database.open(database) as opened:
        before = opened.num_keypoints(), opened.num_matches(), len(opened.read_all_cameras())
        opened.delete_matches(1, 2)
        opened.delete_two_view_geometry(1, 2)
    assert reconstruct(few, tmp_path / "scene").registered == 3
    with pycolmap.Database.open(database) as opened:
        assert (opened.num_keypoints(), opened.num_matches(), len(opened.read_all_cameras())) == before


def test_other_photos_are_not_mixed_in(solved, tmp_path):
    photos, solution = solved
    fewer = shutil.copytree(photos, tmp_path / "fewer")
    (fewer / "other.jpg").unlink()
    assert_refused("begun with other photos.*choose a new --out, or delete it", reconstruct, fewer, solution.scene)
    changed = shutil.copytree(photos, tmp_path / "changed")
    (changed / "view_00.jpg").touch()
    assert_refused("begun with other photos, or they changed", reconstruct, changed, solution.scene)


def test_photos_that_cannot_be_solved_end_in_one_line_and_leave_nothing(tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    for number in range(3):
        noise(number).save(photos / f"{number}.jpg")
    said = "cameras were found for only 0 of 3 photos: take sharp photos that overlap"
    assert_refused(said, reconstruct, photos, tmp_path / "scene")
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


def test_a_full_disk_is_refused_and_a_failure_of_pycolmap_is_one_line(solved, tmp_path, monkeypatch):
    monkeypatch.setattr(solver, "extract_features", lambda database, *others: pycolmap.Database.open(tmp_path))
    assert_refused("database factory.*: make room .* repeat the call", reconstruct, solved[0], tmp_path / "scene")
    monkeypatch.setattr(shutil, "disk_usage", lambda place: SimpleNamespace(free=3 << 20))
    assert_refused("MiB .* has 3 MiB free: make room", reconstruct, solved[0], tmp_path / "new")
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]


def test_a_place_that_holds_something_else_is_refused(solved, tmp_path):
    photos, _ = solved
    (tmp_path / "file").write_text("x")
    assert_refused("holds something else", reconstruct, photos, tmp_path)
    assert_refused("would lie among the photos", reconstruct, photos, photos / "scene")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def solve_of(places: str) -> run.Solve:
    """A solve of photos on a line, each with 200 matches with its neighbours; photos at g agree with all others by 40.
    Its model is known by the places alone."""
    pairs = np.stack(np.triu_indices(len(places), 1), axis=1)
    near, alike = pairs[:, 1] - pairs[:, 0] < 3, np.array([places[first] == places[second] for first, second in pairs])
    matches, names = np.where(near, 200, 40), tuple(f"{view}.jpg" for view in range(len(places)))
    agreement = Agreement(names, pairs, np.where(near == alike, matches, 0), np.where(near == alike, 0, matches))
    return run.Solve(SimpleNamespace(places=places), agreement, consistent_groups(agreement))


@pytest.fixture
def attempts(monkeypatch, tmp_path):
    """Solves that are made up: each takes the next of the given models; the pairs that are taken out are noted."""

    def prepare(*models: str | None) -> tuple[list, list]:
        waiting, removed = list(models), []

        def attempt(*arguments):
            return (places := waiting.pop(0)) and solve_of(places)

        monkeypatch.setattr(run, "_attempt", attempt)
        monkeypatch.setattr(solver, "without_pairs", lambda database, copy, pairs: removed.append(pairs))
        return removed, [tmp_path / "some.db", tmp_path, tmp_path]

    return prepare


GOOD, GHOST = "oooooooooo", "gggooooooo"


def test_a_ghost_is_solved_again_without_the_pairs_that_made_it(attempts):
    removed, places = attempts(GHOST, GOOD)
    best, moved = run._solve(*places)
    assert best.model.places == GOOD and best.ghosts == [] and moved == ["0.jpg", "1.jpg", "2.jpg"]
    (pairs,) = removed
    assert pairs and all((first < "3") != (second < "3") for first, second in pairs)


@pytest.mark.parametrize("outcome", [None, GHOST])
def test_a_repair_that_fails_leaves_the_first_solve_with_its_ghosts_named(attempts, outcome):
    removed, places = attempts(GHOST, outcome)
    best, moved = run._solve(*places)
    assert (best.model.places, moved, len(removed)) == (GHOST, [], 1) and best.ghosts == ["0.jpg", "1.jpg", "2.jpg"]


@pytest.mark.parametrize(("side", "efforts"), [(800, [True]), (1200, [False, True])])
def test_where_too_few_photos_register_more_features_are_looked_for(monkeypatch, tmp_path, side, efforts):
    """Small photos, in which there is little to find, begin with more."""
    for number in range(3):
        Image.new("RGB", (side, side // 2)).save(tmp_path / f"{number}.jpg")
    done = []
    monkeypatch.setattr(solver, "extract_features", lambda *arguments: done.append(arguments[3]))
    monkeypatch.setattr(solver, "read_positions", lambda database, names: np.full((3, 2), np.nan))
    monkeypatch.setattr(solver, "match_features", lambda *arguments: None)
    monkeypatch.setattr(solver, "solve_cameras", lambda *arguments: [])
    assert_refused("only 0 of 3 photos", reconstruct, tmp_path, tmp_path / "../scene")
    assert done == efforts


def test_a_small_part_of_the_photos_is_not_taken_for_the_scene(monkeypatch, solved, tmp_path):
    monkeypatch.setattr(run, "_solve", lambda *arguments: (solve_of("ooo"), []))
    for name in ("extract_features", "match_features"):
        monkeypatch.setattr(solver, name, lambda *arguments: None)
    monkeypatch.setattr(solver, "read_positions", lambda database, names: np.full((8, 2), np.nan))
    assert_refused("only 3 of 8 photos: take sharp photos", reconstruct, solved[0], tmp_path / "scene")


def test_photos_at_a_ghost_are_taken_out_of_the_model(solved, tmp_path, monkeypatch):
    """The matches are made to say so of two photos."""

    def groups(agreement: Agreement) -> list[list[int]]:
        return [[1, 2, 3, 4, 6], [0, 5]]

    monkeypatch.setattr(run, "consistent_groups", groups)
    monkeypatch.setattr(solver, "without_pairs", lambda database, copy, pairs: shutil.copy(database, copy))
    scene = shutil.copytree(solved[1].scene, tmp_path / "scene")
    (scene / "reconstruction/solution.json").unlink()
    solution = reconstruct(solved[0], scene)
    model = pycolmap.Reconstruction(scene / "sparse/0")
    names = {image.name for image in model.images.values() if image.has_pose}
    assert solution.registered == len(names) == COUNT - 2 and not names & {"view_00.jpg", "view_05.jpg"}
    assert solution.left_out == ["other.jpg", "view_00.jpg", "view_05.jpg"]
    assert "2 photos left out, as more matches contradict their place" in solution.text()


def test_matches_agree_with_the_cameras_that_were_solved_and_not_with_moved_ones(solved):
    _, solution = solved
    database = solution.scene / "reconstruction/features-doubled.db"
    model = pycolmap.Reconstruction(solution.scene / "sparse/0")
    agreement = solver.measure_agreement(model, database)
    assert agreement.names == tuple(f"view_{view:02d}.jpg" for view in range(COUNT))
    assert agreement.agreeing.sum() > 50 * agreement.contradicting.sum()
    assert consistent_groups(agreement) == [list(range(COUNT))]
    (moved,) = (image for image in model.images.values() if image.name == "view_00.jpg")
    pose = moved.cam_from_world()
    pose.translation += np.array([1.5, 0.5, 0.0])
    moved.frame.rig_from_world = pose
    assert consistent_groups(solver.measure_agreement(model, database)) == [list(range(1, COUNT)), [0]]


def test_train_finds_the_cameras_of_photos_first(solved, tmp_path, turbogs, monkeypatch):
    """Cameras are there already: `reconstruct` itself is tested above."""
    photos, solution = solved
    shutil.copytree(solution.scene, tmp_path / "corner-scene")
    monkeypatch.setattr(run, "solver", None)
    short = ("train.iterations=2", "train.sh_degree=0", "train.refine_cameras=false", "train.backdrop=false")
    options = ("--no-report", "--device", "cpu", "--factor", "8")
    code, _, err = turbogs("train", photos, "--out", tmp_path / "run", *options, *short)
    assert code == 0, err
    said = f"{photos} has photos alone: their cameras are found first, into {tmp_path / 'corner-scene'}"
    assert err.splitlines()[: 1 + len(solution.notes)] == [said, *solution.notes]
    assert f"path: {tmp_path / 'corner-scene'}" in (tmp_path / "run/config.yaml").read_text()


def test_commands_say_in_one_line_what_is_lacking(solved, tmp_path, turbogs, monkeypatch):
    """A bad option of train is told before cameras are looked for."""
    photos, few = solved[0], tmp_path / "photos"
    few.mkdir()
    Image.new("RGB", (64, 48)).save(few / "a.jpg")
    monkeypatch.setattr(run, "_begin", lambda *arguments: pytest.fail("cameras were looked for"))
    for words, said in (
        (("train", photos, "--out", tmp_path / "run", "--init", "absent.ply"), "absent.ply"),
        (("plan", photos), "turbogs reconstruct"),
        (("reconstruct", few, "--out", tmp_path / "scene"), "has 1 photos: at least 3 are needed"),
    ):
        assert_one_line(turbogs(*words), said)
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


def test_masks_go_with_their_photos(solved, tmp_path, monkeypatch):
    """Masks of photos that are stored sideways are sideways, too."""
    photos = Path(shutil.copytree(solved[0].parent, tmp_path / "corner")) / "images"
    scene = shutil.copytree(solved[1].scene, tmp_path / "scene")
    monkeypatch.setattr(run, "solver", None)
    (tmp_path / "corner/masks").mkdir()
    upright = np.full(render_corner(camera_centers(COUNT)[0]).size[::-1], 255, np.uint8)
    upright[:, :20] = 0
    for view in range(COUNT):
        turn = Image.Transpose.ROTATE_90 if view == 2 else None  # photo 5 is sideways, and its mask upright
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


def test_a_reconstruction_in_parts_is_not_taken_for_photos_alone(solved, tmp_path):
    scene = shutil.copytree(solved[1].scene, tmp_path / "scene")
    (scene / "sparse/0/points3D.bin").unlink()
    assert not any(map(holds_photos_alone, (scene, scene / "images", tmp_path)))  # give the capture, says a line
    assert holds_photos_alone(solved[0].parent)


def test_a_scene_is_made_once_by_two_calls(solved, tmp_path, monkeypatch):
    photos, scene, waiting = solved[0], tmp_path / "scene", []

    def make(*arguments) -> Solution:
        waiting.append(pool.submit(reconstruct, photos, scene))
        shutil.copytree(solved[1].scene / "sparse", scene / "sparse")
        shutil.copy(solved[1].scene / "reconstruction/solution.json", scene / "reconstruction")
        return solved[1]

    monkeypatch.setattr(run, "_reconstruct", make)
    with ThreadPoolExecutor() as pool:
        assert reconstruct(photos, scene) == solved[1]
    (second,) = waiting
    assert second.result().registered == COUNT
