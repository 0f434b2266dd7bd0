"""What is installed: every module, the YAML files, and nothing under a name that is not ours."""

import ast
import importlib
import importlib.util
import os
import shutil
import subprocess
import sys
import zipfile
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
import setuptools

from turbogs_plugin import doctor
from turbogs_plugin.engine.cuda import library as kernels

ROOT = Path(__file__).resolve().parent.parent


def modules() -> list[str]:
    folders = {"turbogs_plugin": "turbogs_plugin", "strategies": "turbogs_plugin.strategies"}
    names = []
    for folder, package in folders.items():
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            names.append(".".join([package, *parts]).removesuffix(".__init__"))
    return names


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    """What git tracks or would track."""
    kept = ("build", "demo", "runs", "*.egg-info", "__pycache__", "*.so", ".*")
    folder = tmp_path_factory.mktemp("source") / "turbogs"
    return Path(shutil.copytree(ROOT, folder, ignore=shutil.ignore_patterns(*kept)))


def built(source: Path, target: Path, *command: str | Path) -> zipfile.ZipFile:
    """The wheel that a command of Python writes to a folder."""
    options = {"cwd": source, "env": os.environ | {"TURBOGS_CUDA": "off"}, "timeout": 300}
    subprocess.run([sys.executable, *command], check=True, capture_output=True, **options)
    return zipfile.ZipFile(next(target.glob("*.whl")))


@pytest.fixture(scope="module")
def wheel(source, tmp_path_factory) -> list[str]:
    """Names in a wheel."""
    target = tmp_path_factory.mktemp("wheel")
    command = ("-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", target, ".")
    with built(source, target, *command) as archive:
        return archive.namelist()


def test_type_checkers_see_an_editable_install(source, tmp_path):
    """They follow a path in a .pth, and no hook of Python's import."""
    code = f"from setuptools.build_meta import build_editable; build_editable({str(tmp_path)!r})"
    with built(source, tmp_path, "-c", code) as archive:
        (links,) = (name for name in archive.namelist() if name.endswith(".pth"))
        assert archive.read(links).decode().splitlines() == [str(source)]
    assert (source / "turbogs_plugin/py.typed").is_file()


def test_the_wheel_holds_every_module_and_configuration_and_nothing_else(wheel):
    assert {top for name in wheel if not (top := name.split("/")[0]).endswith(".dist-info")} == {"turbogs_plugin"}
    for name in modules():
        path = name.replace(".", "/")
        assert f"{path}.py" in wheel or f"{path}/__init__.py" in wheel, name
    for path in sorted((ROOT / "configs").rglob("*.yaml")):
        assert f"turbogs_plugin/configs/{path.relative_to(ROOT / 'configs').as_posix()}" in wheel


def test_every_module_imports_and_has_what_it_offers():
    for name in modules():
        module = importlib.import_module(name)
        for public in getattr(module, "__all__", ()):
            assert getattr(module, public, None) is not None, f"{name} offers {public} and does not have it"


def imported(path: Path, names: set[str]) -> set[str]:
    """Modules among ``names`` that a module imports when it is imported itself, or for its types. The types of a
    package's ``__init__`` are of names that it hands on (`lazy_face`), and uses nowhere."""
    found, left = set(), list(ast.parse(path.read_text(encoding="utf-8")).body)
    if path.name == "__init__.py":
        left = [node for node in left if not (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test))]
    while left:
        node = left.pop()
        if isinstance(node, ast.ImportFrom) and node.module:
            paths = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {path if path in names else node.module for path in paths}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif not isinstance(node, ast.FunctionDef | ast.ClassDef):
            left += ast.iter_child_nodes(node)  # `if TYPE_CHECKING` among them
    return found & names


def test_no_module_imports_one_that_imports_it():
    """Not for types either: what cannot be imported alone cannot be understood alone."""
    names = set(modules())
    sources = {name: Path(importlib.util.find_spec(name).origin) for name in names}
    graph = {name: imported(path, names) for name, path in sources.items()}
    assert sum(map(len, graph.values())) > 2 * len(graph)  # or the imports were not understood
    TopologicalSorter(graph).prepare()


