"""Models trained anywhere: a start for training, and evaluated, rendered and exported with a capture named."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from gsplat import export_splats
from helpers.framework_runs import assert_identical, tiny_config, tiny_trainer
from helpers.models import random_gaussians
from helpers.refusals import assert_one_line, assert_refused
from PIL import Image
from scipy.spatial.transform import Rotation

from turbogs_plugin.captures.undistort import load_pycolmap
from turbogs_plugin.commands.options import GivenOptions
from turbogs_plugin.engine.reference.projection import drawable_rows, project_rows
from turbogs_plugin.engine.render import render_image
from turbogs_plugin.errors import InputError
from turbogs_plugin.model import placement
from turbogs_plugin.model.placement import TRANSFORMS, TURNS, gsplat_worlds
from turbogs_plugin.model.ply import read_ply, save_ply
from turbogs_plugin.model.similarity import Similarity
from turbogs_plugin.model.spz import save_spz
from turbogs_plugin.scene import Frame
from turbogs_plugin.train import run
from turbogs_plugin.train.checkpoint import latest_checkpoint
from turbogs_plugin.train.history import read_history
from turbogs_plugin.train.saved_model import load_given, load_model
from turbogs_plugin.train.training_state import initial_gaussians
from turbogs_plugin.types import Gaussians
from turbogs_plugin.viewer.show import open_state

CPU = torch.device("cpu")
LENGTH = ("train.iterations=18", "train.refine_until=9", "train.evaluate_at=[]")


@pytest.fixture(scope="module")
def finished(capture, tmp_path_factory) -> Path:
    """The folder of a run that has learnt something, with all its bands in use."""
    config = tiny_config(capture, *LENGTH)
    return run.train(config, tmp_path_factory.mktemp("given-runs") / "run").folder.path


@pytest.fixture(scope="module")
def trained(finished) -> Gaussians:
    """Its model, in the frame of its scene. Not to be changed."""
    return load_model(finished, CPU).gaussians


@pytest.fixture
def model(finished) -> Gaussians:
    """As it was written, in the capture's coordinates."""
    return read_ply(finished / "model.ply")[0]


def save_splats(path: Path, gaussians: Gaussians, **others) -> Path:
    """As gsplat's simple_trainer does: the state of a ParameterDict."""
    splats = torch.nn.ParameterDict({name: torch.nn.Parameter(value.float()) for name, value in gaussians.items()})
    torch.save({"step": 6999, "splats": splats.state_dict(), **others}, path)
    return path


def worlds_of(capture: Path):
    """gsplat's worlds, from what pycolmap reads."""
    solved = load_pycolmap().Reconstruction(capture / "sparse/0")
    viewmats = [np.r_[image.cam_from_world().matrix(), [[0, 0, 0, 1]]] for image in solved.images.values()]
    return gsplat_worlds(np.array(viewmats), np.array([point.xyz for point in solved.points3D.values()]))


def table(text: str) -> str:
    """The lines of an evaluation that depend on the model alone."""
    return text.partition("\n\n")[0]


def assert_alike(a: Gaussians, b: Gaussians) -> None:
    for (name, value), (_, other) in zip(a.items(), b.items(), strict=True):
        torch.testing.assert_close(value, other, msg=name, rtol=1e-4, atol=1e-5)


def test_a_given_model_has_the_tables_and_pictures_of_its_run(turbogs, finished, model, capture, tmp_path):
    """In every form in which it can be given: ours, gsplat's two, a checkpoint."""
    asked, pictures = table(turbogs("eval", finished, "--device", "cpu")[1]), tmp_path / "pictures"
    theirs = tmp_path / "gsplat.ply"
    export_splats(**{name: value.float() for name, value in model.items()}, save_to=str(theirs))
    pt, checkpoint = save_splats(tmp_path / "ckpt_6999_rank0.pt", model), latest_checkpoint(finished / "checkpoints")
    for file in (finished / "model.ply", theirs, pt, checkpoint):
        code, out, error = turbogs("eval", file, "--scene", capture, "--device", "cpu")
        assert (code, table(out), error) == (0, asked, "")
        assert f"{file}, " in out
    assert turbogs("render", finished, "--device", "cpu")[0] == 0
    given = ("--scene", capture, "--out", pictures, "--device", "cpu")
    assert turbogs("render", finished / "model.ply", *given)[0] == 0
    ours, theirs = (sorted(folder.glob("test/*.png")) for folder in (finished / "renders", pictures))
    assert ours and len(ours) == len(theirs)
    for pair in zip(ours, theirs, strict=True):
        assert np.abs(np.subtract(*(np.asarray(Image.open(path), int) for path in pair))).mean() < 0.1


