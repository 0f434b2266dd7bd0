"""Strategies by name: built-in ones, and those of others."""

import importlib.metadata
import sys
from pathlib import Path

import pytest
import torch
from helpers.refusals import assert_refused

from turbogs_plugin.config import components
from turbogs_plugin.config.components import build
from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.config.scaling import with_iterations
from turbogs_plugin.errors import InputError
from turbogs_plugin.strategies import TYPES
from turbogs_plugin.train.run import resume
from turbogs_plugin.train.run_files import RunFolder
from turbogs_plugin.train.saved_model import load_model
from turbogs_plugin.yaml_json import yaml_text

MODULE = """
from dataclasses import dataclass
from turbogs_plugin.strategies.protocols import DensityController

@dataclass
class MySampler:
    share: float = 0.1

    def __post_init__(self):
        if self.share > 1:
            raise ValueError(f"share = {self.share} is too much")

    def sample(self, maps, view_ids, rate, step): ...

@dataclass
class MyLoss:
    def __call__(self, colors, targets, samples): ...

@dataclass
class Fading(DensityController):
    opacity_decay: float = 0.2

    def update(self, gaussians, step): ...

@dataclass
class Half:
    def setup(self, gaussians): ...
    def update(self, gaussians, step): ...

@dataclass
class Unresolved:
    value: "Absent" = None

class Plain:
    Inner = MySampler

instance = MySampler()
"""


@pytest.fixture(autouse=True)
def module_here(monkeypatch, tmp_path):
    """A module in the current folder, which Python's own path does not have."""
    (tmp_path / "third_party.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry not in ("", str(tmp_path))])
    yield
    sys.modules.pop("third_party", None)


@pytest.fixture
def plug_in(monkeypatch):
    """Register a class by entry point."""

    def plug_in(kind: str, name: str, value: str) -> None:
        point = importlib.metadata.EntryPoint(name, value, f"turbogs.{kind}")
        monkeypatch.setattr(components, "entry_points", lambda group, **_: [point] * (group == point.group))
        monkeypatch.syspath_prepend(".")

    return plug_in


@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind, types in TYPES.items() for name in types])
def test_every_name_builds_with_its_defaults(kind, name):
    assert type(build(kind, {"type": name})).__name__ == TYPES[kind][name].partition(":")[2]


def test_an_entry_point_is_a_type(plug_in):
    plug_in("pixel_sampler", "few", "third_party:Plain.Inner")
    assert build("pixel_sampler", {"type": "few", "share": 0.5}).share == 0.5
    plug_in("pixel_sampler", "dense", "third_party:MySampler")
    assert type(build("pixel_sampler", {"type": "dense"})).__name__ == "DensePixelSampler"


@pytest.mark.parametrize("value", ["no_such_module:X", "third_party:Absent", "not a place"])
def test_a_broken_entry_point_is_named(plug_in, value):
    plug_in("pixel_sampler", "few", value)
    assert_refused(f"few.*{value}.*cannot be imported", build, "pixel_sampler", {"type": "few"})


@pytest.mark.parametrize("source", ["import sys; sys.exit('two\\nlines')", "raise RuntimeError('two\\nlines')"])
def test_a_module_that_breaks_as_it_is_imported_is_named(source):
    Path("breaking.py").write_text(source)
    with pytest.raises(InputError, match=r"breaking:X.*cannot be imported: (SystemExit|RuntimeError): two lines$"):
        build("pixel_sampler", {"type": "breaking:X"})


REFUSED = [
    ("loss", {"type": "charbonier"}, "did you mean 'charbonnier'"),
    ("losses", {}, "did you mean 'loss'"),
    ("schedule", {"type": "fixed", "view": 1}, "did you mean 'views'"),
    ("schedule", ["fixed"], "expected keys and values"),
    ("pixel_sampler", {"type": "no_such_module:X"}, "'no_such_module:X'.*cannot be imported: ModuleNotFoundError"),
    *(("pixel_sampler", {"type": f"third_party:{x}"}, "not a dataclass") for x in ("instance", "Plain")),
    ("pixel_sampler", {"type": "third_party:MySampler", "shar": 1}, "did you mean 'share'"),
    ("pixel_sampler", {"type": "third_party:MySampler", "share": 2.0}, "pixel_sampler: share = 2.0 is too much"),
    ("pixel_sampler", {"type": "third_party:Unresolved"}, "a type of Unresolved's fields.*Absent"),
    ("loss", {"type": "third_party:MySampler"}, "is no SparseLoss: it lacks __call__; inherit from"),
    ("density", {"type": "third_party:Half"}, "lacks stats, uses_errors, event_due, growth_room, apply, state"),
]


@pytest.mark.parametrize(("kind", "mapping", "words"), REFUSED)
def test_what_does_not_fit_is_refused(kind, mapping, words):
    assert_refused(words, build, kind, mapping)


@pytest.fixture
def shared_run(tmp_path):
    """A run whose density control lies beside its configuration, and notes that it was imported."""
    (tmp_path / "third_party.py").write_text(f"import pathlib; pathlib.Path('ran').touch()\n{MODULE}")
    config = load_config("turbogs", ["scene.path=none"]).without_plan().to_mapping()
    config["density"] = {"type": "third_party:Fading", "opacity_decay": 0.2}
    (tmp_path / "config.yaml").write_text(yaml_text(config))
    return RunFolder(tmp_path)


def test_reading_a_run_imports_nothing_that_it_names(shared_run, monkeypatch):
    monkeypatch.syspath_prepend(".")
    assert shared_run.read_config().density["type"] == "third_party:Fading"
    for command in (lambda: load_model(shared_run.path, torch.device("cpu")), lambda: resume(shared_run.path)):
        with pytest.raises(InputError):
            command()
    assert not Path("ran").exists()


@pytest.mark.parametrize("by_entry_point", [False, True])
def test_code_of_a_run_that_is_not_installed_needs_trust(shared_run, plug_in, monkeypatch, capsys, by_entry_point):
    if by_entry_point:  # of a package in the run's own folder
        plug_in("density", "fading", "third_party:Fading")
        shared_run.config.write_text(shared_run.config.read_text().replace("third_party:Fading", "fading"))
    assert_refused(r"config.yaml': density.type '.*third_party\.py\): .* --trust", shared_run.read_config, built=True)
    assert not Path("ran").exists() and not capsys.readouterr().err
    shared_run.read_config(built=True, trusted=True)
    assert Path("ran").exists() and "third_party.py" in capsys.readouterr().err


def test_an_installed_module_of_a_run_needs_no_trust(shared_run, monkeypatch, tmp_path):
    monkeypatch.setattr(components.site, "getsitepackages", lambda: [str(tmp_path)])
    assert shared_run.read_config(built=True).density["opacity_decay"] == 0.2


def test_a_type_may_be_a_class_in_a_file_and_has_the_defaults_of_its_protocol():
    Path("mine.yaml").write_text("base: demo\npixel_sampler: {type: 'third_party:MySampler', share: 0.3}\n")
    from_yaml = load_config("mine.yaml")
    overridden = load_config("demo", ["pixel_sampler.type=third_party:MySampler", "pixel_sampler.share=0.3"])
    assert from_yaml == overridden and from_yaml.build("pixel_sampler").share == 0.3
    assert from_yaml.build("pixel_sampler").heeds_masks is False
    assert build("loss", {"type": "third_party:MyLoss"}).terms is None
    fading = {"type": "third_party:Fading", "opacity_decay": 0.2}  # and no interval
    assert with_iterations(load_config("turbogs", ["density.type=third_party:Fading"]), 500).density == fading
