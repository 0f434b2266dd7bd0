"""Axes of cameras without points: told by features of neighbouring photos, where these tell them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.refusals import assert_refused

from turbogs_plugin.captures import load_scene, write_demo_capture
from turbogs_plugin.config.sections import SceneConfig
from turbogs_plugin.reconstruct.axes import axes_votes
from turbogs_plugin.scene.agreement import OTHER_AXES
from turbogs_plugin.scene.scene import Scene
from turbogs_plugin.train import inputs
from turbogs_plugin.types import Cameras


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    folder = write_demo_capture(tmp_path_factory.mktemp("demo") / "capture", views=24)
    return replace(load_scene(folder), drawn_points=True)


def with_cameras(scene: Scene, viewmats: np.ndarray) -> Scene:
    cameras = Cameras(torch.from_numpy(viewmats).float(), scene.train.cameras.Ks, scene.train.cameras.sizes)
    return replace(scene, train=replace(scene.train, cameras=cameras))


def test_a_capture_without_points_in_opencvs_axes_is_refused(scene, monkeypatch):
    viewmats = scene.train.cameras.viewmats.double().numpy()
    wrong = with_cameras(scene, OTHER_AXES @ viewmats)
    matches, given, other = axes_votes(scene.train)
    assert matches >= 60 and given > 0.7 * matches > 5 * other and axes_votes(wrong.train) == (matches, other, given)
    monkeypatch.setattr(inputs, "find_cameras", lambda *arguments: None)
    monkeypatch.setattr(inputs, "load_scene", lambda path, *others: {"right": scene, "wrong": wrong}[path])
    words = f'{given} of {matches} matches .* write "axes": "opencv" into transforms.json, or multiply'
    assert_refused(words, inputs.open_scene, SceneConfig("wrong"), False)
    for settings in (SceneConfig("wrong", force=True), SceneConfig("right")):
        inputs.open_scene(settings, False)


def test_photos_without_features_or_neighbours_tell_nothing(scene):
    even = replace(scene.train.photos, colors=torch.full_like(scene.train.photos.colors, 90))
    assert axes_votes(replace(scene.train, photos=even)) == (0, 0, 0)
    viewmats = np.tile(np.eye(4), (len(scene.train), 1, 1))  # all in one place
    assert axes_votes(with_cameras(scene, viewmats).train) == (0, 0, 0)