@pytest.mark.parametrize("world", range(4))
def test_a_model_of_gsplats_normalised_world_is_brought_back(trained, model, scene, capture, tmp_path, world):
    """Whichever half turn gsplat's version and linear algebra made of it."""
    loaded = load_given(save_splats(tmp_path / "ckpt.pt", worlds_of(capture)[world].apply(model)), scene, "gsplat")[0]
    for name in ("means", "scales", "opacities", "sh0", "shN"):
        torch.testing.assert_close(getattr(loaded, name), getattr(trained, name), rtol=1e-3, atol=1e-3)
    aligned = torch.nn.functional.cosine_similarity(loaded.quats, trained.quats).abs()
    torch.testing.assert_close(aligned, torch.ones_like(aligned))


def test_the_world_is_said_by_a_setting_in_training_and_evaluation(turbogs, finished, trained, model, scene, tmp_path):
    capture = run.RunFolder(finished).read_config().scene.path
    file = save_splats(tmp_path / "ckpt.pt", worlds_of(Path(capture))[2].apply(model))
    start = tiny_trainer(scene, f"train.init={file}", "train.init_world=gsplat", "train.sh_degree=1").gaussians
    torch.testing.assert_close(start.means, trained.means, atol=1e-3, rtol=0)
    calls = (("eval", file, "--scene", capture, "train.init_world=gsplat"), ("eval", finished))
    told = (turbogs(*call, "--device", "cpu")[1] for call in calls)
    measured, expected = (float(re.search(r"mean of 1\W+([\d.]+)", text)[1]) for text in told)
    assert measured == pytest.approx(expected, abs=0.2)
    checkpoint = latest_checkpoint(finished / "checkpoints")  # knows its frame
    assert_alike(load_given(checkpoint, scene, "gsplat")[0], trained)


@pytest.mark.parametrize("turn", TURNS)
def test_nerfstudios_file_beside_a_model_brings_it_back(trained, model, scene, tmp_path, turn):
    """A model of COLMAP's own coordinates, of those of `ns-process-data`, or not of nerfstudio at all."""
    change = Similarity(Rotation.from_euler("xyz", (0.4, -1.1, 0.2)).as_matrix(), 0.3, np.array([0.1, -0.2, 0.3]))
    values = {"transform": np.c_[change.rotation, change.translation / 0.3].tolist(), "scale": 0.3}
    (tmp_path / TRANSFORMS).write_text(json.dumps(values))
    theirs = Similarity(turn, 1.0, np.zeros(3)).inverse()
    for given in (change.after(theirs).apply(model), model):
        loaded = load_given(save_splats(tmp_path / "a.pt", given), scene)[0]
        torch.testing.assert_close(loaded.means, trained.means, rtol=1e-3, atol=1e-3)
    (tmp_path / TRANSFORMS).write_text(json.dumps(values | {"scale": 0}))
    assert_refused(TRANSFORMS, load_given, tmp_path / "a.pt", scene)


def test_a_model_in_other_coordinates_is_said_not_to_fit(model, scene, tmp_path, monkeypatch):
    monkeypatch.setattr(placement, "FEWEST_POINTS", 50)
    monkeypatch.setattr(placement, "FARTHEST_POINTS", 0.3)  # of a tiny capture, whose points lie far apart
    change = Similarity(Rotation.from_euler("x", 0.7).as_matrix(), 0.31, np.array([0.1, -0.2, 0.3]))
    with pytest.warns(UserWarning, match="does not fit the points"):
        load_given(save_splats(tmp_path / "a.pt", change.apply(model)), scene)


