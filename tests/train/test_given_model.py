"""Models trained anywhere: a start for training, and evaluated, rendered and exported with a capture named."""

import dataclasses
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from gsplat import export_splats
from helpers.framework_runs import tiny_config
from helpers.models import random_gaussians
from PIL import Image

from turbogs_plugin.captures import load_scene
from turbogs_plugin.captures.colmap import load_pycolmap
from turbogs_plugin.captures.starting_points import random_points
from turbogs_plugin.errors import InputError
from turbogs_plugin.model.formats import FORMATS
from turbogs_plugin.model.gsplat_world import gsplat_worlds
from turbogs_plugin.model.ply import read_ply
from turbogs_plugin.plan.decisions import wanted_backdrop
from turbogs_plugin.train import run
from turbogs_plugin.train.checkpoint import latest_checkpoint
from turbogs_plugin.train.given_model import load_given
from turbogs_plugin.train.saved_model import load_model
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import Gaussians

CPU = torch.device("cpu")
LENGTH = ("train.iterations=18", "train.refine_until=9", "train.evaluate_at=[]")


@pytest.fixture(scope="module")
def finished(capture, tmp_path_factory) -> Path:
    """The folder of a run that has learnt something, with all its bands in use."""
    config = tiny_config(capture, *LENGTH)
    return run.train(config, tmp_path_factory.mktemp("given-runs") / "run").folder.path


def save_splats(path: Path, gaussians: Gaussians, **others) -> Path:
    """As gsplat's simple_trainer does: the state of a ParameterDict."""
    splats = torch.nn.ParameterDict({name: torch.nn.Parameter(value.float()) for name, value in gaussians.items()})
    torch.save({"step": 6999, "splats": splats.state_dict(), **others}, path)
    return path


def worlds_of(capture: Path):
    """gsplat's worlds, from what pycolmap reads."""
    model = load_pycolmap().Reconstruction(capture / "sparse/0")
    viewmats = np.tile(np.eye(4), (model.num_images(), 1, 1))
    for i, image in enumerate(model.images.values()):
        viewmats[i, :3] = image.cam_from_world().matrix()
    return gsplat_worlds(viewmats, np.array([point.xyz for point in model.points3D.values()]))


def table(text: str) -> str:
    """The lines of an evaluation that depend on the model alone."""
    return text.partition("\n\n")[0]


def assert_alike(a: Gaussians, b: Gaussians) -> None:
    for (name, value), (_, other) in zip(a.items(), b.items(), strict=True):
        torch.testing.assert_close(value, other, msg=name, rtol=1e-4, atol=1e-5)


def files_of(finished: Path, folder: Path) -> dict[str, Path]:
    """The run's model in every form in which it can be given."""
    model = read_ply(finished / "model.ply")
    theirs = {name: value.float() for name, value in model.items()}
    export_splats(**theirs, save_to=str(folder / "gsplat.ply"))
    return {
        "ours": finished / "model.ply",
        "gsplat's ply": folder / "gsplat.ply",
        "gsplat's pt": save_splats(folder / "ckpt_6999_rank0.pt", model),
        "checkpoint": latest_checkpoint(finished / "checkpoints"),
        "run": finished,
    }


def test_a_model_is_the_same_in_every_form(finished, capture, tmp_path, recwarn):
    scene = load_scene(capture)
    trained = load_model(finished, CPU).gaussians
    for file in files_of(finished, tmp_path).values():
        assert_alike(load_given(file, scene), trained)
    assert not [warning for warning in recwarn if issubclass(warning.category, UserWarning)]


def test_a_given_model_has_the_tables_and_pictures_of_its_run(turbogs, finished, capture, tmp_path):
    asked, pictures = table(turbogs("eval", finished, "--device", "cpu")[1]), tmp_path / "pictures"
    for file in files_of(finished, tmp_path).values():
        code, out, error = turbogs("eval", file, "--scene", capture, "--device", "cpu")
        assert (code, table(out), error) == (0, asked, "")
        assert f"{file}, " in out
    assert turbogs("render", finished, "--device", "cpu", "--depth")[0] == 0
    given = ("--scene", capture, "--out", pictures, "--device", "cpu", "--depth")
    assert turbogs("render", finished / "model.ply", *given)[0] == 0
    for folder in ("test", "test-depth"):
        names = [path.name for path in sorted((finished / "renders" / folder).glob("*.png"))]
        assert names == [path.name for path in sorted((pictures / folder).glob("*.png"))] and names
        for name in names:
            ours, theirs = (np.asarray(Image.open(place / folder / name), dtype=int) for place in (
                finished / "renders", pictures))  # fmt: skip
            assert np.abs(ours - theirs).mean() < 0.1


