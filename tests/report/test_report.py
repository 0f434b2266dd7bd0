"""Pictures, plots, tables, provenance and the page."""

import math
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
import torch
from helpers.framework_runs import tiny_capture, tiny_config
from PIL import Image

from turbogs_plugin.report import evaluation, images, provenance
from turbogs_plugin.report.curves import plot_against_seconds
from turbogs_plugin.report.images import (
    ERROR_FULL_SCALE,
    GAP,
    TITLE,
    depth_picture,
    error_picture,
    save_image,
    strip,
    titled,
)
from turbogs_plugin.report.run_report import write_report
from turbogs_plugin.report.tables import number, table
from turbogs_plugin.train import run


def test_bytecode_that_is_missing_is_named_with_its_remedy(tmp_path, monkeypatch):
    place = tmp_path / "torch.pyc"
    monkeypatch.setattr(provenance.importlib.util, "cache_from_source", lambda _: str(place))
    assert f"-m compileall -q -j 0 {Path(torch.__file__).parents[1]}" in provenance.missing_bytecode()
    place.touch()
    assert provenance.missing_bytecode() == ""


def test_a_strip_is_photo_render_and_error():
    photo, image = torch.zeros(5, 7, 3), torch.zeros(5, 7, 3)
    image[2, 3] = 1.0
    made = strip(photo, image)
    assert made.shape == (5, 3 * 7 + 2 * GAP, 3) and (made[:, 7 : 7 + GAP] == 255).all()
    assert made[2, 3].tolist() == [0, 0, 0] and made[2, 7 + GAP + 3].tolist() == [255, 255, 255]
    assert made[2, 2 * (7 + GAP) + 3].sum() > 500 > made[0, 2 * (7 + GAP)].sum()