def test_the_spz_of_splat_transform_is_turned_back(trained, model, scene, tmp_path):
    turned = Similarity(np.diag([-1.0, 1.0, -1.0]), 1.0, np.zeros(3)).apply(model)
    for given in (turned, model):
        save_spz(given.map(torch.Tensor.float), tmp_path / "a.spz", Frame(np.zeros(3), 1.0))
        assert (load_given(tmp_path / "a.spz", scene)[0].means - trained.means).abs().max() < 1e-3


def test_a_model_of_antialiased_training_is_drawn_as_it_was_trained(trained, scene, capture, tmp_path):
    save_ply(trained, tmp_path / "a.ply", scene.frame, antialiased=True)
    state = open_state(tmp_path / "a.ply", CPU, GivenOptions(scene=capture).settings(()))
    seen = render_image(state.gaussians, scene.test.cameras, **state.look.options).colors
    rows = drawable_rows(state.gaussians, scene.test.cameras, state.look.settings)
    splats = project_rows(rows, rows.take(state.gaussians), scene.test.cameras, 0, state.look.settings)
    thinner = rows.take(state.gaussians)
    thinner.opacities, thinner.shN = torch.logit(splats.opacities * splats.shares), thinner.shN[rows.gaussians]
    plainly = state.look.options | {"antialiased": False}
    torch.testing.assert_close(seen, render_image(thinner, scene.test.cameras, **plainly).colors)
    assert (seen - render_image(state.gaussians, scene.test.cameras, **plainly).colors).abs().max() > 0.01
    with pytest.warns(UserWarning, match="antialiased training"):
        tiny_trainer(scene, f"train.init={tmp_path / 'a.ply'}")


def test_the_newest_model_in_folders_of_other_trainers(model, scene, tmp_path):
    for folder, name in (("inria/point_cloud/iteration_{}", "point_cloud.ply"), ("gsplat/ckpts", "ckpt_{}_rank0.pt")):
        for number, count in ((7000, 5), (30000, 9)):
            file = tmp_path / folder.format(number) / name.format(number)
            file.parent.mkdir(parents=True, exist_ok=True)
            part = model.map(lambda value, count=count: value[:count].float())
            save_splats(file, part) if file.suffix == ".pt" else save_ply(part, file)
        found = tmp_path / folder.partition("/")[0]
        assert len(load_given(found, scene)[0]) == 9
        assert open_state(found, CPU).gaussians.means.shape[0] == 9


def test_rows_that_are_not_finite_are_left_out_and_counted_once(trained, model, scene, tmp_path):
    kept = torch.ones(len(model), dtype=torch.bool)
    kept[[2, 5, 9]] = False
    model.means[2, 1], model.opacities[5], model.shN[9, 0, 0] = torch.nan, torch.nan, -torch.inf
    file = save_splats(tmp_path / "ckpt.pt", model)
    with pytest.warns(UserWarning) as warned:
        loaded = load_given(file, scene)[0]
    assert [str(w.message) for w in warned] == [f"{file}: 3 of {len(model)} Gaussians are not finite and left out"]
    assert_alike(loaded, trained.map(lambda value: value[kept]))


def test_ranks_of_one_model_are_put_together(trained, model, scene, tmp_path):
    half = len(model) // 2
    first = save_splats(tmp_path / "ckpt_6999_rank0.pt", model.map(lambda value: value[:half]))
    save_splats(tmp_path / "ckpt_6999_rank1.pt", model.map(lambda value: value[half:]))
    save_splats(tmp_path / "ckpt_29999_rank1.pt", model)
    assert_alike(load_given(first, scene)[0], trained)


def test_training_starts_from_a_model_where_that_had_ended_and_goes_on_without_it(finished, capture, tmp_path):
    start = Path(shutil.copy(finished / "model.ply", tmp_path / "start.ply"))
    short = ("train.iterations=6", "train.refine_until=5", "train.checkpoint_every=3", "train.evaluate_at=[]")
    whole = run.train(tiny_config(capture, f"train.init={start}", *short), tmp_path / "whole")
    ended = read_history(finished / "history.jsonl")[-1]
    assert whole.history[0].psnr == pytest.approx(ended.psnr, abs=0.01)
    assert whole.history[0].num_gaussians == ended.num_gaussians
    assert Path(whole.folder.read_config().train.init) == start
    shutil.copytree(tmp_path / "whole", tmp_path / "stopped")
    (tmp_path / "stopped/checkpoints/iteration-000006.pt").unlink()
    start.unlink()
    resumed = run.resume(tmp_path / "stopped")
    assert resumed.resumed
    assert_identical(dict(whole.trainer.gaussians.items()), dict(resumed.trainer.gaussians.items()))


