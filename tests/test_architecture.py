"""docs/architecture.md and the names that the packages export: what they name exists."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest
import torch

import turbogs_plugin
from turbogs_plugin import strategies
from turbogs_plugin.captures import write_demo_capture
from turbogs_plugin.config import registry

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "architecture.md"
FOLDERS = ("turbogs_plugin/", "strategies/", "csrc/", "configs/", "docs/")


def named_places() -> list[str]:
    return re.findall(r"`([\w./-]+)`", PAGE.read_text(encoding="utf-8"))


def test_every_file_that_the_architecture_names_exists():
    places = [place for place in named_places() if place.startswith(FOLDERS)]
    assert len(places) > 40
    assert [place for place in places if not (ROOT / place).exists()] == []
    loose = [place for place in named_places() if place.endswith((".py", ".cu")) and not place.startswith(FOLDERS)]
    assert loose == [], "a file is named with its folder"


def test_every_function_that_the_architecture_names_is_in_its_file():
    """Of what it says "`name` in `file`", "`name` and `other` in `file`" and "`name` there", of the file named last."""
    missing, found, file = [], 0, ""
    names = r"`\w+(?:\.\w+)*`"
    for said in re.findall(rf"({names}(?:(?:, | and ){names})*) (?:in (`[\w./-]+\.\w+`)|there)", PAGE.read_text()):
        file = said[1].strip("`") or file
        text = (ROOT / file).read_text(encoding="utf-8")
        for name in re.findall(r"[\w.]+", said[0]):
            found += 1
            if any(part not in text for part in name.split(".")):
                missing.append((name, file))
    assert found > 25
    assert missing == []


def test_the_architecture_names_every_folder():
    folders = {path.parent.name for path in (ROOT / "turbogs_plugin").glob("*/__init__.py")}
    text = PAGE.read_text(encoding="utf-8")
    assert [folder for folder in sorted(folders) if f"`turbogs_plugin/{folder}/`" not in text] == []


def imported_rooms(file: Path) -> set[str]:
    """The parts of `turbogs_plugin` that a file imports, at its top or later."""
    modules = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            modules |= {f"{node.module}.{alias.name}" for alias in node.names}
    split = (module.split(".") for module in modules)
    return {parts[1] for parts in split if parts[0] == "turbogs_plugin"}


def test_imports_point_one_way():
    (sentence,) = re.findall(r"Imports point one way, [^:]*: ([^.]*)\.", PAGE.read_text(encoding="utf-8"))
    rooms = re.findall(r"`(\w+)`", sentence)
    folders = {room: ROOT / "turbogs_plugin" / room for room in rooms} | {"strategies": ROOT / "strategies"}
    there = {path.stem for path in (ROOT / "turbogs_plugin").iterdir() if path.suffix in ("", ".py")}
    assert there - set(rooms) - {"__pycache__"} == {"__init__", "__main__"}
    wrong = [
        (str(file.relative_to(ROOT)), room)
        for place, own in enumerate(rooms)
        for file in sorted([*folders[own].rglob("*.py"), folders[own].with_suffix(".py")])
        if file.is_file()
        for room in imported_rooms(file) & set(rooms[place + 1 :])
    ]
    assert wrong == []


@pytest.mark.parametrize("package", [turbogs_plugin, strategies])
def test_a_package_has_what_it_exports(package):
    for name in package.__all__:
        assert getattr(package, name).__name__ == name if name != "__version__" else package.__version__
    with pytest.raises(AttributeError, match="no attribute 'absent'"):
        package.absent  # noqa: B018


def test_every_built_in_strategy_is_exported():
    built_in = {name for names in registry.BUILT_IN.values() for name in names.values()}
    assert built_in <= set(strategies.__all__)
    protocols = {protocol.__name__ for protocol in registry.PROTOCOLS.values()}
    assert protocols <= set(strategies.__all__)


def test_readmes_three_lines(tmp_path):
    """As they stand there, on a smaller capture and for fewer iterations."""
    (block,) = re.findall(
        r"```python\nimport turbogs_plugin\n\n(scene = .*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.S
    )
    assert len(block.strip().splitlines()) == 3
    capture = write_demo_capture(tmp_path / "capture", views=8, width=48, height=40)
    short = 'fit(scene, "train.iterations=2", "train.refine_until=1", "train.device=cpu", '
    block = block.replace('"demo/capture"', repr(str(capture))).replace("fit(scene, ", short)
    names = {"turbogs_plugin": turbogs_plugin}
    exec(block, names)
    assert names["image"].shape == (40, 48, 3) and bool(torch.isfinite(names["image"]).all())
    assert float(names["image"].std()) > 0.01
