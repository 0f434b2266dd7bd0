"""Strategies by name: ours, and those of others."""

import importlib.metadata
import sys
import types
from dataclasses import dataclass
from pathlib import Path

import pytest
from turbogs_plugin.strategies.protocols import DensityController

from turbogs_plugin.config import registry
from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.config.scaling import with_iterations
from turbogs_plugin.errors import InputError

ALL_TYPES = [(kind, name) for kind, types_of_kind in registry.BUILT_IN.items() for name in types_of_kind]


@pytest.mark.parametrize(("kind", "name"), ALL_TYPES)
def test_every_name_builds_with_its_defaults(kind, name):
    strategy = registry.build(kind, {"type": name})
    assert type(strategy).__name__ == registry.BUILT_IN[kind][name]


@pytest.mark.parametrize(
    ("kind", "mapping", "message"),
    [
        ("loss", {"type": "charbonier"}, "did you mean 'charbonnier'"),
        ("loss", {"type": 5}, "unknown loss.type '5'"),
        ("losses", {}, "did you mean 'loss'"),
        ("schedule", {"type": "fixed", "view": 1}, "did you mean 'views'"),
        ("schedule", ["fixed"], "expected a mapping"),
    ],
)
def test_unknown_names_are_named(kind, mapping, message):
    with pytest.raises(InputError, match=message):
        registry.build(kind, mapping)


@dataclass
class FewPixels:
    """A third party's sampler."""

    share: float = 0.1

    def __post_init__(self) -> None:
        if self.share > 1:
            raise ValueError(f"share = {self.share} is too much")

    def sample(self, maps, view_ids, rate, step):
        raise NotImplementedError


@dataclass
class Unresolved:
    value: "Absent" = None  # noqa: F821


def _plug_in(monkeypatch, name: str, value: str) -> None:
    module = types.ModuleType("third_party_samplers")
    module.FewPixels, module.Unresolved, module.Fading = FewPixels, Unresolved, Fading
    module.Outer = type("Outer", (), {"Inner": FewPixels})
    module.NoSampler = dataclass(type("NoSampler", (), {}))
    module.Half = dataclass(type("Half", (), {"setup": FewPixels.sample, "update": FewPixels.sample}))
    module.Plain = type("Plain", (), {"sample": FewPixels.sample})
    module.number, module.function, module.instance = 5, lambda: FewPixels(), FewPixels()
    monkeypatch.setitem(sys.modules, "third_party_samplers", module)
    point = importlib.metadata.EntryPoint(name, value, "turbogs.pixel_sampler")
    groups = ("turbogs.pixel_sampler", "turbogs.density")
    monkeypatch.setattr(registry, "entry_points", lambda group: [point] if group in groups else [])


def test_an_entry_point_is_a_type(monkeypatch):
    _plug_in(monkeypatch, "few", "third_party_samplers:FewPixels")
    assert registry.build("pixel_sampler", {"type": "few", "share": 0.5}) == FewPixels(0.5)
    with pytest.raises(InputError, match=r"unknown loss\.type"):
        registry.build("loss", {"type": "few"})


def test_an_entry_point_does_not_take_over_our_names(monkeypatch):
    _plug_in(monkeypatch, "dense", "third_party_samplers:FewPixels")
    assert type(registry.build("pixel_sampler", {"type": "dense"})).__name__ == "DensePixelSampler"


def test_an_entry_point_may_be_nested(monkeypatch):
    _plug_in(monkeypatch, "few", "third_party_samplers:Outer.Inner")
    assert registry.build("pixel_sampler", {"type": "few"}) == FewPixels()


@pytest.mark.parametrize("value", ["no_such_module:X", "third_party_samplers:Absent", "not a place"])
def test_a_broken_entry_point_is_named(monkeypatch, value):
    _plug_in(monkeypatch, "few", value)
    with pytest.raises(InputError, match=f"few.*{value}.*cannot be imported"):
        registry.build("pixel_sampler", {"type": "few"})


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("x = (", "SyntaxError"),
        ("x = absent", "NameError"),
        ("import sys; sys.exit(0)", "SystemExit"),
        ("raise RuntimeError('two\\nlines')", "RuntimeError: two lines"),
    ],
)
def test_a_module_that_breaks_as_it_is_imported_is_named(monkeypatch, tmp_path, source, reason):
    (tmp_path / "breaking_samplers.py").write_text(source)
    monkeypatch.syspath_prepend(str(tmp_path))
    _plug_in(monkeypatch, "few", "breaking_samplers:X")
    with pytest.raises(InputError, match=f"few.*breaking_samplers:X.*cannot be imported: {reason}"):
        registry.build("pixel_sampler", {"type": "few"})


