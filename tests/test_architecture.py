"""docs/architecture.md names every folder, imports point the way it says, and packages have what they export."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import turbogs_plugin
from turbogs_plugin import strategies
from turbogs_plugin.strategies.protocols import Strategies

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "architecture.md"


def test_the_architecture_names_every_folder():
    packages = (path.parent for path in (ROOT / "turbogs_plugin").glob("*/__init__.py"))
    folders = {package.name for package in packages if not package.is_symlink()}
    text = PAGE.read_text(encoding="utf-8")
    assert [folder for folder in sorted(folders) if f"`turbogs_plugin/{folder}/`" not in text] == []


def imported_rooms(file: Path) -> set[str]:
    """The parts of `turbogs_plugin` that a file imports, at its top or later."""
    modules = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import | ast.ImportFrom):
            within = f"{node.module}." if isinstance(node, ast.ImportFrom) else ""
            modules |= {within + alias.name for alias in node.names}
    split = (module.split(".") for module in modules)
    return {parts[1] for parts in split if parts[0] == "turbogs_plugin"}


def test_imports_point_one_way():
    (sentence,) = re.findall(r"Imports point one way, [^:]*: ([^.]*)\.", PAGE.read_text(encoding="utf-8"))
    rooms = re.findall(r"`(\w+)`", sentence)
    folders = {room: ROOT / "turbogs_plugin" / room for room in rooms} | {"strategies": ROOT / "strategies"}
    paths = [path for path in (ROOT / "turbogs_plugin").iterdir() if not path.is_symlink()]
    there = {path.stem for path in paths if path.suffix in ("", ".py")}
    assert there - set(rooms) - {"__pycache__"} == {"__init__", "__main__"}
    wrong = [
        (str(file.relative_to(ROOT)), room)
        for place, own in enumerate(rooms)
        for file in sorted([*folders[own].rglob("*.py"), folders[own].with_suffix(".py")])
        if file.is_file()
        for room in imported_rooms(file) & set(rooms[place + 1 :])
    ]
    assert wrong == []


def test_every_built_in_strategy_is_exported():
    built_in = {place.partition(":")[2] for types in strategies.TYPES.values() for place in types.values()}
    assert built_in | {*strategies.PROTOCOLS.values()} <= set(strategies.__all__)
    of_fit = {kind: protocol.__forward_arg__ for kind, protocol in Strategies.__annotations__.items()}
    assert of_fit == strategies.PROTOCOLS


def test_what_type_checkers_see_of_a_package_is_what_it_has():
    for package in (turbogs_plugin, strategies):
        block = Path(package.__file__).read_text(encoding="utf-8").split("if TYPE_CHECKING", 1)[1].split("\n\n", 1)[0]
        names = {name for name in re.findall(r"\b[A-Za-z_]\w*\b", re.sub(r"(?m)^.*?\bimport\b|#.*|\w+ as ", "", block))}
        assert {name for name in names if name != "from"} == set(package.__all__) & set(dir(package)) - {"__version__"}