def test_renders_of_a_lens_with_distortion_say_that_their_cameras_are_undistorted(turbogs, finished, capture, tmp_path):
    lensed = Path(shutil.copytree(capture, tmp_path / "lensed"))
    model = load_pycolmap().Reconstruction(lensed / "sparse/0")
    for camera in model.cameras.values():
        focal, _, x, y = camera.params
        camera.model, camera.params = load_pycolmap().CameraModelId.SIMPLE_RADIAL, [focal, x, y, 0.1]
    model.write_binary(lensed / "sparse/0")
    out = tmp_path / "out"
    code, _, said = turbogs("render", finished / "model.ply", "--scene", lensed, "--out", out, "--device", "cpu")
    assert code == 0
    size = re.search(r"8 photos undistorted: SIMPLE_RADIAL 48x40 -> PINHOLE (\d+)x(\d+)\n", said)
    assert size and size.groups() != ("48", "40")
    assert {Image.open(path).size for path in (out / "test").iterdir()} == {tuple(map(int, size.groups()))}


def test_the_settings_of_a_given_model_come_from_the_command_line(turbogs, finished, capture):
    code, out, _ = turbogs(
        "eval", finished / "model.ply", "scene.test_every=4", "--scene", capture, "--factor", "2", "--device", "cpu"
    )
    assert code == 0 and "view_004.png" in out and "mean of 2" in out


@pytest.mark.parametrize("form", ["pt", "ply"])
def test_an_export_of_a_run_reads_back(turbogs, finished, capture, tmp_path, form):
    target = tmp_path / f"exported.{form}"
    code, out, _ = turbogs("export", finished, "--format", form, "--out", target)
    assert code == 0 and str(target) in out
    assert_alike(load_given(target, load_scene(capture)), load_model(finished, CPU).gaussians)
    again = tmp_path / ("again.ply" if form == "pt" else "again.pt")
    code, _, error = turbogs("export", target, "--format", again.suffix[1:], "--scene", capture, "--out", again)
    assert (code, error) == (0, "")
    assert_alike(load_given(again, load_scene(capture)), load_model(finished, CPU).gaussians)


# Largest losses of PSNR in dB on the test view, and largest mean differences of its picture in grey levels.
LOSSES = {"ply": (0, 0.1), "pt": (0, 0.1), "compressed-ply": (0.2, 1.0), "splat": (0.5, 2.0), "spz": (0.2, 1.0)}


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_that_is_written_is_a_model_to_measure_and_render(turbogs, finished, capture, tmp_path, name):
    file, most = tmp_path / f"model{FORMATS[name].suffix.upper()}", LOSSES[name]
    assert turbogs("export", finished, "--format", name, "--out", file)[0] == 0
    options = ("--scene", capture, "--device", "cpu")
    measured = []
    for given in ((finished, "--device", "cpu"), (file, *options)):
        code, said, error = turbogs("eval", *given)
        assert (code, error) == (0, ""), error
        measured.append(float(re.search(r"mean of 1\W+([\d.]+)", said)[1]))
    assert measured[1] == pytest.approx(measured[0], abs=most[0] + 0.011)
    pictures = []
    for given in ((finished / "model.ply", *options), (file, *options)):
        out = tmp_path / f"pictures{len(pictures)}"
        assert turbogs("render", *given, "--out", out)[0] == 0
        (picture,) = (out / "test").glob("*.png")
        pictures.append(np.asarray(Image.open(picture), dtype=int))
    assert np.abs(pictures[1] - pictures[0]).mean() <= most[1]
    code, said, error = turbogs("export", file, *options[:2], "--out", tmp_path / "again.ply")
    assert code == 0 and re.search("nothing lost|less than 0.001 dB", said), error


@pytest.mark.parametrize("world", range(4))
def test_a_model_of_gsplats_normalised_world_is_brought_back(finished, capture, tmp_path, world):
    """Whichever half turn gsplat's version and linear algebra made of it."""
    theirs = worlds_of(capture)[world].apply(read_ply(finished / "model.ply"))
    file = save_splats(tmp_path / "ckpt.pt", theirs)
    loaded = load_given(file, load_scene(capture), "gsplat")
    trained = load_model(finished, CPU).gaussians
    for name in ("means", "scales", "opacities", "sh0", "shN"):
        torch.testing.assert_close(getattr(loaded, name), getattr(trained, name), rtol=1e-3, atol=1e-3)
    aligned = torch.nn.functional.cosine_similarity(loaded.quats, trained.quats).abs()
    torch.testing.assert_close(aligned, torch.ones_like(aligned))