def test_a_model_that_is_larger_than_the_cap_is_refused(finished, scene):
    with pytest.raises(InputError, match=r"more than density\.max_gaussians 100 allows.*start from points"):
        tiny_trainer(scene, f"train.init={finished}", "density.max_gaussians=100")
    assert_refused("no room beside the 3000", tiny_trainer, scene, "density.max_gaussians=3000", "train.backdrop=true")


@pytest.mark.parametrize("words", ["eval", "view", "render", "export", "render --path views --out NEW.mp4"])
def test_a_runs_folder_is_refused_beside_a_capture(turbogs, finished, capture, tmp_path, words):
    verb, *options = words.replace("NEW", str(tmp_path / "new")).split()
    call = (verb, finished, *options, "--scene", capture)
    assert_one_line(turbogs(*call), f"'{finished}' is a run's folder", "leave --scene out", "scene.path")


BAD_FILES = {
    "absent.ply": (None, "no such model"),
    "model.obj": (b"x", "a .ply, .spz or gsplat's .pt"),
    "empty": ("a folder", "without a checkpoint of a run"),
    "weights.pt": ({"conv1": torch.zeros(3), "bias": torch.zeros(1)}, "bias, conv1"),
    "code.pt": ({"splats": Path("x")}, "more than plain tensors"),
    "nan.pt": ({"splats": dict(random_gaussians(5).map(lambda value: value * torch.nan).items())}, "none of its 5"),
    "m.sog": (b"x", "splat-transform"),
    "m.ckpt": (b"x", "ns-export"),
    "m.pth": (b"x", "point_cloud.ply"),
    "text.spz": (b"text", "cannot read"),
}
"""Name -> what is in it, and words of the answer."""


@pytest.mark.parametrize("name", BAD_FILES)
def test_what_is_no_model_is_one_line(turbogs, capture, tmp_path, name):
    (content, words), file, out = BAD_FILES[name], tmp_path / name, tmp_path / "out"
    if isinstance(content, bytes):
        file.write_bytes(content)
    elif content == "a folder":
        file.mkdir()
    elif content is not None:
        torch.save(content, file)
    calls = [("eval", file, "--scene", capture)]
    if content is None:
        calls += [("train", capture, "--init", file, "--out", out)]
        calls += [(verb, file, "--scene", capture, "--out", f"{out}.ply") for verb in ("render", "export")]
    for call in calls:
        assert_one_line(turbogs(*call), words, file)
        assert not list(tmp_path.glob("out*"))


@pytest.mark.parametrize(("shift", "refused"), [(0.0, False), (100.0, True)])
def test_a_plain_cloud_is_a_start(capture, scene, tmp_path, shift, refused):
    """A Gaussian for each finite point, in the capture's coordinates; a cloud in another frame is refused."""
    points = np.repeat(scene.frame.restore_points(scene.points.numpy()) + shift, 2, axis=0)
    colors = np.repeat(scene.point_colors.numpy(), 2, axis=0)
    cloud = trimesh.PointCloud(np.r_[points, [[np.nan] * 3]], np.r_[colors, [[1, 2, 3]]])
    cloud.export(tmp_path / "lidar.ply")
    config = tiny_config(capture, f"train.init={tmp_path / 'lidar.ply'}").without_plan()
    if refused:
        assert_refused("the cameras see no points", initial_gaussians, scene, config, config.train.init)
        config.scene.force = True
    model = initial_gaussians(scene, config, config.train.init)
    torch.testing.assert_close(model.means, torch.from_numpy(scene.frame.normalise_points(points)).float())
    assert len(model) == 2 * len(scene.points)
