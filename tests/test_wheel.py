"""`.ci/check_wheel.py` finds what is wrong with a wheel."""

import importlib.util
import re
import struct
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
ARCHITECTURES = re.search(r"^WHEEL_ARCHITECTURES := (.*)$", MAKEFILE, re.M)[1].split()
NAME = "turbogs_plugin-0.1.0-cp310-abi3-linux_x86_64.whl"
SYMBOLS = ["aoti_torch_get_dim", "torch_list_size", "std::locale::locale()", "free", "std::at_quick_exit"]


@pytest.fixture
def checker(monkeypatch):
    spec = importlib.util.spec_from_file_location("check_wheel", ROOT / ".ci" / "check_wheel.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "undefined_symbols", lambda library: SYMBOLS)
    return module


def container(*entries: tuple[int, int]) -> bytes:
    """GPU code as nvcc embeds it: entries of (kind, architecture), each with some payload."""
    body = b""
    for kind, number in entries:
        payload = bytes(24)
        body += struct.pack("<HHIQ", kind, 0x101, 64, len(payload)) + bytes(12) + struct.pack("<I", number)
        body += bytes(64 - 32) + payload
    return struct.pack("<IHHQ", 0xBA55ED50, 1, 16, len(body)) + body


def library(numbers: list[str]) -> bytes:
    """Two containers, as two sources give, among other bytes; and the record."""
    machine = [container(*((2, int(number)) for number in numbers)) for _ in range(2)]
    record = " ".join([*(f"sm_{number}" for number in numbers), f"compute_{numbers[-1]}"])
    chance = struct.pack("<I", 0xBA55ED50) + bytes(60)  # the first word of a container, and none
    return b"\x7fELF" + machine[0] + chance + machine[1] + container((1, int(numbers[-1]))) + record.encode() + b"\0"


def wheel(folder: Path, content: bytes, name: str = NAME, stray: str | None = None) -> Path:
    with zipfile.ZipFile(folder / name, "w") as archive:
        files = [f"turbogs_plugin/{name}" for name in ("cli.py", "configs/ablations/parts.yaml", "py.typed")]
        for file in (*files, "turbogs_plugin-0.1.0.dist-info/WHEEL", *([stray] if stray else [])):
            archive.writestr(file, "")
        archive.writestr("turbogs_plugin/_C.abi3.so", content)
    return folder / name


def test_a_wheel_as_make_wheel_builds_it_has_no_fault(checker, tmp_path):
    assert ARCHITECTURES == ["80", "86", "89", "90", "100", "120"]
    assert checker.faults(wheel(tmp_path, library(ARCHITECTURES)), ARCHITECTURES) == []


@pytest.mark.parametrize(
    ("content", "options", "words"),
    [
        (library(["80", "90"]), {}, "it holds compute_90, sm_80, sm_90, not sm_80, sm_86, "),
        (library(ARCHITECTURES).replace(b"sm_89 ", b""), {}, "it does not say of itself that it holds sm_80"),
        (library(ARCHITECTURES), {"name": NAME.replace("abi3", "cp310")}, "its tag is not cp310-abi3"),
        (library(ARCHITECTURES), {"stray": "strategies/losses.py"}, "strategies/losses.py: a stray file"),
        (library(ARCHITECTURES), {"stray": "turbogs_plugin/_C.cpython-311.so"}, "_C.cpython-311.so: a stray file"),
    ],
)
def test_a_fault_of_a_wheel_is_named(checker, tmp_path, content, options, words):
    assert words in checker.faults(wheel(tmp_path, content, **options), ARCHITECTURES)[0]


TIES = ("at::Tensor::dim() const", "c10::Error::what() const", "std::vector<at::Tensor>::~vector()", "PyList_New")


@pytest.mark.parametrize("symbol", TIES)
def test_what_ties_a_library_to_a_version_is_named(checker, tmp_path, monkeypatch, symbol):
    monkeypatch.setattr(checker, "undefined_symbols", lambda library: [*SYMBOLS, symbol])
    (fault,) = checker.faults(wheel(tmp_path, library(ARCHITECTURES)), ARCHITECTURES)
    assert fault.startswith(symbol)
