"""Strategies by name: ours, and those of others."""

import importlib.metadata
import sys
import types
from dataclasses import dataclass

import pytest

from turbogs_plugin import registry
from turbogs_plugin.errors import InputError

ALL_TYPES = [(kind, name) for kind, types_of_kind in registry.BUILT_IN.items() for name in types_of_kind]


@pytest.mark.parametrize(("kind", "name"), ALL_TYPES)
def test_every_name_builds_with_its_defaults(kind, name):
    strategy = registry.build(kind, {"type": name})
    assert type(strategy).__name__ == registry.BUILT_IN[kind][name].rpartition(":")[2]


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


def _plug_in(monkeypatch, name: str, value: str) -> None:
    module = types.ModuleType("third_party_samplers")
    module.FewPixels = FewPixels
    monkeypatch.setitem(sys.modules, "third_party_samplers", module)
    point = importlib.metadata.EntryPoint(name, value, "turbogs.pixel_sampler")
    monkeypatch.setattr(registry, "entry_points", lambda group: [point] if group == "turbogs.pixel_sampler" else [])


def test_an_entry_point_is_a_type(monkeypatch):
    _plug_in(monkeypatch, "few", "third_party_samplers:FewPixels")
    assert registry.build("pixel_sampler", {"type": "few", "share": 0.5}) == FewPixels(0.5)
    with pytest.raises(InputError, match=r"unknown loss\.type"):
        registry.build("loss", {"type": "few"})


def test_an_entry_point_does_not_take_over_our_names(monkeypatch):
    _plug_in(monkeypatch, "dense", "third_party_samplers:FewPixels")
    assert type(registry.build("pixel_sampler", {"type": "dense"})).__name__ == "DensePixelSampler"


@pytest.mark.parametrize("value", ["no_such_module:X", "third_party_samplers:Absent"])
def test_a_broken_entry_point_is_named(monkeypatch, value):
    _plug_in(monkeypatch, "few", value)
    with pytest.raises(InputError, match=f"few.*{value}.*cannot be imported"):
        registry.build("pixel_sampler", {"type": "few"})
