"""The page in a real browser: frames arrive as they were drawn, and pictures switch."""

import io
import shutil
import time
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from turbogs_plugin.viewer.camera import ViewerCamera
from turbogs_plugin.viewer.pictures import Picture, draw
from turbogs_plugin.viewer.server import Page

pytest.importorskip("viser")
playwright = pytest.importorskip("playwright.sync_api")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
if CHROMIUM is None:
    pytest.skip("there is no chromium", allow_module_level=True)

ARGUMENTS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage")
PATIENCE = 90.0


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=list(ARGUMENTS))
        yield browser
        browser.close()


class Tab:
    """The page in a tab of a browser."""

    def __init__(self, browser, page: Page) -> None:
        self.tab = browser.new_page(viewport={"width": 700, "height": 240})
        # A fixed ratio: in a slow browser the page would lower its resolution.
        self.tab.goto(f"{page.url}/?fixedDpr=1")
        # Neither a note nor the panel's shadow lies on the picture.
        self.tab.add_style_tag(
            content=".mantine-Notifications-root { display: none } * { box-shadow: none !important }"
        )
        self.tab.wait_for_selector("canvas", timeout=1000 * PATIENCE)

    def canvas(self) -> np.ndarray:
        """[H, W, 3] uint8: what is seen."""
        shot = self.tab.locator("canvas").first.screenshot()
        return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"))

    def comes_to_show(self, expected) -> np.ndarray:
        """Wait until the canvas shows a picture within 2 grey levels; `expected` gives it for (width, height)."""
        ends, worst = time.monotonic() + PATIENCE, 255
        while time.monotonic() < ends:
            seen = self.canvas()
            wanted = expected(seen.shape[1], seen.shape[0])
            worst = min(worst, int(np.abs(seen.astype(int) - wanted).max()))
            if worst <= 2:
                return seen
            self.tab.wait_for_timeout(100)
        pytest.fail(f"the canvas differs from the picture by {worst} grey levels and more")

    def choose(self, picture: Picture) -> None:
        self.tab.get_by_label("Picture").first.click()
        self.tab.get_by_role("option", name=picture.value, exact=True).click()

    def press(self, name: str) -> None:
        self.tab.get_by_role("button", name=name, exact=True).click()


def test_frames_arrive_as_they_were_drawn_and_pictures_switch(browser, shown, state):
    with shown(state) as page:
        tab = Tab(browser, page)

        def seen_from(view: int):
            camera = ViewerCamera.of_view(state.capture.train.cameras, view)
            return lambda width, height: draw(state, Picture.RENDER, replace(camera, width=width, height=height))[0]

        renders = [tab.comes_to_show(seen_from(0))]
        page._slider.value = 6
        tab.press("Stand at this view")
        renders.append(tab.comes_to_show(seen_from(6)))
        assert all(image.std() > 5 for image in renders)
        for picture in (Picture.COMPARE, Picture.RENDER):
            tab.choose(picture)
            # A colour of a scale may jump with the last digit of a pose: so by the pose that the browser told.
            tab.comes_to_show(lambda *size, picture=picture: draw(state, picture, page.frames.camera, 6)[0])
