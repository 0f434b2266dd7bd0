"""The boundary between Python and the kernels, without a GPU: orders of fields, layouts, other builds, the choice."""

import dataclasses
import re
import subprocess
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.rendering_scenes import make_cameras, make_gaussians

from turbogs_plugin import engine
from turbogs_plugin.engine import ReferenceEngine, layout
from turbogs_plugin.engine.cuda import launches, library, raster
from turbogs_plugin.engine.cuda.training import view_rows
from turbogs_plugin.engine.exposures import Exposures
from turbogs_plugin.engine.moments import GaussianMoments
from turbogs_plugin.engine.render_pass import DEFAULT_OPTIONS
from turbogs_plugin.engine.rules import LossTerms, ParameterRates
from turbogs_plugin.types import TILE_SIZE, Gaussians, GaussianStats, LossOutput, PixelSamples

CSRC = Path(__file__).resolve().parents[2] / "csrc"
LISTS = ("Tensors", "Integers", "Reals")
ROWS = [value for value in vars(layout).values() if isinstance(value, type)]
OBJECTS = (Gaussians, GaussianStats, GaussianMoments, ParameterRates, PixelSamples, LossTerms, LossOutput, Exposures)
"""Classes of the package whose fields launches read, by the names that `launches` has for them."""


@pytest.fixture(scope="module")
def headers(tmp_path_factory) -> dict[str, str]:
    """The generated headers, made where torch cannot be imported, as in a build of its own environment."""
    folder = tmp_path_factory.mktemp("generated")
    code = f"import sys; sys.modules['torch'] = None; sys.path.insert(0, {str(CSRC)!r})\n"
    code += f"import pathlib, generate_headers; generate_headers.write(pathlib.Path({str(folder)!r}))"
    subprocess.run([sys.executable, "-B", "-c", code], check=True, cwd=folder)
    return {path.name: path.read_text() for path in folder.iterdir()}


def struct(header: str, name: str) -> str:
    return re.search(rf"struct {name} {{(.*?)\n}};", header, re.DOTALL)[1]


def constants(text: str) -> dict[str, int]:
    return {name: int(value) for name, value in re.findall(r"constexpr int k(\w+) = (\d+);", text)}


def marked(cls, prefix=()):
    """An object of a class of `launches` whose every field names itself, and the fields by list in their order."""
    fields, lists = {}, {"Tensors": [], "Integers": [], "Reals": [], "rows": [], "more": []}
    kinds = {"Tensor": "Tensors", "Tensor | None": "Tensors", "int": "Integers", "bool": "Integers", "float": "Reals"}
    for name, annotation in cls.__annotations__.items():
        if annotation == "list[int]":
            fields[name] = ["rows", *prefix, name]
            lists["rows"] += fields[name]
        elif annotation == "list[Tensor]":
            fields[name] = ["more", name]
            lists["more"] += fields[name]
        elif annotation in kinds:
            fields[name] = (*prefix, name)
            lists[kinds[annotation]].append(fields[name])
        else:
            fields[name], nested = marked(launches.nested_type(cls, annotation), (*prefix, name))
            for kind, names in nested.items():
                lists[kind] += names
    return (cls if dataclasses.is_dataclass(cls) else SimpleNamespace)(**fields), lists


@pytest.mark.parametrize("cls", launches.LAUNCHES, ids=lambda cls: cls.operator)
def test_fields_travel_in_the_order_that_the_kernels_are_built_with(cls, headers):
    launch, wanted = marked(cls)
    tensors, integers, reals, rows = launch.lists()
    assert list(tensors) == wanted["Tensors"] + wanted["more"] and list(integers) == wanted["Integers"]
    assert list(reals) == wanted["Reals"] and list(rows) == wanted["rows"]
    text = struct(headers["launches.h"], cls.__name__)
    assert f'kName = "{cls.operator}"' in text
    for kind in LISTS:
        names = [path[-1] for path in wanted[kind]]
        assert len(set(names)) == len(names), "C++ knows fields by their last name"
        built = re.search(rf"enum class {kind} {{(.*?)}}", text)[1]
        assert [name.strip() for name in built.split(",") if name.strip()] == names
        assert f"kNum{kind} = {len(names)};" in text
    quoted = ", ".join(f'"{path[-1]}"' for path in wanted["Tensors"])
    assert f"kTensorNames[] = {{{quoted}}};" in text


def bindings() -> dict[str, str]:
    """The functions of csrc/bindings that read arguments, by name; those of a launch by that of its class."""
    source = "".join(path.read_text() for path in sorted((CSRC / "bindings").iterdir()))
    signature = r"\b(\w+)(?:::run)?\(const Arguments<"
    parts = [part for part in source.split("\n}\n") if re.search(signature, part)]
    return {re.findall(signature, part)[-1]: part for part in parts}


@pytest.mark.parametrize("cls", launches.LAUNCHES, ids=lambda cls: cls.operator)
def test_the_bindings_read_every_field(cls):
    functions = bindings()
    text, called = "", [cls.__name__]
    while called:
        body = functions.pop(called.pop())
        called += [name for name in functions if f"{name}(in" in body and name not in called]
        text += body
    assert f"launches::{cls.__name__}" in text
    for kind, paths in zip(LISTS, cls.paths, strict=False):
        for path in paths:
            name = path.split(".")[-1]
            assert re.search(rf"\b(?:{kind[0]}|{kind})::{name}\b", text), f"{name} is not read"


def test_the_objects_of_the_package_have_the_fields_that_launches_read():
    for cls in OBJECTS:
        wanted = getattr(launches, cls.__name__).__annotations__
        assert set(wanted) <= {field.name for field in dataclasses.fields(cls)} | {*dir(cls)}, cls
    for empty, name in ((launches.NO_STATS, "GaussianStats"), (launches.NO_MAPS, "ErrorMaps")):
        assert vars(empty) == dict.fromkeys(getattr(launches, name).__annotations__)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.__name__)
