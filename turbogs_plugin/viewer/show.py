"""The viewer of a finished model: a run's newest one or a file's, as `turbogs view` shows it."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import torch

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.model.similarity import Similarity, placed
from turbogs_plugin.scene import Frame, Scene
from turbogs_plugin.train.checkpoint import latest_checkpoint, load_checkpoint
from turbogs_plugin.train.inputs import resolve_device
from turbogs_plugin.train.saved_model import SavedModel, load_with_capture, read_given
from turbogs_plugin.types import Gaussians, Step
from turbogs_plugin.viewer.camera import ViewerCamera
from turbogs_plugin.viewer.frames import Frames
from turbogs_plugin.viewer.live import described
from turbogs_plugin.viewer.model_state import CaptureViews, ModelState
from turbogs_plugin.viewer.server import Page, plain, require_server, serve_until_interrupted

MOST = 0.9
"""Share of a model's Gaussians, those nearest to its middle, that is seen at first where there is no capture."""
FIRST_DISTANCE = 2.5
"""Distance of the first camera from a model without a capture, most of which lies within 1 of its middle."""


def view(path: Path, port: int, host: str, device_name: str, given: Config | None = None) -> None:
    """Show a run's newest model, or one from a file, until Ctrl-C.

    Args:
        path: folder of a run, or the file of a model.
        port, host: where to listen.
        device_name: where to render.
        given: the capture of a model from a file, and how to render it; None: a run knows its own, and a file is shown
            without one.

    Raises:
        InputError: no model there, viser is not installed, or the port is not free.
    """
    require_server(host, port)
    state, lacking = open_state(path, resolve_device(device_name), given)
    with closing(Page(host, port)) as page:
        if lacking:
            print(f"turbogs: shown without its capture: {lacking}", file=sys.stderr)
        serve_until_interrupted(page, server_of(state, path.name, page))


def server_of(state: ModelState, title: str, page: Page) -> Callable[[], bool]:
    """A function that draws a frame of a model if one is due, and says whether it did."""
    frames = Frames(page.screens, page.wish)
    line = f"**{plain(title)}** · {len(state.gaussians):,} Gaussians"
    if state.capture is not None:
        page.show_capture(state.capture)
    else:  # which way is up is not known: y is taken as down, as most reconstructions have it
        page.server.scene.set_up_direction("-y")
        front = (0.0, 0.0, -FIRST_DISTANCE), (1.0, 0.0, 0.0, 0.0), math.radians(60.0)
        page.stand_at(ViewerCamera(*front, 640, 480), FIRST_DISTANCE)

    def serve() -> bool:
        drawn = frames.serve(lambda: state, 0, running=False)
        page.say("\n\n".join([line, *described(state, page)]))
        return drawn

    return serve


def open_state(path: Path, device: torch.device, given: Config | None = None) -> tuple[ModelState, str]:
    """The model to look at, on a device, its photos in host memory; and why its capture is absent, or "".

    Raises:
        InputError: there is no usable model, or no usable capture where one was named.
    """
    if given is None and not path.is_dir():
        gaussians = _centred(read_given(path), path).map(lambda value: value.to(device))
        return ModelState(gaussians, gaussians.sh_degree), ""
    model, scene, absent = load_with_capture(path, given, device, needed=False)
    look = model.own_look(None if scene is None else scene.train)
    state = ModelState(model.gaussians, look.sh_degree, look.settings, look.background)
    if scene is not None:
        state.capture = CaptureViews(scene.train, scene.test)
        if given is None:
            _take_saved_maps(state, path, scene, model)
    return state, absent


def _centred(gaussians: Gaussians, path: Path) -> Gaussians:
    """A file's model without a capture, float32: its middle at the origin, most of it within distance 1.

    Args:
        gaussians: float64, in any coordinates.
        path: the file, for messages.

    Raises:
        InputError: no Gaussian is finite.
    """
    means = gaussians.means.numpy()
    means = means[np.isfinite(means).all(axis=1)]
    if not len(means):
        return placed(gaussians, Similarity.into(Frame(np.zeros(3), 1.0)), path)  # which raises
    middle = np.median(means, axis=0)
    reach = float(np.quantile(np.linalg.norm(means - middle, axis=1), MOST))
    return placed(gaussians, Similarity.into(Frame(middle, reach if reach > 0 else 1.0)), path)


def _take_saved_maps(state: ModelState, folder: Path, scene: Scene, model: SavedModel) -> None:
    """Add the error maps of a run's newest checkpoint, and its time; nothing where they are not of these views."""
    train, maps = model.config.train, ErrorMaps(scene.train.cameras.sizes, beta=model.config.maps.beta)
    checkpoint = latest_checkpoint(folder / "checkpoints")
    assert checkpoint is not None and model.iteration is not None, "the model is a run's"
    assert train.iterations != "auto" and train.refine_until != "auto", "the run's plan decided them"
    try:
        maps.load_state_dict(load_checkpoint(checkpoint)["trainer"]["maps"])
    except (KeyError, TypeError, AttributeError, ValueError, RuntimeError):
        return
    state.maps = maps
    state.step = Step(model.iteration, train.iterations, train.refine_until, train.seed, scene.extent)
