"""A training of a few iterations, and what a viewer shows of it."""

import copy
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager

import pytest
from helpers.framework_runs import tiny_config

from turbogs_plugin.engine.render_pass import DEFAULT_SETTINGS
from turbogs_plugin.plan import make_plan
from turbogs_plugin.train.look import Look
from turbogs_plugin.train.run import new_loop
from turbogs_plugin.viewer.pictures import CaptureViews, ModelState


@pytest.fixture(scope="module")
def new_training(capture, scene):
    """Makes a training of the tiny configuration, with these changes, that has not begun."""

    def new_training(*overrides: str):
        config = tiny_config(capture, *overrides)
        device = scene.train.cameras.viewmats.device
        return new_loop(make_plan(config, scene, device).apply(config), scene, device)

    return new_training


@pytest.fixture(scope="module")
def unwatched(new_training):
    """The state at the end of a training that nobody watched. Not to be changed."""
    alone = new_training()
    alone.run()
    return alone.trainer.state_dict()


@pytest.fixture(scope="module")
def untouched(new_training, scene):
    trainer = new_training().trainer
    trainer.initialise_maps()
    look, views = Look(trainer.sh_degree, DEFAULT_SETTINGS), CaptureViews(trainer.views, scene.test)
    return ModelState(trainer.gaussians, look, capture=views, maps=(trainer.maps, trainer.now))


@pytest.fixture
def state(untouched):
    """A model after its maps were made, with its capture."""
    return copy.deepcopy(untouched)


@pytest.fixture
def shown():
    """Shows a model on a page, from a thread of its own, while entered."""
    pytest.importorskip("viser")
    from turbogs_plugin.viewer.server import Page
    from turbogs_plugin.viewer.show import server_of

    @contextmanager
    def shown(state: ModelState):
        over = threading.Event()

        def serve(draw_due) -> None:
            while not over.is_set():
                if not draw_due():
                    over.wait(0.02)

        with closing(Page("127.0.0.1", 0)) as page, ThreadPoolExecutor(1) as pool:
            pool.submit(serve, server_of(state, "a model", page))
            try:
                yield page
            finally:
                over.set()

    return shown
