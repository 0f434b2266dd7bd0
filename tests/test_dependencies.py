"""What an installation needs: the core leaves other trainers' packages alone, the commands say what they lack."""

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.projects import project_of
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from turbogs_plugin import commands
from turbogs_plugin.cli import main
from turbogs_plugin.doctor import COMMAND_PACKAGES, INSTALL_COMMANDS

ROOT = Path(__file__).resolve().parent.parent

BLOCKED = """
import sys

ABSENT = set({absent})

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ABSENT:
            raise ModuleNotFoundError(f"No module named '{{name}}'", name=name)

sys.meta_path.insert(0, Absent())
"""
"""Python in which modules are absent."""

USE = """
import torch
import turbogs_plugin.strategies as strategies
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.gsplat_bridge import SharedOptimizer, TurboDensityStrategy, gather_pixels
from turbogs_plugin.types import Step

for name in strategies.__all__:
    getattr(strategies, name)

torch.manual_seed(0)
photos = torch.rand(2, 32, 32, 3)
step = Step(0, 100, 50)
maps = ErrorMaps.from_images(photos.sum(-1))
samples = strategies.ErrorGuidedPixelSampler().sample(maps, (0, 1), 0.25, step)
targets = gather_pixels(photos, samples)
loss = strategies.CharbonnierNccLoss()(torch.full_like(targets, 0.5), targets, samples)
assert 0 < float(loss.loss) < 10 and loss.color_gradients.shape == targets.shape
maps.update(samples, loss.pixel_errors, step)

count = 8
splats = {"means": torch.rand(count, 3), "scales": torch.full((count, 3), -5.0), "quats": torch.rand(count, 4)}
splats |= {"opacities": torch.zeros(count), "sh0": torch.rand(count, 1, 3), "shN": torch.zeros(count, 3, 3)}
splats = {name: torch.nn.Parameter(value) for name, value in splats.items()}
group = SharedOptimizer(strategies.SparseAdam())
optimizers = {name: group([{"params": value, "lr": 0.01, "name": name}]) for name, value in splats.items()}
strategy = TurboDensityStrategy(refine_start_iter=0, refine_every=1, opacity_decay=0.0, verbose=False)
strategy.check_sanity(splats, optimizers)
state = strategy.initialize_state(scene_scale=1.0)
means2d = torch.zeros(1, count, 2, requires_grad=True)
info = {"means2d": means2d, "width": 32, "height": 32, "n_cameras": 1, "gaussian_ids": None}
info["radii"] = torch.ones(1, count, 2, dtype=torch.int32)
strategy.step_pre_backward(splats, optimizers, state, 1, info)
means2d.sum().backward()
means2d.absgrad = means2d.grad.abs()
strategy.step_post_backward(splats, optimizers, state, 1, info)
assert len(splats["means"]) > count, len(splats["means"])
print("used")
"""


@pytest.fixture(scope="module")
def project() -> dict:
    return project_of(ROOT)


def requirements(lines: list[str]) -> dict[str, Requirement]:
    return {canonicalize_name(found.name): found for found in map(Requirement, lines)}


def test_parts_need_the_core_alone(said):
    assert said[1] == "used"


def test_the_bridge_imports_little_and_starts_nothing():
    """Configurations and trainer, which take time to import, come with the first use of TurboStep."""
    code = """
import sys, threading, gsplat, torch, turbogs_plugin.gsplat_bridge

heavy = {"yaml", "PIL", "turbogs_plugin.config", "turbogs_plugin.train"} & {*sys.modules}
assert not heavy and threading.active_count() == 1 and not torch.cuda.is_initialized(), heavy
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=300)


def test_the_extra_is_what_the_commands_name(project):
    extras = project["optional-dependencies"]
    assert sorted(extras["train"]) == sorted(COMMAND_PACKAGES.values())
    assert extras["dev"][0] == f"{project['name']}[train]"
    assert sorted(shlex.split(INSTALL_COMMANDS)) == sorted(["pip", "install", *extras["train"]])
    assert set(requirements(project["dependencies"])) == {"torch", "gsplat", "packaging", "numpy", "pillow", "pyyaml"}


COMMANDS = {
    "train": "SCENE --out RUN",
    "reconstruct": "PHOTOS --out SCENE",
    **dict.fromkeys(("view", "eval", "render", "export"), "RUN"),
    "plan": "SCENE",
    "report": "STUDY",
    "demo": "CAPTURE",
    "ablate": "components --scene SCENE --out STUDY",
    "bench": "step --scene SCENE --ply MODEL train.device=cpu",
}
ALL_COMMANDS = """
import contextlib, io, json
from turbogs_plugin.cli import main

answers = {{}}
for line in {lines}:
    sys.argv = ["turbogs", *line]
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main()
        except SystemExit as end:
            answers[line[0]] = [end.code, out.getvalue(), err.getvalue()]
