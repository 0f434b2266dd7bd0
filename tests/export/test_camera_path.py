"""Paths of cameras: through given ones, without jumps, about what they look at."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.refusals import assert_refused
from scipy.spatial.transform import Rotation

from turbogs_plugin.export.camera_path import from_file, interpolated, orbit, resized, through_views
from turbogs_plugin.model.placement import TRANSFORMS, TURNS
from turbogs_plugin.model.similarity import Similarity
from turbogs_plugin.scene import Frame
from turbogs_plugin.scene.geometry import look_at
from turbogs_plugin.types import Cameras
from turbogs_plugin.viewer.camera import focus_and_up

K = np.array([[50.0, 0, 24], [0, 50.0, 20], [0, 0, 1]])
UP = np.array([0.0, 0.0, 1.0])


def ring(angles, target=(1.0, 2.0, 0.5), radius=3.0) -> Cameras:
    places = np.asarray(target) + np.stack([radius * np.cos(angles), radius * np.sin(angles), 0 * angles + 1.0], axis=1)
    viewmats = np.stack([look_at(place, np.asarray(target), UP) for place in places])
    Ks = np.repeat(K[None], len(viewmats), axis=0)
    sizes = np.full((len(viewmats), 2), 48)
    return Cameras(torch.from_numpy(viewmats).float(), torch.from_numpy(Ks).float(), sizes)


def test_a_path_goes_through_its_keys_at_even_speed():
    keys = ring(np.linspace(0, 2, 5))
    viewmats = keys.viewmats.double().numpy()
    made = interpolated(viewmats, K, np.array([48, 40]), 81)
    assert len(made) == 81 and np.allclose(made.viewmats[::20].numpy(), viewmats, atol=1e-5)
    steps = np.linalg.norm(np.diff(made.centers.double().numpy(), axis=0), axis=1)
    assert steps.max() < 1.3 * steps.min()
    assert np.allclose(np.linalg.det(made.viewmats[:, :3, :3].double().numpy()), 1.0, atol=1e-5)


def test_cameras_of_one_place_turn():
    viewmats = np.tile(np.eye(4), (2, 1, 1))
    viewmats[1, :3, :3] = Rotation.from_euler("y", 0.8).as_matrix()
    half = interpolated(viewmats, K, np.array([48, 40]), 3).viewmats[1, :3, :3].numpy()
    assert np.allclose(half, Rotation.from_euler("y", 0.4).as_matrix(), atol=1e-6)


def test_an_orbit_surrounds_what_cameras_look_at():
    cameras = ring(np.linspace(0, 2 * np.pi, 12, endpoint=False))
    focus, up = focus_and_up(cameras)
    assert np.allclose(focus, [1, 2, 0.5], atol=1e-4) and up @ UP > 0.9
    made = orbit(cameras, 60).centers.numpy() - focus
    assert np.allclose(np.linalg.norm(made, axis=1), np.sqrt(10.0), rtol=1e-3)
    angles = np.unwrap(np.arctan2(made[:, 1], made[:, 0]))
    assert abs(abs(angles[-1] - angles[0]) - 2 * np.pi * 59 / 60) < 1e-3


def test_an_orbit_of_cameras_on_one_side_swings_there():
    cameras = ring(np.linspace(3.0, 4.0, 6))  # across the place where angles jump
    made = orbit(cameras, 60).centers.numpy() - np.array([1, 2, 0.5])
    angles = np.arctan2(made[:, 1], made[:, 0]) % (2 * np.pi)
    assert angles.min() > 2.99 and angles.max() < 4.01 and np.ptp(angles) > 0.95


@pytest.mark.parametrize("make", [orbit, through_views])
def test_one_camera_alone(make):
    made = make(ring(np.array([0.3])), 4)
    assert len(made) == 4 and bool(torch.isfinite(made.viewmats).all())


def scene_of(frame: Frame) -> SimpleNamespace:
    """The part of a scene that a path needs: its frame, and points about what `ring` looks at."""
    points = np.array([1.0, 2.0, 0.5]) + np.random.default_rng(0).normal(size=(50, 3)) * 0.3
    return SimpleNamespace(frame=frame, points=torch.from_numpy(frame.normalise_points(points)))


WORLD = Similarity(Rotation.from_euler("xyz", (0.4, -1.1, 0.2)).as_matrix(), 0.3, np.array([0.1, -0.2, 0.3]))


def written(layout: str, viewmats: np.ndarray) -> object:
    """Cameras of 64x48 pixels, with focal lengths of 100 and 50 pixels, as programs write them."""
    cameras, own = [], layout == "own sizes"
    for viewmat, focal, k in zip(viewmats, (100.0, 50.0), (1, 2 if own else 1), strict=True):
        pose = np.linalg.inv(viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's axes
        place, axes = pose[:3, 3].tolist(), (pose[:3, :3] * [1, -1, -1]).tolist()
        fov = float(np.degrees(2 * np.arctan(24 / focal)))
        frame = {"transform_matrix": pose.tolist(), "fl_x": focal * k, **({"w": 64 * k, "h": 48 * k} if own else {})}
        inria = {"width": 64, "height": 48, "fx": focal, "fy": focal, "position": place, "rotation": axes}
        studio = {"camera_to_world": pose.ravel().tolist(), "fov": fov}
        cameras.append({"Inria": inria, "nerfstudio": studio}.get(layout, frame))
    if layout == "nerfstudio":
        return {"render_width": 64, "render_height": 48, "camera_path": cameras}
    return cameras if layout == "Inria" else {"frames": cameras, **({} if own else {"w": 64, "h": 48})}


LAYOUTS = [(name, None) for name in ("one size", "own sizes", "Inria", "nerfstudio")]


@pytest.mark.parametrize(("layout", "turn"), [*LAYOUTS, *(("nerfstudio", turn) for turn in TURNS)])
def test_a_file_of_cameras_is_in_the_captures_coordinates(tmp_path, layout, turn):
    """Or in nerfstudio's, whose file lies beside it."""
    frame = Frame(np.array([10.0, 0.0, 0.0]), 2.0)
    viewmats = ring(np.array([0.0, 0.5])).viewmats.double().numpy()
    given = viewmats
    if turn is not None:
        values = {"transform": np.c_[WORLD.rotation, WORLD.translation / 0.3].tolist(), "scale": 0.3}
        (tmp_path / TRANSFORMS).write_text(json.dumps(values))
        given = WORLD.after(Similarity(turn, 1.0, np.zeros(3)).inverse()).apply_to_poses(viewmats)
    (tmp_path / "a.json").write_text(json.dumps(written(layout, given)))
    made = from_file(tmp_path / "a.json", scene_of(frame), 5)
    assert np.allclose(made.viewmats[[0, -1]].numpy(), frame.normalise_poses(viewmats), atol=1e-4)
    assert made.sizes.tolist() == [[64, 48]] * 5
    assert np.allclose(made.Ks[:, 0, 0].numpy(), np.linspace(100, 50, 5), rtol=1e-3)


