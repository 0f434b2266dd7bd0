"""The page with a model to turn: one file, and in a real browser without a network it shows the model."""

import io
import re
import shutil

import numpy as np
import pytest
import torch
from PIL import Image

from turbogs_plugin.engine.reference.spherical_harmonics import evaluate, unit_directions
from turbogs_plugin.export.html_page import html_page, page_gaussians
from turbogs_plugin.types import SH_C0

pytest.importorskip("viser")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
ARGUMENTS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage")
PATIENCE = 90_000


def test_each_gaussian_has_the_mean_of_the_colours_that_cameras_see(model, scene):
    gaussians, cameras = model.gaussians.map(torch.clone), scene.train.cameras
    gaussians.shN[:] = 0.5 * torch.randn(gaussians.shN.shape, generator=torch.Generator().manual_seed(0))
    found = page_gaussians(gaussians, cameras, gaussians.sh_degree)
    assert found.sh_degree == 0 and found.means.equal(gaussians.means)
    directions = unit_directions(gaussians.means[:1] - cameras.centers)  # [V, 3], of the first Gaussian
    seen = evaluate(gaussians.sh0[:1], gaussians.shN[:1], directions, gaussians.sh_degree)
    wanted = (seen + 0.5).clamp(0, 1).mean(dim=0)
    torch.testing.assert_close(SH_C0 * found.sh0[0, 0] + 0.5, wanted, atol=1e-5, rtol=0)


def test_an_export_is_one_file_that_says_what_it_costs(turbogs, finished, tmp_path):
    file = tmp_path / "m.html"
    code, out, err = turbogs("export", finished, "--format", "html", "--max-gaussians", "60", "--out", file)
    assert code == 0 and "60 of" in out and "dB on 1 of 1 test views" in out, err
    text = file.read_text(encoding="utf-8")
    assert "60 Gaussians, one colour each: PSNR" in text and "<title>capture</title>" in text
    assert not re.search(r"""<(script|link|img)[^>]*\s(src|href)=["'](?!data:)""", text)
    assert [path.name for path in tmp_path.iterdir()] == ["m.html"]


@pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium")
def test_a_browser_shows_the_model_and_turns_it(model, scene, tmp_path):
    playwright = pytest.importorskip("playwright.sync_api")
    cameras = scene.train.cameras
    found = page_gaussians(model.gaussians, cameras, 0)
    file = tmp_path / "a.html"
    file.write_text(html_page(found, cameras, (0.2, 0.4, 1.0), "a <model>", "caption"), encoding="utf-8")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=list(ARGUMENTS))
        tab = browser.new_page(viewport={"width": 240, "height": 200})
        asked = []
        tab.on("request", lambda request: asked.append(request.url))
        tab.goto(f"{file.as_uri()}?fixedDpr=1")
        tab.wait_for_selector("canvas", timeout=PATIENCE)
        assert tab.title() == "a <model>"
        tab.add_style_tag(content=".mantine-Notifications-root { display: none }")

        def comes(condition) -> np.ndarray:
            for _ in range(100):
                picture = tab.locator("canvas").first.screenshot(timeout=PATIENCE)
                if condition(image := np.asarray(Image.open(io.BytesIO(picture)).convert("RGB")).astype(int)):
                    return image
                tab.wait_for_timeout(200)
            pytest.fail("the model was not shown")

        def on_the_background(image: np.ndarray) -> bool:
            return (np.abs(image - (51, 102, 255)).max(axis=2) <= 3).any() and image[60:140, 80:160].std() > 10

        first = comes(on_the_background)
        tab.mouse.move(120, 100)
        tab.mouse.down()
        tab.mouse.move(190, 100, steps=5)
        tab.mouse.up()
        comes(lambda image: np.abs(image - first).mean() > 5)
        browser.close()
    assert [url for url in asked if not url.startswith(("file:", "data:", "blob:"))] == []