print(json.dumps(answers))
"""


@pytest.fixture(scope="module")
def said(tmp_path_factory) -> list[str]:
    """What a process without the extra prints: the commands' answers as JSON, what the use of the parts ends with, and
    the commands' answers with the parser, by which each comes to the first package that it lacks itself."""
    lines = [["doctor"], *([command, *arguments.split()] for command, arguments in COMMANDS.items())]
    code, folder = ALL_COMMANDS.format(lines=lines), tmp_path_factory.mktemp("lacking")
    script = "\n".join([BLOCKED.format(absent=sorted(COMMAND_PACKAGES)), code, USE, "ABSENT.discard('tyro')", code])
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "TURBOGS_LIBRARY": str(folder / "no kernels")}
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, env=environment, timeout=300)
    assert done.returncode == 0 and list(folder.iterdir()) == [], done.stderr
    return [line for line in done.stdout.splitlines() if line == "used" or line.startswith("{")]


@pytest.mark.parametrize("parser", [False, True])
def test_each_command_says_what_it_lacks(parser, said):
    names = [Requirement(text).name for module, text in COMMAND_PACKAGES.items() if not parser or module != "tyro"]
    answers = json.loads(said[2 if parser else 0])
    assert answers.pop("doctor")[0] == 0
    assert set(answers) == set(COMMANDS) == set(commands.COMMANDS) - {"doctor"}
    for code, out, error in answers.values():
        assert (code, out, error.count("\n")) == (2, "", 1)
        needs = f"turbogs: error: turbogs needs {', '.join(names)}: {INSTALL_COMMANDS} ("
        assert error.startswith(needs) or (parser and "no such" in error)


def test_doctor_needs_none_of_them_and_names_them(said, turbogs):
    code, text, _ = json.loads(said[0])["doctor"]
    (line,) = [line for line in text.splitlines() if INSTALL_COMMANDS in line]
    assert code == 0 and line.startswith("missing") and "tyro" in line and "pycolmap" in line
    code, text, _ = turbogs("doctor")
    assert code == 0 and INSTALL_COMMANDS not in text


def test_a_package_of_the_same_name_is_not_taken_for_it(tmp_path, monkeypatch, capsys):
    """The pycolmap that gsplat 1.5.3's examples install is another one: it has no Reconstruction."""
    (tmp_path / "pycolmap").mkdir()
    (tmp_path / "pycolmap" / "__init__.py").write_text("class SceneManager: pass\n")
    metadata = tmp_path / "pycolmap-0.0.1.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: pycolmap\nVersion: 0.0.1\n")
    monkeypatch.setitem(sys.modules, "pycolmap", None)  # so that what the command imports does not stay afterwards
    monkeypatch.delitem(sys.modules, "pycolmap")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "argv", ["turbogs", "demo", str(tmp_path / "capture")])
    with pytest.raises(SystemExit) as end:
        main()
    said = f"turbogs: error: turbogs needs pycolmap>=4.0 (0.0.1 is installed): {INSTALL_COMMANDS} ("
    assert end.value.code == 2 and capsys.readouterr().err.startswith(said)
    assert not (tmp_path / "capture").exists()


HOSTS = {
    # examples/requirements.txt of gsplat's main branch at 90d7b4b, which calls itself 1.6.0: numpy>=2.0,<3.0
    "gsplat main": ("gsplat 1.6.0", "torch 2.9.1", "numpy 2.0.0"),
    # the same commit's setup.py: torch>=2.7
    "gsplat main, oldest torch": ("gsplat 1.6.0", "torch 2.7.0"),
    # examples/requirements.txt of gsplat v1.5.3: numpy<2.0.0, and rmbrualla's pycolmap at cc7ea4b, called 0.0.1
    "gsplat 1.5.3": ("gsplat 1.5.3", "numpy 1.26.4", "pycolmap 0.0.1"),
    # nerfstudio 1.1.5's metadata on PyPI: gsplat==1.4.0, Pillow>=10.3.0, packaging; its guide installs torch 2.1.2
    "nerfstudio 1.1.5": ("gsplat 1.4.0", "torch 2.1.2", "numpy 1.26.4", "pillow 10.3.0"),
}
"""Versions that the environments of other trainers hold, each with the place that pins it."""


@pytest.mark.parametrize("host", HOSTS)
def test_the_core_changes_no_package_of_a_host(host, project):
    core = requirements(project["dependencies"])
    for name, version in (text.split() for text in HOSTS[host]):
        assert name not in core or core[name].specifier.contains(version), f"{core[name]} replaces {name} {version}"
        assert name not in core or core[name].marker is None


def test_an_extra_is_the_one_that_its_message_names(project):
    from turbogs_plugin.export import renders
    from turbogs_plugin.viewer import server

    extras = {"viewer": ("viser", server), "video": ("imageio-ffmpeg", renders)}
    for extra, (package, module) in extras.items():
        assert set(requirements(project["optional-dependencies"][extra])) == {package}
        assert shlex.split(module.INSTALL) == ["pip", "install", *project["optional-dependencies"][extra]]