@pytest.mark.parametrize(
    ("attribute", "options", "words"),
    [
        ("number", {}, "few.*is not a dataclass"),
        ("function", {}, "few.*is not a dataclass"),
        ("instance", {}, "few.*is not a dataclass"),
        ("Plain", {}, "few.*is not a dataclass"),
        ("NoSampler", {}, "few.*is no PixelSampler: it lacks sample"),
        ("Unresolved", {}, "pixel_sampler: a type of Unresolved's fields.*Absent"),
        ("FewPixels", {"share": 2.0}, "pixel_sampler: share = 2.0 is too much"),
    ],
)
def test_what_is_no_sampler_is_refused(monkeypatch, attribute, options, words):
    _plug_in(monkeypatch, "few", f"third_party_samplers:{attribute}")
    with pytest.raises(InputError, match=words):
        registry.build("pixel_sampler", {"type": "few", **options})


@dataclass
class Fading(DensityController):
    """A third party's density control, which counts no iterations."""

    opacity_decay: float = 0.2

    def update(self, gaussians, step):
        return None


def test_a_decay_without_an_interval_may_be_scaled(monkeypatch):
    _plug_in(monkeypatch, "fading", "third_party_samplers:Fading")
    config = load_config("turbogs", ["density.type=fading"])
    assert with_iterations(config, 500).density == {"type": "fading", "opacity_decay": 0.2}


def test_all_that_a_class_lacks_is_named(monkeypatch):
    _plug_in(monkeypatch, "half", "third_party_samplers:Half")
    lacking = "is no DensityController: it lacks stats, event_due, growth_room, apply, "
    lacking += "state_dict, load_state_dict"
    with pytest.raises(InputError, match=lacking):
        registry.build("density", {"type": "half"})


SAMPLER = """
from dataclasses import dataclass

@dataclass
class MySampler:
    share: float = 0.1

    def sample(self, maps, view_ids, rate, step): ...
"""


@pytest.fixture
def file_here(monkeypatch, tmp_path):
    """A module in the current folder, which Python's own path does not have."""
    (tmp_path / "samplers_of_mine.py").write_text(SAMPLER)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry not in ("", str(tmp_path))])
    yield "samplers_of_mine:MySampler"
    sys.modules.pop("samplers_of_mine", None)


def test_a_type_may_be_a_class_in_a_file(file_here):
    Path("mine.yaml").write_text(f"base: demo\npixel_sampler: {{type: {file_here}, share: 0.3}}\n")
    from_yaml = load_config("mine.yaml")
    overridden = load_config("demo", [f"pixel_sampler.type={file_here}", "pixel_sampler.share=0.3"])
    for config in (from_yaml, overridden):
        sampler = config.build("pixel_sampler")
        assert (type(sampler).__name__, sampler.share) == ("MySampler", 0.3)
        assert config.pixel_sampler == {"type": file_here, "share": 0.3}


@pytest.mark.parametrize(
    ("mapping", "words"),
    [
        (
            {"type": "no_such_module:X"},
            "pixel_sampler.type 'no_such_module:X'.*cannot be imported: ModuleNotFoundError",
        ),
        ({"type": "samplers_of_mine:Absent"}, "cannot be imported: AttributeError"),
        ({"type": "samplers_of_mine:"}, "cannot be imported"),
        ({"type": "os:sep"}, "'os:sep' .*is not a dataclass"),
        ({"type": "samplers_of_mine:MySampler", "shar": 1}, "did you mean 'share'"),
        ({"type": "dataclasses:Field"}, "is not a dataclass"),
    ],
)
def test_a_class_that_does_not_fit_is_refused_as_an_entry_point_is(file_here, mapping, words):
    with pytest.raises(InputError, match=words):
        registry.build("pixel_sampler", mapping)


def test_a_class_of_another_kind_names_what_it_lacks(file_here):
    message = rf"loss.type '{file_here}' \({file_here}\) is no SparseLoss: it lacks __call__"
    with pytest.raises(InputError, match=message):
        registry.build("loss", {"type": file_here})
