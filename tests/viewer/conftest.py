"""A training of a few iterations, and what a viewer shows of it."""

import copy

import pytest
from helpers.framework_runs import tiny_capture, tiny_config

from turbogs_plugin.captures import load_scene
from turbogs_plugin.plan import make_plan
from turbogs_plugin.train.run import new_loop
from turbogs_plugin.viewer.subject import CaptureViews, Subject


@pytest.fixture(scope="session")
def capture(tmp_path_factory):
    """The folder of a capture: 7 training views and a test view of 48x40 pixels."""
    return tiny_capture(tmp_path_factory.mktemp("viewer"))


@pytest.fixture(scope="session")
def scene(capture):
    return load_scene(capture)


@pytest.fixture(scope="session")
def new_training(capture, scene):
    """Makes a training of the tiny configuration, with these changes, that has not begun."""

    def new_training(*overrides: str):
        config = tiny_config(capture, *overrides)
        device = scene.train.cameras.viewmats.device
        return new_loop(make_plan(config, scene, device).apply(config), scene, device)[0]

    return new_training


@pytest.fixture(scope="session")
def untouched(new_training, scene):
    """Not to be changed: `subject` is a copy."""
    trainer = new_training().trainer
    trainer.initialise_maps()
    views = CaptureViews(trainer.views, scene.test)
    return Subject(trainer.gaussians, trainer.sh_degree, capture=views, maps=trainer.maps, step=trainer.now)


@pytest.fixture
def subject(untouched):
    """A model after its maps were made, with its capture."""
    return copy.deepcopy(untouched)
