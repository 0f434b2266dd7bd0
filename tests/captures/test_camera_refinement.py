"""Scenes whose photos get cameras of their own: what is read, what changes, and what stays."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.tracked import HEIGHT, WIDTH, tracked, write_tracked

from turbogs_plugin.captures import load_scene
from turbogs_plugin.captures.bundle_adjustment import _pinholes, find_cameras, refine_cameras, reprojection_errors
from turbogs_plugin.config.sections import SceneConfig
from turbogs_plugin.distributed.ranks import Ranks
from turbogs_plugin.engine.render_pass import RasterSettings
from turbogs_plugin.model.initial import gaussians_from_points
from turbogs_plugin.scene import Scene
from turbogs_plugin.train.inputs import open_scene
from turbogs_plugin.train.look import Look
from turbogs_plugin.train.metrics import evaluate

CASE = tracked(points=80)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return write_tracked(tmp_path_factory.mktemp("tracked") / "cup", CASE)


def median_error(scene: Scene, split: str, refined: bool = False) -> float:
    views = getattr(scene, split)
    cameras = _pinholes(views.refined if refined else views.cameras)
    return float(np.median(reprojection_errors(cameras, scene.points.double().numpy(), views.observations)))


def unchanged(before: Scene, now: Scene, split: str) -> bool:
    first, second = (getattr(scene, split).cameras for scene in (before, now))
    return first.viewmats.equal(second.viewmats) and first.Ks.equal(second.Ks)


@pytest.mark.parametrize(("suffix", "model"), [(".bin", "OPENCV"), (".txt", "PINHOLE")])
def test_where_photos_show_points_is_read(tmp_path, suffix, model):
    scene = load_scene(write_tracked(tmp_path / "cup", CASE, suffix, model))
    shown, expected = scene.train.observations, CASE.observations.pixels[CASE.observations.view_ids > 0]
    assert len(shown) == 7 * 80 and len(scene.test.observations) == 80  # the first photo tests
    np.testing.assert_allclose(shown.pixels, expected, atol=1e-9)
    assert shown.view_ids.tolist() == np.repeat(np.arange(7), 80).tolist()
    assert shown.point_ids.tolist() == np.tile(np.arange(80), 7).tolist()


def test_pixels_are_those_of_undistorted_photos(tmp_path):
    """A lens that pulls its photo's corners in by tens of pixels."""
    folder = write_tracked(tmp_path / "cup", CASE, model="OPENCV", distortion=(-0.1, 0.01, 0.0, 0.0))
    scene = load_scene(folder)
    assert scene.train.cameras.sizes[0].tolist() != [WIDTH, HEIGHT]
    assert median_error(scene, "train") < 3.0, "as without the lens"


def test_cameras_are_found_while_photos_are_decoded(capture):
    """What is called meanwhile has the scene without its photos' pixels, and finds the cameras that it finds after."""
    found = []
    scene = load_scene(
        capture, meanwhile=lambda read: found.append((len(read.train.photos.colors), find_cameras(read)))
    )
    ((pixels, meanwhile),) = found
    assert pixels == 0 < len(scene.train.photos.colors)
    afterwards = find_cameras(scene)
    assert all(
        torch.equal(getattr(meanwhile.train, name), getattr(afterwards.train, name)) for name in ("viewmats", "Ks")
    )


@pytest.mark.parametrize("factor", [1, 2])
def test_training_cameras_are_refined_and_test_cameras_stay(capture, factor):
    scene = load_scene(capture, factor=factor)
    refined = refine_cameras(scene)
    assert median_error(refined, "train") < 0.2 / factor < 1.0 / factor < median_error(scene, "train")
    assert refined.reprojection_error == pytest.approx(median_error(refined, "train"), rel=1e-3), "points are float32"
    assert unchanged(scene, refined, "test")
    assert median_error(refined, "test", refined=True) < 0.3 / factor < median_error(refined, "test")
    assert refined.frame == scene.frame and refined.points.dtype == torch.float32
    assert "7 of 7 training cameras refined" in refined.notes[-1]


def test_without_it_test_photos_alone_get_other_cameras_beside_theirs(capture):
    scene = load_scene(capture)
    same = open_scene(SceneConfig(str(capture)), False)
    assert unchanged(scene, same, "train") and unchanged(scene, same, "test") and same.points.equal(scene.points)
    assert median_error(same, "test", refined=True) < 0.2 < 1.0 < median_error(same, "test")
    assert scene.reprojection_error is None and same.reprojection_error == median_error(same, "train")
    assert unchanged(refine_cameras(scene), open_scene(SceneConfig(str(capture)), True), "train"), "by default"


def test_of_several_processes_the_first_one_refines_for_all(capture):
    first = open_scene(SceneConfig(str(capture)), True)

    class Second(Ranks):
        rank = 1

        def agree(self, value):
            assert value is None
            return find_cameras(load_scene(capture))

    second = open_scene(SceneConfig(str(capture)), True, ranks=Second())
    assert unchanged(first, second, "train") and second.points.equal(first.points)
    assert second.test.refined.Ks.equal(first.test.refined.Ks)


@pytest.mark.parametrize("other", [True, False])
def test_observations_of_other_photos_are_not_used(capture, other):
    """A reconstruction whose cameras were edited by hand for photos of another size, or that does not say any."""
    scene = load_scene(capture)
    observations = replace(scene.train.observations, pixels=2.0 * scene.train.observations.pixels) if other else None
    scene = replace(scene, train=replace(scene.train, observations=observations))
    assert refine_cameras(scene) is scene and refine_cameras(scene, training=False) is scene


def test_errors_by_refined_test_cameras_stand_beside_the_others(capture):
    scene = refine_cameras(load_scene(capture, factor=8))
    gaussians = gaussians_from_points(scene.points, scene.point_colors, 0, scene.extent)
    look = Look(0, RasterSettings())
    mean = evaluate(gaussians, scene.test, look, further=True).mean
    moved = evaluate(gaussians, replace(scene.test, cameras=scene.test.refined), look).mean
    assert mean.refined_psnr == moved.psnr != mean.psnr
    assert np.isnan(evaluate(gaussians, scene.test, look).mean.refined_psnr)


def test_a_resumed_run_has_the_same_cameras(turbogs, capture, tmp_path):
    """To the bit, though the refinement is done again."""
    settings = ("scene.factor=8", "train.sh_degree=0", "schedule.max_views=3", "train.backdrop=false")
    settings += ("train.iterations=6", "train.refine_until=3", "train.checkpoint_every=3", "--no-report")
    code, _, err = turbogs("train", capture, "--out", tmp_path / "run", "--device", "cpu", *settings)
    assert code == 0, err
    assert "7 of 7 training cameras refined" in err and err.count("by refined test cameras") == 1
    shutil.copytree(tmp_path / "run", tmp_path / "again")
    (tmp_path / "again" / "checkpoints" / "iteration-000006.pt").unlink()
    code, _, err = turbogs("train", "--resume", tmp_path / "again", "--no-report")
    assert code == 0, err
    first, second = ((tmp_path / name / "model.ply").read_bytes() for name in ("run", "again"))
    assert first == second
    code, out, err = turbogs("eval", tmp_path / "run", "--device", "cpu")
    assert code == 0 and "\nmean by refined test cameras " in out