def test_the_kernels_have_the_columns_of_a_row_where_python_has_them(row, headers):
    places = {name: place.start for name, place in layout.columns(row).items()}
    built = constants(struct(headers["layout.h"], row.__name__))
    assert built.pop("Size") == row.SIZE
    assert {re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower(): place for name, place in built.items()} == places


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.__name__)
def test_columns_of_a_row_follow_one_another(row):
    end = 0
    for name, place in layout.columns(row).items():
        assert place.start == end < place.stop <= row.SIZE, name
        end = place.stop
    assert end == (0 if row is layout.CameraRow else row.SIZE)
    assert layout.ScreenRecord.SIZE % 4 == layout.InstanceRow.SIZE % 4 == layout.CameraRow.SIZE % 4 == 0  # quads


def test_the_kernels_have_the_sizes_and_enumerations_of_python(headers):
    text = headers["layout.h"].split("struct ")[0]
    sizes = {name: value for name, value in vars(layout).items() if isinstance(value, int)}
    sizes["TILE_SIZE"] = TILE_SIZE
    built = {re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).upper(): value for name, value in constants(text).items()}
    assert sizes.items() <= built.items()
    for name, values in (("SampleUnit", layout.SAMPLE_UNITS), ("Structure", layout.STRUCTURES)):
        entries = re.search(rf"enum class {name} : int {{(.*?)}}", text)[1].split(",")
        assert [entry.strip().removeprefix("k").lower() for entry in entries] == [v.replace("_", "") for v in values]
    assert "enum class UpdateKind : int { kAdam, kMomentLm, kUnscaledLm };" in text
    assert layout.UPDATE_KINDS == ("adam", "moment_lm", "unscaled_lm")


def test_rows_of_views_are_what_the_layout_says():
    sizes = np.array([[37, 29], [20, 50]])
    rows = view_rows([7, 1080], sizes, (5, 9), [(3, 10, 11, 12, 0, 6), (4, 20, 21, 22, 30, 8)])
    second = rows[layout.DrawRow.SIZE :]
    assert len(rows) == 2 * layout.DrawRow.SIZE
    assert second[layout.DrawRow.FIRST_PIXEL] == 1080 and second[layout.DrawRow.NUMBER] == 9
    assert (second[layout.DrawRow.WIDTH], second[layout.DrawRow.HEIGHT]) == (20, 50)
    assert second[layout.DrawRow.FIRST_SLOT] == 4 and second[layout.DrawRow.STAGES] == [20, 21, 22]
    assert (second[layout.DrawRow.FIRST_LIVE], second[layout.DrawRow.LIVE]) == (30, 8)
    assert view_rows([7, 1080], sizes, (5, 9))[layout.ViewRow.SIZE :] == second[: layout.ViewRow.SIZE]


def test_selected_cameras_are_read_from_the_memory_of_all():
    """Nothing is stacked for a launch, which names the row of each view's camera."""
    cameras, gaussians = make_cameras([(40, 30), (20, 21), (30, 50)], torch.float32), make_gaussians(4)
    scene = raster.scene_of(gaussians, cameras.select([2, 0]), DEFAULT_OPTIONS)
    assert scene.viewmats.data_ptr() == cameras.viewmats.data_ptr() and scene.viewmats.shape == (3, 4, 4)
    assert scene.Ks.data_ptr() == cameras.Ks.data_ptr() and scene.images == [30, 50, 2, 40, 30, 0]
    assert len(scene.images) == 2 * layout.ImageRow.SIZE and scene.images[layout.ImageRow.CAMERA] == 2


@pytest.fixture
def loaded(monkeypatch, tmp_path):
    """A library that loads; what it tells of its interface is the caller's to say."""
    path = tmp_path / "_C.abi3.so"
    path.touch()
    monkeypatch.setenv(library.LIBRARY_VARIABLE, str(path))
    monkeypatch.setattr(torch.ops, "load_library", lambda path: None)
    library._load_failure.cache_clear()
    yield lambda text: monkeypatch.setattr(torch.ops.turbogs, "interface", lambda: text, raising=False)
    library._load_failure.cache_clear()


def test_a_library_of_other_sources_is_refused(loaded):
    present = layout.interface(launches.LAUNCHES)
    loaded(present)
    assert library._load_failure() == ""
    for other in ("", present.replace("tile_starts", "tile_ends", 1), present.replace("of 16", "of 20", 1)):
        assert other != present
        library._load_failure.cache_clear()
        loaded(other)
        assert "was built from other sources than this package: build it again" in library._load_failure()


def test_the_interface_changes_with_every_order_and_size(monkeypatch):
    present = layout.interface(launches.LAUNCHES)
    monkeypatch.setattr(layout.ScreenRecord, "DEPTH", 15)
    assert layout.interface(launches.LAUNCHES) != present
    monkeypatch.undo()
    monkeypatch.setattr(launches, "LAUNCHES", launches.LAUNCHES[1:])
    assert layout.interface(launches.LAUNCHES) != present


def test_a_gpu_without_kernels_is_named_and_gets_the_reference(monkeypatch):
    """A training by the reference on a GPU looks like one that hangs."""
    monkeypatch.setattr(engine.library, "unavailable_reason", lambda: "_C.abi3.so is not built")
    with pytest.warns(UserWarning, match=r"kernels are not usable \(_C\.abi3\.so is not built\)"):
        assert isinstance(engine.engine_of(torch.device("cuda")), ReferenceEngine)


def test_the_cpu_has_the_reference_without_a_word():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert isinstance(engine.engine_of(torch.device("cpu")), ReferenceEngine)
