"""Opens the wheel that `make wheel` built, and says what is wrong with it: check_wheel.py WHEEL 80 90 ...

It must hold machine code for each architecture named and PTX of the newest, use of torch only C functions (the stable
ABI), suit every Python from 3.10, and contain no file that is neither ours nor metadata. Exit code 1 if not.
"""

from __future__ import annotations

import re
import struct
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

LIBRARY = "turbogs_plugin/_C.abi3.so"
LARGEST = 20 << 20
"""Bytes of a wheel; it has about 11 MB."""

CODE_MAGIC = 0xBA55ED50
"""First word of a container of GPU code, in the order of the machine's bytes."""
PTX, MACHINE_CODE = 1, 2
"""Kinds of entries in a container."""


def architectures(library: bytes) -> set[str]:
    """What a library really holds: ``sm_90`` for machine code, ``compute_90`` for PTX.

    A container has a header (magic, version, its own size, bytes of entries) and entries, whose headers begin with
    kind, version, header size and payload size, and have the architecture's number at byte 28.
    """
    found = set()
    for container in re.finditer(re.escape(struct.pack("<I", CODE_MAGIC)), library):
        start = container.start()
        _, version, header, size = struct.unpack_from("<IHHQ", library, start)
        if version != 1 or header != 16:  # these four bytes by chance
            continue
        place, end = start + header, start + header + size
        while place < end:
            kind, _, header, size = struct.unpack_from("<HHIQ", library, place)
            (number,) = struct.unpack_from("<I", library, place + 28)
            if kind in (PTX, MACHINE_CODE):
                found.add(f"{'compute' if kind == PTX else 'sm'}_{number}")
            place += header + size
    return found


def wanted_architectures(numbers: list[str]) -> list[str]:
    """In the order in which setup.py records them."""
    numbers = sorted(numbers, key=int)
    return [*(f"sm_{number}" for number in numbers), f"compute_{numbers[-1]}"]


def foreign_symbols(symbols: list[str]) -> list[str]:
    """Undefined symbols that are C++ of torch, or Python's: they tie a library to one version."""
    return [name for name in symbols if re.search(r"(?<![\w:])(at|c10|caffe2|torch|pybind11)::|^_?Py[A-Z_]", name)]


def undefined_symbols(library: Path) -> list[str]:
    """Names that other libraries must provide, as in C++ sources."""
    listed = subprocess.run(["nm", "-D", "-C", "--undefined-only", library], capture_output=True, text=True, check=True)
    return [re.sub(r"^\s*\w\s+", "", line) for line in listed.stdout.splitlines()]


def stray_files(names: list[str]) -> list[str]:
    """Files of a wheel that are neither modules, configurations, the mark of types, the library nor metadata."""
    modules = r"[\w/]+\.py|configs/[\w/-]+\.yaml|py\.typed"
    ours = re.compile(rf"turbogs_plugin/({modules})|{re.escape(LIBRARY)}")
    return [name for name in names if not (ours.fullmatch(name) or name.split("/")[0].endswith(".dist-info"))]


def faults(wheel: Path, numbers: list[str]) -> list[str]:
    """What is wrong with a wheel, a line each."""
    found = []
    if not re.fullmatch(r"turbogs_plugin-[\w.]+-cp310-abi3-(many)?linux\w+\.whl", wheel.name):
        found.append(f"{wheel.name}: its tag is not cp310-abi3-linux")
    if wheel.stat().st_size > LARGEST:
        found.append(f"{wheel.stat().st_size >> 20} MB: more than {LARGEST >> 20}")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        found += [f"{name}: a stray file" for name in stray_files(names)]
        if LIBRARY not in names:
            return [*found, f"{LIBRARY} is not in it"]
        with tempfile.TemporaryDirectory() as folder:
            library = Path(archive.extract(LIBRARY, folder))
            symbols, content = undefined_symbols(library), library.read_bytes()
    wanted, inside = wanted_architectures(numbers), architectures(content)
    if inside != set(wanted):
        found.append(f"it holds {', '.join(sorted(inside))}, not {', '.join(wanted)}")
    if " ".join(wanted).encode() + b"\0" not in content:
        found.append(f"it does not say of itself that it holds {', '.join(wanted)}")
    if not any(name.startswith("aoti_torch_") for name in symbols):
        found.append("it uses nothing of torch's stable ABI")
    return found + [f"{name}: C++ of torch, or Python" for name in foreign_symbols(symbols)]


def main() -> int:
    wheel, numbers = Path(sys.argv[1]), sys.argv[2:]
    found = faults(wheel, numbers)
    for line in found:
        print(f"{wheel.name}: {line}", file=sys.stderr)
    if not found:
        print(f"{wheel}: {wheel.stat().st_size / 1e6:.1f} MB, {', '.join(wanted_architectures(numbers))}")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
