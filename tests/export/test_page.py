"""The page: one file, small enough, and in a real browser without a network it shows what our renderer draws."""

import base64
import copy
import io
import re
import shutil
from dataclasses import replace
from html import escape
from importlib.resources import files

import numpy as np
import pytest
import torch
from PIL import Image

from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.engine.rendering import render_image
from turbogs_plugin.export import page
from turbogs_plugin.export.page import write_page
from turbogs_plugin.types import Cameras

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
ARGUMENTS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage")
PATIENCE = 90_000


@pytest.fixture(scope="module")
def written(finished, scene, tmp_path_factory):
    from turbogs_plugin.train.saved_model import load_model

    file = tmp_path_factory.mktemp("page") / "report.html"
    model = load_model(finished, torch.device("cpu"))
    return file, write_page(model, model.gaussians, scene, file), model


def test_the_page_is_one_file_that_asks_for_nothing(written):
    file, made, model = written
    text = file.read_text(encoding="utf-8")
    assert [path.name for path in file.parent.iterdir()] == ["report.html"]
    assert file.stat().st_size < 32_000_000 and made[0] == len(model.gaussians)
    assert not re.search(r"""(src|href)=["'](?!data:)""", text) and "default-src 'none'" in text
    assert str(file.parents[1]) not in text and f"path: {model.config.scene.path.rpartition('/')[2]}\n" in text
    assert escape(made[1].text()) in text and abs(made[1].before - made[1].after) < 0.1


def test_the_page_has_the_background_and_says_whose_colours_it_shows(written, scene, tmp_path):
    _, _, model = written
    config = copy.deepcopy(model.config)
    config.train.background = "#3366ff"
    exposures = torch.eye(3, 4).repeat(len(scene.train), 1, 1)
    write_page(replace(model, config=config, exposures=exposures), model.gaussians, scene, tmp_path / "a.html")
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert "background: rgb(51, 102, 255)" in text and "in the model&#x27;s own colours" in text
    assert "background: rgb(0, 0, 0)" in written[0].read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("path", "init", "weights", "shown"),
    [
        ("/home/me", "/home/me/runs/a.ply", "/home/me/vgg.pth", ("me", "a.ply", "vgg.pth")),
        (f"/home/{'secret client ' * 12}/fox", "points", None, ("fox", "points", None)),  # YAML folds such a line
        ("/", "random", None, ("", "random", None)),
    ],
)
def test_of_paths_the_page_hands_over_the_last_part_alone(path, init, weights, shown):
    config = load_config()
    config.scene.path, config.train.init, config.report.lpips_weights = path, init, weights
    text = page._settings(config)
    expected = load_config()
    expected.scene.path, expected.train.init, expected.report.lpips_weights = shown
    assert text == expected.to_yaml().rstrip() and config.scene.path == path


@pytest.mark.parametrize("script", ["viewer.js", "page.js"])
def test_scripts_of_the_page_do_not_end_their_own_element(script):
    """They stand in the page as they are, where a browser looks for the element's end in texts and comments, too."""
    assert "</script" not in (files("turbogs_plugin.export") / "web" / script).read_text(encoding="utf-8").lower()


def test_a_model_that_is_too_large_is_pruned_and_the_page_says_so(written, scene, tmp_path, monkeypatch):
    file, (count, _), model = written
    monkeypatch.setattr(page, "LARGEST_PAGE", file.stat().st_size - 15_000)
    fewer, change = write_page(model, model.gaussians, scene, tmp_path / "a.html")
    assert (tmp_path / "a.html").stat().st_size < file.stat().st_size - 15_000 and fewer < count
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert f"{fewer} of {count} Gaussians" in text and escape(change.text()) in text


