"""What is installed: every module, the YAML files, and nothing under a name that is not ours."""

import ast
import importlib
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import turbogs_plugin

ROOT = Path(__file__).resolve().parent.parent
TOP_LEVEL = {"pyproject.toml", "turbogs_plugin", "strategies", "csrc", "configs", "tests", "examples"}
TOP_LEVEL |= {"README.md", "LICENSE", "CHANGELOG.md", "Makefile", "MANIFEST.in", "setup.py", "docs"}


def modules() -> list[str]:
    folders = {"turbogs_plugin": "turbogs_plugin", "strategies": "turbogs_plugin.strategies"}
    names = []
    for folder, package in folders.items():
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            names.append(".".join([package, *parts]).removesuffix(".__init__"))
    return names


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> list[str]:
    """Names in a wheel built from what git tracks or would track."""
    source = tmp_path_factory.mktemp("source") / "turbogs"
    kept = ("build", "demo", "runs", "*.egg-info", "__pycache__", "*.so", ".*")
    shutil.copytree(ROOT, source, ignore=shutil.ignore_patterns(*kept))
    target = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", target, source],
        check=True,
        capture_output=True,
        env={**os.environ, "TURBOGS_CUDA": "off"},
    )
    with zipfile.ZipFile(next(target.glob("*.whl"))) as archive:
        return archive.namelist()


def test_the_wheel_holds_every_module_and_configuration(wheel):
    for name in modules():
        path = name.replace(".", "/")
        assert f"{path}.py" in wheel or f"{path}/__init__.py" in wheel, name
    for path in sorted((ROOT / "configs").rglob("*.yaml")):
        assert f"turbogs_plugin/configs/{path.relative_to(ROOT / 'configs').as_posix()}" in wheel


def test_the_wheel_installs_nothing_but_turbogs_plugin(wheel):
    tops = {name.split("/")[0] for name in wheel}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"turbogs_plugin"}


@pytest.mark.parametrize("name", modules())
def test_every_module_and_public_name_imports(name):
    module = importlib.import_module(name)
    tree = ast.parse(Path(module.__file__).read_text())
    defined = [node.name for node in tree.body if isinstance(node, ast.ClassDef | ast.FunctionDef)]
    for public in [*defined, *getattr(module, "__all__", [])]:
        assert hasattr(module, public)


def test_strategies_are_one_set_of_classes_under_one_name():
    from turbogs_plugin.strategies.loss import CharbonnierLoss

    assert CharbonnierLoss.__module__ == "turbogs_plugin.strategies.loss"
    found = subprocess.run(
        [sys.executable, "-c", "import importlib.util; print(importlib.util.find_spec('strategies'))"],
        cwd="/",
        capture_output=True,
        text=True,
        check=True,
    )
    assert found.stdout.strip() == "None"


def test_the_top_level_is_what_was_agreed():
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if tracked.returncode:
        pytest.skip("not a git checkout")
    tops = {line.split("/")[0] for line in tracked.stdout.splitlines()}
    assert {top for top in tops if not top.startswith(".")} <= TOP_LEVEL


def test_the_version_is_in_one_place():
    assert turbogs_plugin.__version__
    assert 'dynamic = ["version"]' in (ROOT / "pyproject.toml").read_text()


def test_importing_the_command_line_does_not_import_torch():
    code = "import sys, turbogs_plugin.cli; print('torch' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"
