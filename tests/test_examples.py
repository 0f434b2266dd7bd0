"""Every example runs, on the demo capture made small; the third-party package plugs in by its entry points.

The scripts take a GPU where there is one, and so do these tests.
"""

import importlib.util
import json
import math
import re
import shutil
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.framework_runs import thin_out_points
from helpers.projects import project_of
from PIL import Image

from turbogs_plugin.captures import load_scene, write_demo_capture
from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.train import run
from turbogs_plugin.train.history import read_history
from turbogs_plugin.types import PixelSamples

EXAMPLES = Path(__file__).parents[1] / "examples"
PACKAGE = EXAMPLES / "third_party_strategy"
SCRIPTS = ("density_swap", "optimizer_swap", "sparse_pixels", "all_swaps")


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    return write_demo_capture(tmp_path_factory.mktemp("examples") / "demo", views=5, width=32, height=24)


@pytest.fixture(scope="module")
def thin_capture(capture, tmp_path_factory) -> Path:
    """The capture with an eighth of the points."""
    return thin_out_points(Path(shutil.copytree(capture, tmp_path_factory.mktemp("thin") / "demo")), 8)


@pytest.fixture
def example(monkeypatch):
    """Imports an example by name as running it would, and forgets it afterwards."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    known = set(sys.modules)
    yield lambda name: importlib.import_module(name)
    for name in set(sys.modules) - known:
        if getattr(sys.modules[name], "__file__", None) and str(EXAMPLES) in sys.modules[name].__file__:
            del sys.modules[name]


@pytest.mark.parametrize("name", SCRIPTS)
def test_swaps(name, example, capture, capsys):
    options = example("gsplat_host").Options(str(capture), iterations=6, refine_start_iter=2, refine_every=4)
    example(name).main(options)
    reports = [line for line in capsys.readouterr().out.splitlines() if "dB on the test views" in line]
    assert len(reports) == {"density_swap": 2, "optimizer_swap": 3}.get(name, 1)
    for line in reports:
        first, last = (float(text) for text in line.split(": ")[1].split(" dB")[0].split(" -> "))
        assert last > first, line


def test_the_loop_without_a_trainer_is_the_page_s_and_learns(example, capture):
    loop, page = example("plain_loop"), (EXAMPLES.parent / "docs" / "drop-in.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^```python\n(samples = sampler.*?density.apply.*?)^```$", page, re.DOTALL | re.MULTILINE)
    assert textwrap.indent(block, " " * 8) in (EXAMPLES / "plain_loop.py").read_text(encoding="utf-8")
    torch.manual_seed(0)
    assert loop.main(str(capture), iterations=40) > loop.main(str(capture), iterations=8) + 1


def test_pixels_on_an_mlp(example, tmp_path, capsys):
    """Both variants learn, at equal pixels, and the figure is drawn; a photo from a file is taken."""
    script = example("pixels_on_an_mlp")
    figure, photo = tmp_path / "made" / "figure.png", tmp_path / "photo.png"
    Image.fromarray((255 * script.synthetic_photo(48, 32)).byte().numpy()).save(photo)
    printed, results = [], tmp_path / "results.json"
    for iterations in (1, 60):
        gain = script.main(str(photo), iterations, rate=0.2, seeds=(0,), figure=str(figure), results=str(results))
        lines = capsys.readouterr().out.splitlines()
        values = [float(text) for text in re.findall(r": ([\d.]+) dB", lines[0])]
        assert len(values) == 2 and f"gain: {gain:+.2f} dB" in lines[1]
        assert gain == pytest.approx(values[1] - values[0], abs=0.011)
        printed.append(values)
    assert all(after > before + 3 for before, after in zip(*printed, strict=True))
    with Image.open(figure) as drawn:
        assert drawn.size == (3 * 2 * 48, 2 * 2 * 32 + script.BAR)
    script.record(results, "another", [[20.0, 21.0], [22.0, 24.0]])
    first, second = json.loads(results.read_text()).items()
    assert first[0].endswith("/photo.png") and [len(column) for column in first[1]["psnr"].values()] == [1, 1]
    psnr = dict(zip(first[1]["psnr"], [[20.0, 22.0], [21.0, 24.0]], strict=True))
    assert second[0] == "another" and second[1]["psnr"] == psnr and second[1]["provenance"]["machine"]


@pytest.mark.usefixtures("plotted")
def test_baselines(example, thin_capture, tmp_path, capsys):
    example("baselines").main(scene=str(thin_capture), output=str(tmp_path / "runs"), iterations=44)
    lines = capsys.readouterr().out.splitlines()
    said = {line.split(":")[0] for line in lines if " dB, " in line}
    gpu = torch.cuda.is_available()
    assert said == {"turbogs", "3dgs", "3dgs-as-shipped", *(["mcmc"] if gpu else [])}
    assert ("mcmc: left out, needs a GPU" in lines) != gpu
    for name in said:  # short as they are, the runs have events of density control
        history = read_history(tmp_path / "runs" / name / "history.jsonl")
        assert history[-1].num_gaussians > history[0].num_gaussians, name


@pytest.fixture
def third_party(tmp_path, monkeypatch):
    """The package as if it were installed: its folder and the metadata that its pyproject.toml stands for."""
    project = project_of(PACKAGE)
    metadata = tmp_path / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    metadata.mkdir()
    named = f"Name: {project['name']}\nVersion: {project['version']}\n"
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\n{named}")
    lines = []
    for group, points in project["entry-points"].items():
        lines += [f"[{group}]", *(f"{name} = {value}" for name, value in points.items())]
    (metadata / "entry_points.txt").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(str(PACKAGE))
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    for name in [name for name in sys.modules if name.startswith("patchwork_strategies")]:
        del sys.modules[name]


def test_third_party_strategies_are_named_in_a_yaml(third_party, thin_capture, tmp_path):
    overrides = ["train.iterations=5", "train.device=cpu", "density.every=2", "density.least_opacity=0.1"]
    config = load_config(str(PACKAGE / "patchwork.yaml"), overrides)
    config.scene.path = str(thin_capture)
    assert type(config.build("pixel_sampler")).__name__ == "CheckerboardPixelSampler"
    history = run.train(config, tmp_path / "run").history
    assert history[-1].psnr > history[0].psnr
    assert history[-1].num_gaussians < history[0].num_gaussians


def test_colmap_undistorts_to_the_capture_that_loading_makes(example, tmp_path):
    """A capture with random points alone keeps them, too."""
    folder = tmp_path / "raw"
    (folder / "images").mkdir(parents=True)
    y, x = np.mgrid[:120, :160]
    photo = np.stack([127 + 100 * np.sin(0.1 * x), 127 + 100 * np.cos(0.13 * y), 0.5 * (x + y)], axis=2).astype("uint8")
    frames = []
    for view in range(4):
        Image.fromarray(photo).save(folder / f"images/{view}.png")
        turn, pose = 0.3 * view, np.eye(4)
        pose[:3, :3] = [[math.cos(turn), 0, math.sin(turn)], [0, 1, 0], [-math.sin(turn), 0, math.cos(turn)]]
        pose[:3, 3] = [view, 0.1 * view, 0.0]
        frames.append({"file_path": f"images/{view}.png", "transform_matrix": pose.tolist()})
    frames.append({"file_path": "images/never_published.png"})
    lens = {"w": 160, "h": 120, "fl_x": 140.0, "fl_y": 142.0, "cx": 83.0, "cy": 58.0}
    bent = {"k1": 0.06, "k2": -0.08, "p1": -0.001, "p2": 0.0002}
    (folder / "transforms.json").write_text(json.dumps({**lens, **bent, "frames": frames}))
    example("undistort_with_colmap").main(folder, tmp_path / "plain")
    loaded, plain = load_scene(folder), load_scene(tmp_path / "plain")
    assert plain.train.names == loaded.train.names and plain.test.names == loaded.test.names
    assert torch.allclose(plain.train.cameras.viewmats, loaded.train.cameras.viewmats, atol=1e-5)
    assert torch.allclose(plain.points, loaded.points, atol=1e-5)
    Ks, sizes = ([getattr(scene.train.cameras, name)[0] for scene in (loaded, plain)] for name in ("Ks", "sizes"))
    torch.testing.assert_close(Ks[0].diagonal(), Ks[1].diagonal(), rtol=5e-3, atol=0)
    assert np.abs(sizes[0] / sizes[1] - 1.0).max() < 0.02
    # Where both cameras look straight ahead, both photos show the same.
    shown = []
    for scene, K in zip((loaded, plain), Ks, strict=True):
        x, y = K[:2, 2].int().tolist()
        shown.append(scene.train.photos.image(0)[y - 20 : y + 20, x - 20 : x + 20])
    assert float((shown[0] - shown[1]).abs().mean()) < 0.02


def test_many_photos_are_a_capture_that_trains(example, tmp_path):
    example("many_photos").write_flight(tmp_path / "flight", 60, 48, 32)
    scene = load_scene(tmp_path / "flight")
    assert (len(scene.train), len(scene.test)) == (52, 8) and len(scene.points) > 300
    axes = scene.train.cameras.viewmats[:, 0, 0]  # to and fro
    assert (axes > 0.5).sum() > 15 and (axes < -0.5).sum() > 15
    config = load_config("turbogs", ["train.device=cpu", "train.iterations=1", "train.sh_degree=0"])
    config.scene.path = str(tmp_path / "flight")
    assert run.train(config, tmp_path / "run").history[-1].iteration == 1


def test_the_parts_that_the_page_prints_train(capture, tmp_path, monkeypatch):
    """README's lines run, and docs/python.md's parts, as objects and by name; the loss's gradient is its value's."""
    readme, page = ((EXAMPLES.parent / name).read_text(encoding="utf-8") for name in ("README.md", "docs/python.md"))
    (lines,) = re.findall(r"^```python\n(.*?)^```$", readme, re.DOTALL | re.MULTILINE)
    first, code, second = re.findall(r"^```python\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    (settings,) = re.findall(r"^```yaml\n([^`]*my_parts:Huber.*?)^```$", page, re.DOTALL | re.MULTILINE)
    (tmp_path / "my_parts.py").write_text(code)
    (tmp_path / "my.yaml").write_text(settings)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    names: dict = {}
    for block in (lines.replace('config="demo"', 'config="demo", iterations=2'), first, second):
        exec(block.replace("demo/capture", str(capture)).replace("iterations=200", "iterations=4"), names)
        assert names["image"].shape == (24, 32, 3) and names["image"].std() > 0.01
    assert (tmp_path / "model.ply").is_file() and names["result"].history[-1].iteration == 4
    config = load_config("my.yaml", ["train.iterations=6", "train.device=cpu", f"scene.path={capture}"])
    assert run.train(config, tmp_path / "run").history[-1].psnr > 10
    colors, targets = torch.rand(2, 9, 3, dtype=torch.float64)
    colors.requires_grad_()
    samples = PixelSamples.from_mask(torch.ones(3, 3, dtype=torch.bool))
    output = config.build("loss")(colors, targets, samples)
    (expected,) = torch.autograd.grad(output.loss, colors)
    torch.testing.assert_close(output.color_gradients.detach(), expected)
