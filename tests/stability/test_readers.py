"""Values in the files of captures, and models to start from, replaced by hostile ones: a clear error, or a scene and a
model of finite numbers, in bounded memory. Bytes are damaged in test_loaders.py and beside the readers' own tests."""

from __future__ import annotations

import copy
import json
import random
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
from helpers.bounded_memory import outcome_within
from helpers.framework_runs import tiny_config
from helpers.models import random_gaussians
from PIL import Image

from turbogs_plugin.captures import load_scene
from turbogs_plugin.errors import InputError
from turbogs_plugin.model.ply import save_ply
from turbogs_plugin.model.torch_file import save_gsplat
from turbogs_plugin.scene import Frame, Scene
from turbogs_plugin.train.training_state import initial_gaussians
from turbogs_plugin.types import Gaussians

MEMORY = 64 * 2**20
"""Python and numpy may allocate this much for files of less than a megabyte."""
NUMBERS = (float("nan"), float("inf"), 1e308, -1e308, 5e-324, 1e20, -1e3, 1e5, -1.0, 0.0, 0.3, 2**70, -(2**70))
OTHERS = (None, "text", "../x", "", True, [], {}, [[1]], [1e400], {"k1": 1})


def leaves(value, path=()):
    """(path, leaf) of nested dicts and lists."""
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from leaves(item, (*path, key))
    yield path, value


def with_another(content, choice: random.Random):
    """Some values of a JSON file replaced, moved in, or left out."""
    changed = copy.deepcopy(content)
    for _ in range(choice.choice([1, 1, 3])):
        path, value = choice.choice([leaf for leaf in leaves(changed) if leaf[0]])
        parent = changed
        for key in path[:-1]:
            parent = parent[key]
        if choice.random() < 0.1:
            del parent[path[-1]]
        elif isinstance(value, float) and choice.random() < 0.3:
            parent[path[-1]] = value * choice.choice([1.0001, 1.1, -1, 1e-6, 1e6])
        else:
            parent[path[-1]] = choice.choice(NUMBERS if choice.random() < 0.6 else OTHERS)
    return changed


def require_whole(scene: Scene) -> None:
    for views in (scene.train, scene.test):
        assert views.cameras.viewmats.isfinite().all() and views.cameras.Ks.isfinite().all()
        assert (views.cameras.sizes >= 1).all() and len(views.photos.stored) == views.cameras.sizes.prod(axis=1).sum()
    assert scene.points.isfinite().all() and len(scene.points) == len(scene.point_colors) > 0


def pose(view: int) -> list[list[float]]:
    turn = 0.4 * view
    axes = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = axes, axes[:, 2] * 4.0
    return matrix.tolist()


def frames(folder: str, count: int) -> list[dict]:
    return [{"file_path": f"{folder}/{view}.png", "transform_matrix": pose(view)} for view in range(count)]


LENS = {"w": 16, "h": 12, "fl_x": 14.0, "fl_y": 14.0, "cx": 8.0, "cy": 6.0}
FILES = {
    "brown": ("transforms.json", {**LENS, "k1": 0.05, "k2": -0.02, "k3": 0.01, "p1": 0.001, "p2": 0.001}),
    "fisheye": ("transforms.json", {**LENS, "camera_model": "OPENCV_FISHEYE", "k1": 0.05, "k2": 0.01, "k3": 0.0}),
    "points": ("transforms.json", {**LENS, "ply_file_path": "points.ply"}),
    "blender": ("transforms_train.json", {"camera_angle_x": 1.0}),
    "bent blender": ("transforms_train.json", {**LENS, "k1": 0.05, "p1": 0.001}),
}


@pytest.fixture
def photos(tmp_path) -> Path:
    (tmp_path / "cup/images").mkdir(parents=True)
    for view in range(5):
        Image.new("RGB", (16, 12), (40 * view, 90, 20)).save(tmp_path / f"cup/images/{view}.png")
    header = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    (tmp_path / "cup/points.ply").write_text(f"{header}end_header\n0 0 1\n1 0 0\n")
    return tmp_path / "cup"


@pytest.mark.usefixtures("few_random_points")
@pytest.mark.parametrize("kind", FILES)
def test_other_values_in_files_of_frames(photos, kind):
    name, content = FILES[kind]
    content = {**content, "frames": frames("images", 5)}
    choice, noticed = random.Random(kind), 0
    for _ in range(60):
        (photos / name).write_text(json.dumps(with_another(content, choice)))
        result = outcome_within(MEMORY, load_scene, photos)
        if isinstance(result, InputError):
            noticed += 1
        else:
            require_whole(result)
            noticed += any("left out" in note for note in result.notes)
    assert 20 < noticed < 60


@pytest.fixture(scope="module")
def scene(capture) -> Scene:
    return load_scene(capture, factor=4)


def started(scene: Scene, capture: Path, file: Path) -> Gaussians | InputError:
    config = tiny_config(capture, f"train.init={file}").without_plan()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Gaussians left out
        return outcome_within(MEMORY, initial_gaussians, scene, config, str(file))


@pytest.mark.parametrize("suffix", [".ply", ".pt"])
def test_damaged_starts(scene, capture, tmp_path, suffix):
    """Single numbers among the parameters, and bytes anywhere."""
    file, model = tmp_path / f"model{suffix}", random_gaussians(20, sh_degree=1)
    save_ply(model, file) if suffix == ".ply" else save_gsplat(model, file, Frame(np.zeros(3), 1.0))
    content, choice, refused = file.read_bytes(), random.Random(suffix), 0
    body = content.index(b"end_header") + 11 if suffix == ".ply" else 0
    for case in range(40):
        data = bytearray(content)
        if case % 2 and suffix == ".ply":
            for _ in range(choice.choice([1, 5])):
                place = choice.randrange(body, len(data) - 3, 4)
                value = choice.choice([*(number for number in NUMBERS if abs(number) < 1e38 or number != number), 3e38])
                data[place : place + 4] = struct.pack("<f", value)
        else:
            for _ in range(choice.choice([1, 4])):
                data[choice.randrange(len(data))] = choice.randrange(256)
            del data[choice.choice([len(data), choice.randrange(len(data))]) :]
        file.write_bytes(data)
        result = started(scene, capture, file)
        refused += isinstance(result, InputError)
        if not isinstance(result, InputError):
            assert len({len(value) for _, value in result.items()}) == 1 and len(result) > 0
            assert all(value.isfinite().all() for _, value in result.items())
    assert 8 < refused < 40