WRONG = ({"w": None}, {"w": 9999}, {"fl_x": -1.0}, {"frames": []}, {"frames": [{"transform_matrix": 1}]})
WRONG += ({"frames": [{}]}, [{}], [1], [{"width": 9, "height": 9, "fx": 5, "rotation": [[1], 3]}], {"camera_path": []})
WRONG += ({"camera_path": [1], "render_width": 9, "render_height": 9}, {"camera_path": [{}], "camera_type": "fisheye"})


@pytest.mark.parametrize("change", WRONG)
def test_a_file_of_something_else_is_refused(tmp_path, change):
    content = change
    if isinstance(change, dict) and "camera_path" not in change:
        content = {"w": 64, "h": 48, "fl_x": 50.0, "frames": [{"transform_matrix": np.eye(4).tolist()}], **change}
        content = {name: value for name, value in content.items() if value is not None}
    (tmp_path / "a.json").write_text(json.dumps(content))
    assert_refused(r"a\.json", from_file, tmp_path / "a.json", scene_of(Frame(np.zeros(3), 1.0)), 3)


def test_another_size_keeps_what_is_seen_from_top_to_bottom():
    Ks = torch.tensor([[[50.0, 0, 22], [0, 60, 12], [0, 0, 1]]])
    cameras = Cameras(torch.eye(4)[None], Ks, np.array([[40, 24]]))
    made = resized(cameras, 100, 48)
    assert made.sizes.tolist() == [[100, 48]] and made.Ks[0].diag().tolist() == [100, 120, 1]
    assert made.Ks[0, :2, 2].tolist() == [2 * 22 + (100 - 80) / 2, 24] and cameras.Ks[0, 0, 2] == 22
