"""Makes the C++ headers of what Python and the kernels share. setup.py calls it; nothing that it writes is committed.

- ``layout.h``: the sizes and layouts of turbogs_plugin/engine/layout.py.
- ``launches.h``: the fields of each launch, from turbogs_plugin/engine/cuda/launches, in the order in which Python
  sends them, and the declaration of its function ``run``, which csrc/bindings defines.
"""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parent.parent
LAYOUT = ROOT / "turbogs_plugin/engine/layout.py"
LAUNCHES = ROOT / "turbogs_plugin/engine/cuda/launches/__init__.py"
SAMPLES = ROOT / "turbogs_plugin/types/samples.py"
"""The file of TILE_SIZE, which imports torch: it is read, not run."""


def load(path: Path) -> ModuleType:
    """A module of one file, or a package, without the packages around it, which would import torch."""
    folders, name = (None, path.stem) if path.stem != "__init__" else ([str(path.parent)], path.parent.name)
    spec = importlib.util.spec_from_file_location(f"turbogs_build_{name}", path, submodule_search_locations=folders)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def camel_case(name: str) -> str:
    return "".join(part.capitalize() for part in name.split("_"))


def layout_header(layout: ModuleType) -> str:
    """Numbers, enumerations, and a struct of the first columns of each row."""
    tile_size = re.search(r"^TILE_SIZE = (\d+)", SAMPLES.read_text(), re.MULTILINE)
    lines = [f"constexpr int kTileSize = {tile_size[1]};"]
    for name, value in vars(layout).items():
        if isinstance(value, int):
            lines.append(f"constexpr int k{camel_case(name)} = {value};")
        elif isinstance(value, tuple):
            entries = ", ".join(f"k{camel_case(entry)}" for entry in value)
            lines.append(f"enum class {camel_case(name)[:-1]} : int {{ {entries} }};")
        elif isinstance(value, type):
            places = {column: place.start for column, place in layout.columns(value).items()}
            lines.append(f"struct {name} {{")
            for column, place in {**places, "size": value.SIZE}.items():
                lines.append(f"    static constexpr int k{camel_case(column)} = {place};")
            lines.append("};")
    return _header(LAYOUT, lines)


def launches_header(layout: ModuleType, launches: ModuleType) -> str:
    """A struct for each launch, whose enumerations are the places of its fields in the lists that Python sends."""
    lines = []
    for cls in launches.LAUNCHES:
        lines += [f"struct {cls.__name__} {{", f'    static constexpr const char* kName = "{cls.operator}";']
        for kind, paths in zip(("Tensors", "Integers", "Reals"), cls.paths, strict=False):
            names = [path.split(".")[-1] for path in paths]
            lines.append(f"    enum class {kind} {{ {', '.join(names)} }};".replace("{  }", "{}"))
            lines.append(f"    static constexpr size_t kNum{kind} = {len(names)};")
            if kind == "Tensors":
                quoted = ", ".join(f'"{name}"' for name in names)
                lines.append(f"    static constexpr const char* kTensorNames[] = {{{quoted}}};")
        lines += [f"    static void run(const Arguments<{cls.__name__}>& in);  // in csrc/bindings", "};"]
    lines += ["", "template <class...>", "struct List {};"]
    lines.append(f"using All = List<{', '.join(cls.__name__ for cls in launches.LAUNCHES)}>;")
    lines += ["", f'constexpr const char* kInterface = R"interface({layout.interface(launches.LAUNCHES)})interface";']
    start = ["template <class>", "class Arguments;", "", "namespace launches {", ""]
    return _header(LAUNCHES, [*start, *lines, "", "}  // namespace launches"])


def _header(source: Path, lines: list[str]) -> str:
    made = f"// Made by csrc/generate_headers.py of {source.relative_to(ROOT)}."
    start = [made, "#pragma once", "", "#include <cstddef>", "", "namespace turbogs {", ""]
    return "\n".join([*start, *lines, "", "}  // namespace turbogs", ""])


def write(folder: Path) -> None:
    """Write the headers; one that is as it should be is left alone, so that nothing is compiled again."""
    layout, launches = load(LAYOUT), load(LAUNCHES)
    texts = {"layout.h": layout_header(layout), "launches.h": launches_header(layout, launches)}
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        path = folder / name
        if not path.is_file() or path.read_text() != text:
            path.write_text(text)