def test_a_run_stopped_between_evaluations_is_not_summed_up_by_an_older_one(written, scene, tmp_path):
    _, _, model = written
    for iteration, said in ((model.iteration, "<td>14</td>"), (11, f"{len(model.gaussians)} Gaussians after 11 iter")):
        file = tmp_path / f"{iteration}.html"
        write_page(replace(model, iteration=iteration), model.gaussians, scene, file)
        summary = file.read_text(encoding="utf-8").partition("<h2>The model</h2>")[0].partition("<h1>")[2]
        assert said in summary and ("<table" in summary) == (iteration == model.iteration)


@pytest.fixture(scope="module")
def tab(written):
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("there is no chromium")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=list(ARGUMENTS))
        tab = browser.new_context(viewport={"width": 900, "height": 700}, offline=True).new_page()
        tab.goto(written[0].as_uri())
        tab.wait_for_selector("#model-status", state="detached", timeout=PATIENCE)
        tab.add_style_tag(content=".stage { width: 480px !important; height: 400px !important }")
        tab.wait_for_selector("#model-cameras[width='480'][height='400']", timeout=PATIENCE)
        yield tab
        browser.close()


def drawn(tab) -> np.ndarray:
    """[H, W, 3] of the canvas, after the next frame."""
    frames = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
    tab.evaluate(frames)
    url = tab.evaluate("document.getElementById('model-canvas').toDataURL()")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(url.split(",")[1]))).convert("RGB"), dtype=np.float64)


def test_the_viewer_draws_what_our_renderer_draws(tab, written, scene):
    model = written[2]
    for number, (views, view) in {0: (scene.train, 0), 4: (scene.train, 4), 7: (scene.test, 0)}.items():
        tab.select_option("#model-choice", str(number))
        shown = drawn(tab)
        Ks = views.cameras.Ks.clone()
        Ks[:, :2] *= 10
        enlarged = Cameras(views.cameras.viewmats, Ks, views.cameras.sizes * 10)
        options = {"sh_degree": model.sh_degree, "settings": model.config.raster}
        expected = 255 * render_image(model.gaussians, enlarged, view, **options).colors.clamp(0, 1).numpy()
        assert expected.std() > 20 and np.abs(shown - expected).max() <= 3.0


def test_the_model_turns_and_its_cameras_are_clicked(tab):
    tab.select_option("#model-choice", "0")
    before = drawn(tab)
    box = tab.locator("#model-canvas").bounding_box()
    x, y = box["x"] + 240, box["y"] + 200
    tab.mouse.move(x, y)
    for by in (100, -100):  # not pressed yet: the page scrolls
        scrolled = (
            "new Promise(done => { addEventListener('scrollend', done, { once: true }); setTimeout(done, 5000); })"
        )
        tab.evaluate(f"window.scrolled = {scrolled}; 0")
        tab.mouse.wheel(0, by)
        tab.evaluate("window.scrolled.then(() => 0)")
        assert (drawn(tab) == before).all() and tab.evaluate("scrollY > 0") == (by > 0)
    tab.mouse.down()
    tab.mouse.move(x + 60, y + 20, steps=3)
    tab.mouse.up()
    turned = drawn(tab)
    assert np.abs(turned - before).mean() > 2 and turned.std() > 10
    tab.mouse.wheel(0, -200)
    assert np.abs(drawn(tab) - turned).mean() > 0.5
    tab.check("#model-show")
    tab.click("[data-look]")
    assert tab.input_value("#model-choice") == "7" and np.abs(drawn(tab) - turned).mean() > 0.5


def test_the_slider_goes_from_photo_over_render_to_error(tab):
    seen = {}
    for value in ("0", "1", "2"):
        tab.locator(".view input").first.fill(value)
        shot = tab.locator(".view .pictures").first.screenshot()
        seen[tab.inner_text(".view .named")] = np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"), dtype=float)
    assert list(seen) == ["photo", "render", "error"]
    for one, other in (("photo", "render"), ("render", "error"), ("photo", "error")):
        assert np.abs(seen[one] - seen[other]).mean() > 3