def test_the_world_is_said_by_a_setting_in_training_and_evaluation(turbogs, finished, capture, tmp_path):
    file = save_splats(tmp_path / "ckpt.pt", worlds_of(capture)[2].apply(read_ply(finished / "model.ply")))
    config = tiny_config(capture, f"train.init={file}", "train.init_world=gsplat", "train.sh_degree=1").without_plan()
    trained = load_model(finished, CPU).gaussians
    torch.testing.assert_close(
        Trainer(config, load_scene(capture), CPU).gaussians.means, trained.means, atol=1e-3, rtol=0
    )
    given = ("eval", file, "--scene", capture, "--device", "cpu")
    wrong, right = (
        float(re.search(r"mean of 1\W+([\d.]+)", turbogs(*given, *setting)[1])[1])
        for setting in ((), ("train.init_world=gsplat",))
    )
    assert right > wrong + 1.0
    checkpoint = latest_checkpoint(finished / "checkpoints")  # knows its frame
    assert_alike(load_given(checkpoint, load_scene(capture), "gsplat"), trained)


def test_a_capture_that_determines_no_world_is_refused(finished, capture, tmp_path):
    scene = load_scene(capture)
    scene = dataclasses.replace(scene, points=scene.points[:3])
    with pytest.raises(InputError, match=r"do not determine gsplat's .* --no-normalize-world-space"):
        load_given(finished / "model.ply", scene, "gsplat")


def test_rows_that_are_not_finite_are_left_out_and_counted_once(finished, capture, tmp_path):
    model = read_ply(finished / "model.ply")
    kept = torch.ones(len(model), dtype=torch.bool)
    kept[[2, 5, 9]] = False
    model.means[2, 1], model.opacities[5], model.shN[9, 0, 0] = torch.nan, torch.inf, -torch.inf
    file = save_splats(tmp_path / "ckpt.pt", model)
    with pytest.warns(UserWarning) as warned:
        loaded = load_given(file, load_scene(capture))
    assert [str(line.message) for line in warned] == [
        f"{file}: 3 of {len(model)} Gaussians are not finite and left out"
    ]
    assert_alike(loaded, load_model(finished, CPU).gaussians.map(lambda value: value[kept]))


def test_ranks_of_one_model_are_put_together(finished, capture, tmp_path):
    model = read_ply(finished / "model.ply")
    half = len(model) // 2
    first = save_splats(tmp_path / "ckpt_6999_rank0.pt", model.map(lambda value: value[:half]))
    save_splats(tmp_path / "ckpt_6999_rank1.pt", model.map(lambda value: value[half:]))
    save_splats(tmp_path / "ckpt_29999_rank1.pt", model)
    assert_alike(load_given(first, load_scene(capture)), load_model(finished, CPU).gaussians)


# ---- Starts ------------------------------------------------------------------------------------------------------


def test_training_starts_from_a_model_where_that_had_ended(finished, capture, tmp_path):
    before = load_model(finished, CPU)
    config = tiny_config(capture, "train.iterations=1", "train.evaluate_at=[]")
    config.train.init = str(finished / "model.ply")
    session = run.train(config, tmp_path / "run")
    assert len(session.trainer.gaussians) == len(before.gaussians)
    ended = run.RunFolder(finished).history.read_text().splitlines()[-1]
    assert session.history[0].psnr == pytest.approx(float(re.search(r'"psnr": ([\d.]+)', ended)[1]), abs=0.01)
    assert Path(run.RunFolder(tmp_path / "run").read_config().train.init) == finished / "model.ply"


def test_bands_are_added_or_dropped_as_the_run_has_them(finished, capture):
    scene, model = load_scene(capture), load_model(finished, CPU).gaussians
    for degree, bands in ((0, 0), (1, 3), (3, 15)):
        config = tiny_config(capture, f"train.sh_degree={degree}", f"train.init={finished}").without_plan()
        trainer = Trainer(config, scene, CPU)
        shared = min(bands, model.shN.shape[1])
        assert trainer.sh_degree == degree and trainer.gaussians.shN.shape[1] == bands
        torch.testing.assert_close(trainer.gaussians.shN[:, :shared], model.shN[:, :shared])
        assert not trainer.gaussians.shN[:, shared:].any()


def test_a_stopped_run_goes_on_without_the_model_that_it_started_from(finished, capture, tmp_path):
    start = Path(shutil.copy(finished / "model.ply", tmp_path / "start.ply"))
    short = ("train.iterations=6", "train.refine_until=5", "train.checkpoint_every=3", "train.evaluate_at=[]")
    config = tiny_config(capture, f"train.init={start}", "train.sh_degree=1", *short)
    whole = run.train(config, tmp_path / "whole")
    shutil.copytree(tmp_path / "whole", tmp_path / "stopped")
    checkpoints = tmp_path / "stopped" / "checkpoints"
    (checkpoints / "latest").write_text("iteration-000003.pt")
    start.unlink()
    resumed = run.resume(tmp_path / "stopped")
    assert resumed.resumed
    for (_, value), (_, other) in zip(whole.trainer.gaussians.items(), resumed.trainer.gaussians.items(), strict=True):
        assert torch.equal(value, other)