def test_a_strip_says_what_its_pictures_are():
    made = titled(white := np.full((5, 3 * 200 + 2 * GAP, 3), 255, np.uint8))
    assert made.shape == (TITLE + 5, *white.shape[1:]) and (made[TITLE:] == 255).all()
    assert all((made[:TITLE, left : left + 60] < 128).any() for left in (0, 200 + GAP, 2 * (200 + GAP)))
    scale = made[TITLE // 2, 2 * (200 + GAP) + 60 :][:48].astype(int)
    assert (np.diff(scale.sum(axis=1)) >= 0).all() and scale[0].max() < 16 and scale[-1].min() > 150


def test_errors_have_the_colours_of_matplotlib():
    errors = torch.linspace(0.0, 1.0, 1001)[None]
    picture = error_picture(errors[..., None].expand(-1, -1, 3) * ERROR_FULL_SCALE, torch.zeros(1, 1001, 3)).numpy()
    off = np.abs(picture - (matplotlib.colormaps["inferno"](errors.numpy())[..., :3] * 255.0).round()).max(axis=-1)
    assert (off > 0).mean() < 0.01 and off.max() <= 6  # but for the rounding of the scale


def test_pictures_are_written_in_the_format_of_their_suffix(tmp_path, monkeypatch):
    pixels = np.linspace(0, 255, 24 * 40 * 3).astype(np.uint8).reshape(24, 40, 3)
    for name in ("a.png", "b.jpg"):
        save_image(tmp_path / name, pixels)
    assert (np.asarray(Image.open(tmp_path / "a.png")) == pixels).all()
    assert np.abs(np.asarray(Image.open(tmp_path / "b.jpg")).astype(int) - pixels).mean() < 2.0
    monkeypatch.setattr(images, "new_file", lambda path: open("/dev/full", "wb", 0))  # noqa: SIM115
    with pytest.raises(OSError) as failed:
        save_image(tmp_path / "full.png", np.repeat(pixels, 20, 0))
    assert failed.value.filename == str(tmp_path / "full.png"), "which a write does not know"


@pytest.mark.parametrize("count", [1, 12])
def test_plots_of_any_length(tmp_path, count):
    values = [20.0 + i for i in range(count)]
    plot_against_seconds(tmp_path / "p.png", list(range(count)), values, "test PSNR in dB", "shop_$5_$9")
    assert min(Image.open(tmp_path / "p.png").size) > 400


def test_the_commit_of_the_sources(tmp_path, monkeypatch):
    monkeypatch.delenv(provenance.COMMIT_VARIABLE, raising=False)
    monkeypatch.setattr(provenance, "__file__", str(tmp_path / "turbogs_plugin" / "report" / "provenance.py"))
    assert provenance.source_commit() == "", "sources without a history"

    def git(*arguments: str) -> str:
        who = ["-c", "user.name=a", "-c", "user.email=a@b"]
        return subprocess.run(["git", "-C", tmp_path, *who, *arguments], capture_output=True, text=True).stdout.strip()

    source = tmp_path / "source.py"
    source.write_text("1")
    for arguments in (["init"], ["add", "."], ["commit", "-m", "first"], ["tag", "-a", "v1", "-m", "a tag"]):
        git(*arguments)
    commit = git("rev-parse", "--short=12", "HEAD")
    (tmp_path / "results.json").write_text("no source")
    assert len(commit) == 12 and provenance.source_commit() == commit
    source.write_text("2")
    assert provenance.source_commit() == commit + provenance.MODIFIED
    monkeypatch.setenv(provenance.COMMIT_VARIABLE, "named")
    assert provenance.source_commit() == "named"
    assert re.fullmatch(r"20\d\d-[01]\d-[0-3]\d", provenance.provenance("cpu").day)


def test_tables():
    assert table(("a", "b"), [(1, 2)]).splitlines() == ["| a | b |", "| --- | --- |", "| 1 | 2 |"]
    name = "<img src=x onerror=alert(1)>![x](javascript:alert(4)) `c` left|right.png"
    shown = r"\<img src=x onerror=alert(1)>!\[x\](javascript:alert(4)) \`c\` left\|right.png"
    assert table(("a",), [(name,)]).splitlines()[-1] == f"| {shown} |"
    assert number(1.23456, 2) == "1.23" and number(math.nan, 2) == "not computed"


@pytest.mark.parametrize("strips", [0, 1])
def test_no_more_strips_than_the_bound(tmp_path, monkeypatch, strips):
    monkeypatch.setattr("turbogs_plugin.report.run_report.STRIPS", strips)
    config = tiny_config(tiny_capture(tmp_path), "train.iterations=1", "scene.test_every=4")
    monkeypatch.setattr("turbogs_plugin.report.run_report.doubted", lambda errors: errors == errors.max())
    folder = run.train(config, tmp_path / "run", write_report).folder
    page, pictures = folder.report.read_text(), sorted(path.name for path in (folder.path / "report").glob("*.jpg"))
    assert len(list((folder.path / "report").glob("test-*.jpg"))) == strips == len(pictures) - strips
    assert f"{strips} of 2 are shown" in page
    assert ("## Doubted photos" in page) == bool(strips) and all(f"(report/{name})" in page for name in pictures)


def test_a_depth_picture_is_bright_where_near_and_black_where_nothing_is():
    depths = np.array([[1.0, 2.0, 5.0, 100.0, 0.0]], dtype=np.float32).repeat(30, axis=0)
    brightness = depth_picture(depths).sum(axis=2)[0].tolist()
    assert brightness[:4] == sorted(brightness[:4], reverse=True) and len(set(brightness)) == 5
    assert brightness[3] > 0 == brightness[4]
    assert not depth_picture(np.zeros((2, 3), dtype=np.float32)).any()
    assert depth_picture(np.full((2, 3), 4.0, dtype=np.float32)).any()  # one depth everywhere


def test_lpips_takes_the_weights_of_torchs_cache_and_says_what_is_missing(tmp_path, monkeypatch):
    class Network(torch.nn.Module):
        def __init__(self, **_) -> None:
            super().__init__()

        def forward(self, image: torch.Tensor, photo: torch.Tensor) -> torch.Tensor:
            assert image.shape == photo.shape == (1, 3, 4, 5)
            return (image - photo).abs().mean()

    module = SimpleNamespace(LearnedPerceptualImagePatchSimilarity=Network)
    monkeypatch.setitem(sys.modules, "torchmetrics.image.lpip", module)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr(evaluation, "LPIPS_PACKAGES", ("torch", "no_such_package"))
    _, reason = evaluation.load_lpips(torch.device("cpu"))
    assert reason.startswith("it needs no_such_package: pip install no_such_package torch==")
    monkeypatch.setattr(evaluation, "LPIPS_PACKAGES", ())
    function, reason = evaluation.load_lpips(torch.device("cpu"))
    assert function is None and "vgg16-397923af.pth" in reason and str(tmp_path) not in reason
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints/vgg16-397923af.pth").touch()
    function, reason = evaluation.load_lpips(torch.device("cpu"))
    assert function(torch.ones(4, 5, 3), torch.zeros(4, 5, 3)) == 1.0 and reason == ""
