"""Poses of captures without points: told by matches of photos, where these tell them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.refusals import assert_refused

from turbogs_plugin.captures import load_scene, write_demo_capture
from turbogs_plugin.captures.matches import Pair, matches
from turbogs_plugin.config.sections import SceneConfig
from turbogs_plugin.errors import InputError
from turbogs_plugin.masks import PixelMasks
from turbogs_plugin.reconstruct import pose_check
from turbogs_plugin.reconstruct.pose_check import require_poses
from turbogs_plugin.scene.agreement import OTHER_AXES, likely_poses
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
    wrong = with_cameras(scene, OTHER_AXES @ scene.train.cameras.viewmats.double().numpy())
    monkeypatch.setattr(inputs, "find_cameras", lambda *arguments: None)
    monkeypatch.setattr(inputs, "load_scene", lambda path, *others: {"right": scene, "wrong": wrong}[path])
    words = r'\d+ of \d+ matches .* write "axes": "opencv" into transforms.json, or multiply'
    assert_refused(words, inputs.open_scene, SceneConfig("wrong"), False)
    for settings in (SceneConfig("wrong", force=True), SceneConfig("right")):
        inputs.open_scene(settings, False)


def test_photos_without_features_or_neighbours_tell_nothing(scene):
    even = replace(scene.train.photos, colors=torch.full_like(scene.train.photos.colors, 90))
    require_poses(replace(scene, train=replace(scene.train, photos=even)))
    require_poses(with_cameras(scene, np.tile(np.eye(4), (len(scene.train), 1, 1))))  # all in one place


def test_matches_are_of_unmasked_pixels_that_move(scene):
    view, same = scene.train, replace(scene.train.photos, colors=scene.train.photos.colors.clone())
    first, second = (slice(*same.offsets[place : place + 2].tolist()) for place in (0, 1))
    same.colors[second] = same.colors[first]
    assert len(matches(replace(view, photos=same), 0, 1)[2]) == 0 < len(matches(view, 0, 1)[2])
    keep = np.ones((120, 160), dtype=bool)
    keep[:, :80] = False
    masked = replace(view, masks=PixelMasks.joined([PixelMasks.of(keep)] * len(view)))
    rays = matches(masked, 0, 1)[2]
    assert len(rays) and (rays @ view.cameras.Ks[0].double().numpy().T)[:, 0].min() >= 80


def seen_by(poses: np.ndarray, wrong: int = 0):
    """Exact matches of 60 points of a cube by cameras of these poses, the last `wrong` of them scattered."""
    points = np.random.default_rng(5).uniform(-1, 1, (60, 3))

    def matched(views, *pair: int) -> Pair:
        first, second = (points @ poses[view, :3, :3].T + poses[view, :3, 3] for view in pair)
        first, second = first / first[:, 2:], second / second[:, 2:]
        second[60 - wrong :] = second[60 - wrong :][::-1]
        return *pair, first, second

    return matched


def test_poses_of_other_photos_are_refused_where_the_matches_are_of_rigid_things(scene, monkeypatch):
    right = scene.frame.restore_poses(scene.train.cameras.viewmats.double().numpy())
    order = np.random.default_rng(1).permutation(len(right))
    for wrong, refused in ((0, True), (50, False)):
        monkeypatch.setattr(pose_check, "matches", seen_by(right, wrong))
        require_poses(scene)
        shuffled = with_cameras(scene, scene.frame.normalise_poses(right[order]))
        if refused:
            assert_refused(r"in \d+ pairs of photos the matches contradict the poses: give", require_poses, shuffled)
        else:
            require_poses(shuffled)
    monkeypatch.setattr(pose_check, "matches", seen_by(right))
    tilted = right.copy()
    for view in range(len(right)):
        angle = np.radians(0.6 * (-1) ** view)
        cos, sin = np.cos(angle), np.sin(angle)
        tilted[view, :3] = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]]) @ right[view, :3]
    require_poses(with_cameras(scene, scene.frame.normalise_poses(tilted)))  # poor poses still train


def test_each_likely_mistake_is_named_by_its_remedy(scene, monkeypatch):
    right = scene.frame.restore_poses(scene.train.cameras.viewmats.double().numpy())
    monkeypatch.setattr(pose_check, "matches", seen_by(right))
    told, likely = [], [poses for poses, _ in likely_poses(right)]
    del likely[5]  # photos upside down: what goes round to the right seems to go round to the left
    for wrong in likely:
        with pytest.raises(InputError) as refused:
            require_poses(with_cameras(scene, scene.frame.normalise_poses(wrong)))
        told.append(str(refused.value))
    words = ["columns 2 and 3", *["invert each pose"] * 3, *["turn the photos"] * 2, *["reorder the quat"] * 6]
    assert len(told) == 12 and all(word in line for word, line in zip(words, told, strict=True)), told