def test_random_points_are_those_of_a_capture_without_points(capture):
    scene = load_scene(capture)
    trainer = Trainer(tiny_config(capture, "train.init=random").without_plan(), scene, CPU)
    points = random_points(scene.train.cameras.viewmats.double().numpy())
    assert len(trainer.gaussians) == len(points) == 50_000
    assert (trainer.gaussians.means - torch.from_numpy(points).float()).abs().max() == 0


def test_a_model_gets_no_backdrop_unless_it_is_asked_for(finished, capture):
    config = tiny_config(capture, f"train.init={finished}")
    facts = run.plan_run(tiny_config(capture)).facts
    assert wanted_backdrop(facts, config)[0] is False
    model = load_model(finished, CPU).gaussians
    asked = tiny_config(capture, f"train.init={finished}", "train.backdrop=true").without_plan()
    assert len(Trainer(asked, load_scene(capture), CPU).gaussians) == len(model) + 3000


def test_a_model_that_is_larger_than_the_cap_is_refused(finished, capture):
    config = tiny_config(capture, f"train.init={finished}", "density.max_gaussians=100").without_plan()
    with pytest.raises(InputError, match=r"more than density\.max_gaussians 100 allows.*start from points"):
        Trainer(config, load_scene(capture), CPU)


# ---- Bad input ---------------------------------------------------------------------------------------------------


def bad_files(folder: Path) -> dict[str, tuple[Path, str]]:
    """What -> (a file, words of the answer)."""

    def written(name: str, content: bytes) -> Path:
        (folder / name).write_bytes(content)
        return folder / name

    def saved(name: str, value: object) -> Path:
        torch.save(value, folder / name)
        return folder / name

    empty = folder / "empty"
    empty.mkdir()
    model = random_gaussians(5)
    broken = random_gaussians(5).map(lambda value: value * torch.nan)
    whole = save_splats(folder / "whole.pt", model).read_bytes()
    return {
        "absent": (folder / "absent.ply", "no such model"),
        "another kind": (written("model.obj", b"x"), "a .ply, .splat, .spz or gsplat's .pt"),
        "empty folder": (empty, "without a checkpoint of a run"),
        "no archive": (written("text.pt", b"text"), "not a whole file of torch.save"),
        "cut": (written("cut.pt", whole[:-300]), "cannot be used"),
        "other keys": (saved("weights.pt", {"conv1": torch.zeros(3), "bias": torch.zeros(1)}), "bias, conv1"),
        "a list": (saved("list.pt", [torch.zeros(3)]), "it has list): give a .ply"),
        "code": (saved("code.pt", {"splats": Path("x")}), "more than plain tensors"),
        "not finite": (save_splats(folder / "nan.pt", broken), "none of its 5 Gaussians is finite"),
        "no rows": (save_splats(folder / "none.pt", model.map(lambda value: value[:0])), "holds no Gaussians: export"),
        "not a ply": (written("text.ply", b"text"), "not a .ply file"),
        "not a splat": (written("text.splat", b"text"), "rows of 32; export it again, or name another file"),
        "not a spz": (written("text.spz", b"text"), "cannot read"),
        "not compressed": (written("a.ply", b"ply\nelement chunk 1\nend_header\n"), "not a compressed .ply"),
    }


def test_what_is_no_model_is_one_line(turbogs, capture, tmp_path):
    out = tmp_path / "out"
    for what, (file, words) in bad_files(tmp_path).items():
        calls = [
            ("train", capture, "--init", file, "--out", out),
            ("eval", file, "--scene", capture),
            ("render", file, "--scene", capture, "--out", out),
            ("export", file, "--scene", capture, "--out", out.with_suffix(".ply")),
        ]
        for call in calls:
            code, printed, error = turbogs(*call)
            assert code == 2 and printed == "" and error.count("\n") == 1, (what, call[0], error)
            assert words in error and str(file) in error, (what, error)
            assert not list(tmp_path.glob("out*"))


def test_calls_that_lack_something(turbogs, finished, capture, tmp_path):
    model = finished / "model.ply"
    for call, words in (
        (("eval", model), "--scene SCENE"),
        (("export", model), "--scene SCENE"),
        (("render", model, "--scene", capture), "--out FOLDER"),
        (("export", model, "--scene", capture), "--out"),
        (("eval", finished, "--factor", "2"), "need --scene"),
        (("eval", finished, "scene.factor=2"), "need --scene"),
        (("train", capture, "--init", "", "--out", tmp_path / "out"), "points, random, or a model's file"),
        (("train", capture, "train.init=''", "--out", tmp_path / "out"), "init"),
        (("eval", model, "--scene", tmp_path / "absent"), "no such scene"),
    ):
        code, _, error = turbogs(*call)
        assert code == 2 and error.count("\n") == 1 and words in error, error
    assert not (tmp_path / "out").exists()
