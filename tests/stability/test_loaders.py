"""Checkpoints, configurations, photos and masks that were damaged or made to harm: a clear error or a correct result.

Memory is bounded. The loaders of COLMAP models and of .ply files are in captures/test_hostile.py.
"""

from __future__ import annotations

import contextlib
import copy
import gzip
import io
import pickle
import random
import shutil
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.bounded_memory import damaged, outcome_within
from helpers.framework_runs import tiny_config
from PIL import Image

from turbogs_plugin.captures import load_scene
from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.errors import InputError
from turbogs_plugin.model.spz import HEADER, MAGIC, VERSION
from turbogs_plugin.train import inputs, run
from turbogs_plugin.train.checkpoint import latest_checkpoint, load_checkpoint, require_like, save_checkpoint
from turbogs_plugin.train.saved_model import load_model, read_given
from turbogs_plugin.types import PARAMETER_NAMES

MEMORY = 64 * 2**20
"""Python and numpy may allocate this much for files of less than a megabyte."""


@pytest.fixture(scope="module")
def finished(capture, tmp_path_factory) -> Path:
    """The folder of a finished run, which is not to be changed."""
    lengths = ("train.iterations=4", "train.checkpoint_every=3")
    config = tiny_config(capture, *lengths, "train.refine_cameras=false", "scene.force=true")
    return run.train(config, tmp_path_factory.mktemp("runs") / "run").folder.path


def leaves(value, path=()):
    """(path, leaf) of a nested state."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from leaves(item, (*path, key))
    else:
        yield path, value


def with_other_places(value):
    """A copy of a nested state with the same leaves."""
    return {key: with_other_places(item) for key, item in value.items()} if isinstance(value, dict) else value


def hostile_leaf(value, choice: random.Random):
    """Something else in the place of a value."""
    others = [None, "text", -1, 2**70, float("nan"), [], {}, [[1]], torch.zeros(0), torch.zeros(3, 1, 2), True]
    others += [10**6, 2**31 - 1, -(10**6), 1e38] if not isinstance(value, torch.Tensor) else []
    if isinstance(value, torch.Tensor):
        others += [value[:-1], value.reshape(-1), torch.cat([value, value])] if value.dim() else [value.reshape(1)]
        limits = torch.finfo(value.dtype) if value.is_floating_point() else torch.iinfo(value.dtype)
        extremes = (limits.min, limits.max, *((torch.nan,) if value.is_floating_point() else ()))
        others += [torch.full_like(value, extreme) for extreme in extremes]
    return choice.choice(others)


@pytest.mark.parametrize(("iteration", "least"), [(3, 50), (4, 25)])
def test_checkpoints_with_other_values(iteration, least, finished, tmp_path, monkeypatch):
    """Every value of the state in turn replaced by another or left out: no model is given out that is not whole and
    finite, and a run refuses, or goes on by a step from a state of the same form."""

    def go_on(session, *_):
        require_like(session.state_dict(), state, str(path))
        session.trainer.step()

    monkeypatch.setattr(run.RunSession, "run", go_on)
    config = run.RunFolder(finished).read_config()
    monkeypatch.setattr(run.RunFolder, "read_config", lambda *_: copy.deepcopy(config))
    scene = load_scene(config.scene.path)
    monkeypatch.setattr(inputs, "load_scene", lambda *_, **__: scene)
    state = load_checkpoint(finished / f"checkpoints/iteration-00000{iteration}.pt")
    (tmp_path / "run").mkdir()
    shutil.copy(finished / "config.yaml", tmp_path / "run")
    choice, refused, cases = random.Random(3), 0, 0
    for path, _ in list(leaves(state)):
        changed = with_other_places(state)
        parent = changed
        for key in path[:-1]:
            parent = parent[key]
        if choice.random() < 0.2:
            del parent[path[-1]]
        else:
            parent[path[-1]] = hostile_leaf(parent[path[-1]], choice)
        save_checkpoint(tmp_path / "run/checkpoints", iteration, changed)
        cases += 1
        with contextlib.suppress(InputError):
            model = load_model(tmp_path / "run", torch.device("cpu")).gaussians
            assert all(value.isfinite().all() for _, value in model.items()), path
            assert len({len(value) for _, value in model.items()}) == 1, path
        try:
            run.resume(tmp_path / "run")
        except InputError:
            refused += 1
    assert cases > least and refused > 0.6 * cases


NUMBERS = {"0x": "f" * 20_000, "1:": "59:" * 15_000 + "59", "2:": "59:" * 15_000 + "59.5", "9": "9" * 5000}
"""Beginnings and digits of numbers of YAML that no float has room for, nor a line's text."""
BOMBS = {
    "aliases": "a: &a [x]\n" + "".join(f"b{i}: &b{i} [*a, *a]\n" for i in range(50)),
    "tag": "a: !!python/object/apply:os.system ['true']",
    "depth": "a: " + "{a: " * 5000 + "1" + "}" * 5000,
    "width": "a: [" + "1," * 100_000 + "1]",
    **{f"number {kind}": f"train: {{epochs: {kind}{digits}}}" for kind, digits in NUMBERS.items()},
    "interpolation": "a: ${oc.env:HOME}\nb: ${a}${a}",
    "control characters": "a: \x00\x07",
}


