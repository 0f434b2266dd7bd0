"""Captures on which no training can work are refused with the likely cause; others are not."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from turbogs_plugin.captures import load_scene, write_demo_capture
from turbogs_plugin.captures.load import unseeing_note
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene import Scene
from turbogs_plugin.scene.agreement import LEAST_LIKENESS, OTHER_AXES, likely_poses, likeness, require_agreement
from turbogs_plugin.scene.photos import Photos
from turbogs_plugin.types import Cameras


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    return load_scene(write_demo_capture(tmp_path_factory.mktemp("demo") / "capture", views=8, width=64, height=48))


def posed(scene: Scene, viewmats: torch.Tensor | np.ndarray, unit: torch.Tensor | float = 1.0) -> Scene:
    """The scene with other poses, and intrinsics over this unit."""
    given = scene.train.cameras
    cameras = Cameras(torch.as_tensor(viewmats).float(), given.Ks / unit, given.sizes)
    return replace(scene, train=replace(scene.train, cameras=cameras))


def inverted(scene: Scene, *axes: np.ndarray) -> Scene:
    """The scene of a file whose poses are from camera to world, in these axes of the world and of the cameras."""
    first, second = axes or (np.eye(4), np.eye(4))
    poses = np.linalg.inv(scene.frame.restore_poses(scene.train.cameras.viewmats.numpy()))
    return posed(scene, scene.frame.normalise_poses(first @ poses @ second))


def shares(scene: Scene) -> Scene:
    return posed(scene, scene.train.cameras.viewmats, torch.tensor([[64.0], [48.0], [1.0]]))


def even(scene: Scene, *color: int) -> Scene:
    colors = torch.tensor([color]).repeat(len(scene.train.photos.colors), 1)
    return replace(scene, train=replace(scene.train, photos=Photos(colors, scene.train.photos.sizes)))


def blind(scene: Scene, *views: int) -> Scene:
    viewmats = scene.train.cameras.viewmats.clone()
    viewmats[list(views), 2, 3] -= 50.0  # all points are behind them
    return posed(scene, viewmats)


def foreign(scene: Scene, doubt: str = "") -> Scene:
    """The scene with points of another one."""
    return replace(scene, point_colors=scene.point_colors.flip(0), doubt=doubt)


def mistaken(scene: Scene, place: int) -> Scene:
    """The scene with one of its likely mistakes."""
    likely = [*likely_poses(scene.frame.restore_poses(scene.train.cameras.viewmats.double().numpy()))]
    return posed(scene, scene.frame.normalise_poses(likely[place][0]))


def off_center(scene: Scene, *middle: float) -> Scene:
    """The scene with its principal points at these shares of the photos' width and height."""
    (other := posed(scene, scene.train.cameras.viewmats.clone())).train.cameras.Ks[:, :2, 2] = torch.tensor(middle) * 64
    return other


CONTRADICTIONS = {
    "other axes": (lambda s: posed(s, OTHER_AXES @ s.train.cameras.viewmats.double().numpy()), "columns 2 and 3"),
    "inverse poses": (inverted, "invert each pose"),
    "inverse poses, OpenGL's": (lambda s: inverted(s, OTHER_AXES, OTHER_AXES), "invert each pose.*round.;"),
    "world to camera, OpenCV's": (lambda s: inverted(s, OTHER_AXES, np.eye(4)), 'invert .* write "axes": "opencv"'),
    "photos of other cameras": (lambda s: posed(s, s.train.cameras.viewmats.roll(3, 0)), "photos do not .*one solve"),
    "one place": (lambda s: posed(s, s.train.cameras.viewmats[:1].repeat(len(s.train), 1, 1)), "in one place"),
    "most cameras blind": (lambda s: blind(s, 3, 4, 5, 6), "the cameras see no points"),
    "black photos": (lambda s: even(s, 0, 0, 0), "one colour throughout"),
    "points of another scene": (foreign, "of one solve"),
    "stale frames": (lambda s: foreign(s, "poses of frames"), "poses of frames"),
    "points far away": (lambda s: replace(s, points=s.points + 100.0), "cameras see no points: .*one frame"),
    "intrinsics in shares": (shares, "in pixels"),
    "x, y, z, w in images.txt": (lambda s: mistaken(s, 7), "reorder the quaternions"),
    "x, y, z, w of camera to world": (lambda s: mistaken(s, 8), "reorder the quaternions"),
    "w, x, y, z for x, y, z, w": (lambda s: mistaken(s, 12), "reorder the quaternions"),
    "photos upside down": (lambda s: mistaken(s, 5), "turn the photos to how the cameras were found"),
    "principal points from the middle": (lambda s: off_center(s, 0.01, -0.01), "principal points are at 0.01, "),
    "intrinsics of twice the size": (lambda s: off_center(s, 1.0, 0.75), "write the photos' size"),
    "no alpha": (lambda s: even(s, 0, 0, 0, 0), "alpha 0"),
}


def test_a_camera_that_sees_none_of_the_points_is_named(scene):
    assert unseeing_note(scene) == ""
    assert unseeing_note(blind(scene, 2)) == f"1 cameras see none of the points: {scene.train.names[2]}"


@pytest.mark.parametrize("case", CONTRADICTIONS)
def test_a_contradiction_is_refused_with_its_cause(scene, case):
    make, told = CONTRADICTIONS[case]
    with pytest.raises(InputError, match=told) as refused:
        require_agreement(make(scene))
    assert "\n" not in str(refused.value) and "scene.force=true" in str(refused.value)


def test_good_captures_pass_by_a_wide_margin(scene):
    require_agreement(scene)
    poses = scene.frame.restore_poses(scene.train.cameras.viewmats.numpy())
    assert likeness(scene, poses)[1] > 3 * LEAST_LIKENESS


def test_what_cannot_be_told_passes(scene):
    other = foreign(scene)
    require_agreement(replace(other, point_colors=torch.full_like(scene.point_colors, 128)))  # clouds without colours
    unseen = {name: replace(getattr(other, name), observations=None) for name in ("train", "test")}
    with pytest.raises(InputError, match=r"photos show point \d+, and the scene has 40 points: .* observations=None"):
        replace(other, points=scene.points[:40])
    require_agreement(replace(other, points=scene.points[:40], point_colors=other.point_colors[:40], **unseen))
    require_agreement(replace(other, points=scene.points + 100.0, drawn_points=True))