@pytest.fixture
def build_script(monkeypatch):
    """setup.py as a module that builds nothing."""
    monkeypatch.setattr(setuptools, "setup", lambda **arguments: None)
    spec = importlib.util.spec_from_file_location("build_script", ROOT / "setup.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "build_script", module)
    spec.loader.exec_module(module)
    return module


def test_architectures_are_those_of_the_gpus_that_have_kernels(build_script, monkeypatch):
    monkeypatch.delenv("TURBOGS_CUDA_ARCH", raising=False)
    answers = iter(["9.0\n7.5\n12.0\n8.0\n9.0\n", "7.5\n7.0\n"])  # of nvidia-smi
    run = lambda command, **options: subprocess.CompletedProcess(command, 0, stdout=next(answers))  # noqa: E731
    monkeypatch.setattr(build_script.subprocess, "run", run)
    assert build_script.find_architectures() == ["80", "90", "120"]
    with pytest.raises(build_script.CannotBuildError, match=r"capability 8\.0 or newer, the GPU has 7\.5"):
        build_script.find_architectures()


@pytest.mark.parametrize(
    ("named", "wanted"),
    [
        *[("90", ["90"]), ("9.0;8.0", ["80", "90"]), ("100f,90a", ["90a", "100f"]), ("75", None), ("90;7.5", None)],
        *[("compute_80", ["compute_80"]), ("compute_8.0,90", ["compute_80", "90"]), ("compute_75", None)],
    ],
)
def test_named_architectures(build_script, monkeypatch, named, wanted):
    monkeypatch.setenv("TURBOGS_CUDA_ARCH", named)
    if wanted:
        assert build_script.find_architectures() == wanted
    else:
        with pytest.raises(SystemExit, match=r"needs compute capability 8\.0"):
            build_script.find_architectures()


def test_ptx_is_of_the_newest_of_several(build_script):
    several = build_script.Toolchain(Path("nvcc"), Path("torch"), ["80", "90"])
    assert several.code_names == ["sm_80", "sm_90", "compute_90"]
    assert several.code_flags[-1] == "-gencode=arch=compute_90,code=compute_90"
    assert build_script.Toolchain(Path("nvcc"), Path("torch"), ["90"]).code_names == ["sm_90"]
    named = build_script.Toolchain(Path("nvcc"), Path("torch"), ["compute_80", "90"])
    assert named.code_names == ["compute_80", "sm_90"]
    assert named.code_flags[0] == "-gencode=arch=compute_80,code=compute_80"


@pytest.mark.parametrize(("version", "usable"), [("2.9.1+cu128", False), ("2.10.0", True), ("3.0.0", True)])
def test_a_torch_without_the_stable_interface_is_named(build_script, monkeypatch, tmp_path, version, usable):
    (tmp_path / "torch/include/torch").mkdir(parents=True)
    (tmp_path / "torch/version.py").write_text(f"__version__ = '{version}'\ndebug = False\n")
    monkeypatch.setattr(build_script, "find_spec", lambda name: None)
    monkeypatch.setattr(build_script.sysconfig, "get_path", lambda key: str(tmp_path))
    if usable:
        assert build_script.find_torch() == tmp_path / "torch"
    else:
        with pytest.raises(build_script.CannotBuildError, match=r"needs torch 2\.10 or later, this is 2\.9\.1\+cu128"):
            build_script.find_torch()


@pytest.mark.parametrize("mode", ["auto", "require"])
def test_a_compiler_that_fails_ends_without_a_library(tmp_path, mode):
    """`auto` goes on without one, `require` fails; both say why in one line."""
    nvcc = tmp_path / "toolkit/bin/nvcc"
    nvcc.parent.mkdir(parents=True)
    nvcc.write_text("#!/bin/sh\necho 'a note' >&2\necho 'x.h(3): fatal error: too new' >&2\nexit 2\n")
    nvcc.chmod(0o755)
    stale = tmp_path / "lib/turbogs_plugin/_C.abi3.so"
    stale.parent.mkdir(parents=True)
    stale.touch()
    command = [sys.executable, "setup.py", "build_ext", "-b", tmp_path / "lib", "-t", tmp_path / "objects"]
    environment = os.environ | {"TURBOGS_CUDA": mode, "TURBOGS_CUDA_ARCH": "90", "CUDA_HOME": str(tmp_path / "toolkit")}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=environment, timeout=120)
    said = [line for line in (done.stdout + done.stderr).splitlines() if line.startswith("turbogs: ")]
    assert "Traceback" not in done.stderr and not stale.exists()
    assert (done.returncode == 0) == (mode == "auto"), done.stderr
    assert len(said) == 1 and "no CUDA library: nvcc failed on " in said[0]
    assert said[0].endswith(": x.h(3): fatal error: too new")
    assert said[0].startswith("turbogs: CPU only" if mode == "auto" else "turbogs: TURBOGS_CUDA=require, but")


@pytest.mark.parametrize(
    ("architectures", "capability", "usable"),
    [
        ("sm_90", (9, 0), True),
        ("sm_90", (10, 0), False),
        ("sm_80", (8, 6), True),
        ("sm_86", (8, 0), False),
        ("sm_80 sm_90 compute_90", (12, 0), True),
        ("sm_86 sm_90 compute_90", (8, 0), False),
        ("sm_100a", (10, 3), False),
        ("sm_100a", (10, 0), True),
        ("sm_80 sm_90a compute_90a", (12, 0), False),
    ],
)
def test_a_library_has_code_for_a_gpu_or_says_how_to_build_it(architectures, capability, usable):
    reason = kernels._mismatch(tuple(architectures.split()), capability)
    present = "sm_{}{}".format(*capability)
    remedy = f"this GPU is {present}: rebuild with TURBOGS_CUDA_ARCH={present.removeprefix('sm_')}"
    assert reason == ("" if usable else f"built for {', '.join(architectures.split())}, {remedy}")


@pytest.fixture
def another_library(monkeypatch, tmp_path):
    """A place for a library, looked at as if nothing had been loaded before."""

    def forget() -> None:
        kernels._load_failure.cache_clear()
        kernels.unavailable_reason.cache_clear()

    monkeypatch.setenv(kernels.LIBRARY_VARIABLE, str(tmp_path / "other.so"))
    forget()
    yield tmp_path / "other.so"
    forget()


@pytest.mark.parametrize(("content", "words"), [(None, "other.so is not built"), ("text", "other.so does not load: ")])
def test_a_library_that_cannot_be_used_is_said_by_all_who_need_it(another_library, content, words):
    if content is not None:
        another_library.write_text(content)
    reason = kernels.unavailable_reason()
    assert reason.startswith(words) and "\n" not in reason
    assert kernels.architectures() == ()
    lines = doctor.diagnosis().splitlines()
    assert f"{'kernels':<16}not usable" in lines and f"{'missing':<16}kernels: {reason}" in lines