@pytest.mark.parametrize("name", BOMBS)
def test_yaml_bombs(tmp_path, name):
    (tmp_path / "bomb.yaml").write_text(BOMBS[name])
    assert isinstance(outcome_within(MEMORY, load_config, str(tmp_path / "bomb.yaml")), InputError)


def archived(values: bytes) -> bytes:
    """A file of `torch.save` with these pickled values."""
    with zipfile.ZipFile(file := io.BytesIO(), "w") as archive:
        archive.writestr("a/data.pkl", values)
        archive.writestr("a/version", "3")
    return file.getvalue()


def doubled(kind: type) -> Any:
    """A value of 2^24 leaves, of a few objects."""
    value = kind([0])
    for _ in range(24):
        value = kind([value, value])
    return value


def meta() -> bytes:
    torch.save({"splats": dict.fromkeys(PARAMETER_NAMES, torch.zeros(5, 3, device="meta"))}, file := io.BytesIO())
    return file.getvalue()


def spz(count: int, degree: int) -> bytes:
    header = HEADER.pack(MAGIC, VERSION, count, degree, 12, 0, 0)
    return gzip.compress(header + bytes(count * (20 + 3 * ((degree + 1) ** 2 - 1))), 9)


def called(name: str, bytes_: int) -> bytes:
    return archived(b"\x80\x02c" + name.encode() + b"\n\x8a\x08" + struct.pack("<q", bytes_) + b"\x85R.")


MODEL_BOMBS = {
    "lists of lists.pt": lambda: archived(pickle.dumps({"splats": doubled(list)}, 2)),
    "tuples of tuples.pt": lambda: archived(pickle.dumps({"splats": doubled(tuple)}, 2)),
    "a key of tuples.pt": lambda: archived(b"\x80\x02}" + pickle.dumps(doubled(tuple), 2)[2:-1] + b"K\x01s."),
    "a key of tuples in tuples.pt": lambda: archived(b"\x80\x02}K\x01" + b"\x85" * 200_000 + b"K\x01s."),
    "bytes that are made.pt": lambda: called("builtins\nbytearray", 2**28),
    "a storage that is made.pt": lambda: called("torch.storage\nUntypedStorage", 2**28),
    "tensors that are nowhere.pt": meta,
    "degree 3.spz": lambda: spz(200_000, 3),
    "degree 0.spz": lambda: spz(500_000, 0),
}


@pytest.mark.parametrize("name", MODEL_BOMBS)
def test_small_models_do_not_grow(tmp_path, name):
    (tmp_path / name).write_bytes(MODEL_BOMBS[name]())
    assert isinstance(outcome_within(MEMORY, read_given, tmp_path / name), InputError)


def damages(content: bytes, choice: random.Random) -> list[bytes]:
    """An image's bytes cut, empty, of text, of a size that no memory has room for, and damaged."""
    bomb = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR\x7f\xff\xff\xff\x7f\xff\xff\xff" + content[24:]
    broken = [b"", b"\xff", b"not a photo", content[: len(content) // 2], bomb]
    return [*broken, *(damaged(content, choice) for _ in range(25))]


@pytest.mark.parametrize("folder", ["images", "masks"])
def test_damaged_photos_and_masks(capture, tmp_path, folder):
    """One is named, or read as an image; a mask as one of its photo's size."""
    capture, refused = shutil.copytree(capture, tmp_path / "capture"), 0
    file = sorted((capture / "images").iterdir())[2]
    if folder == "masks":
        (capture / "masks").mkdir()
        file = capture / "masks" / f"{file.stem}.png"
        Image.fromarray(np.random.default_rng(0).integers(0, 2, (24, 40)).astype(np.uint8) * 255).save(file)
    for number, changed in enumerate(damages(file.read_bytes(), random.Random(7))):
        file.write_bytes(changed)
        result = outcome_within(MEMORY, load_scene, capture)
        refused += isinstance(result, InputError)
        assert number > 4 or isinstance(result, InputError), number
        if isinstance(result, InputError):
            assert file.name in str(result) and "\n" not in str(result)
        else:
            assert np.isfinite(result.train.photos.colors.float().mean().item())
            assert result.train.masks is None or (result.train.masks.pixel_counts > 0).all()
    assert refused > 10 and (folder == "images" or refused < 30), "no damage was harmless"


@pytest.mark.parametrize("name", ["means", "opacities", "shN"])
def test_a_saved_model_that_is_not_finite_is_not_handed_out(finished, tmp_path, name):
    shutil.copytree(finished, tmp_path / "run")
    state = load_checkpoint(latest_checkpoint(finished / "checkpoints"))
    state["trainer"]["gaussians"][name].view(-1)[0] = torch.nan
    save_checkpoint(tmp_path / "run/checkpoints", 4, state)
    with pytest.raises(InputError, match="not finite"):
        load_model(tmp_path / "run", torch.device("cpu"))
