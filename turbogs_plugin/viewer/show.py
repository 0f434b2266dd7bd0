"""The viewer of a finished model: a run's newest one or a file's, as `turbogs view` shows it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import torch

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.engine.render_pass import DEFAULT_SETTINGS
from turbogs_plugin.model.similarity import Similarity, placed
from turbogs_plugin.scene import Frame
from turbogs_plugin.train.inputs import resolve_device
from turbogs_plugin.train.look import Look
from turbogs_plugin.train.run_files import RunFolder
from turbogs_plugin.train.saved_model import load_with_capture, read_given
from turbogs_plugin.viewer.pictures import CaptureViews, ModelState
from turbogs_plugin.viewer.server import Page, quoted, serve_until_interrupted


def view(path: Path, port: int, host: str, device_name: str, given: Config | None = None) -> None:
    """Show the model of `open_state` until Ctrl-C. `InputError`, too, where no page can be opened (`Page`)."""
    with closing(Page(host, port)) as page:
        state = open_state(path, resolve_device(device_name), given)
        serve_until_interrupted(page, server_of(state, path.name, page))


def server_of(state: ModelState, title: str, page: Page) -> Callable[[], bool]:
    """A function that draws a frame of a model if one is due, and says whether it did."""
    line = f"{quoted(title)} · {len(state.gaussians):,} Gaussians"
    if state.capture is not None:
        page.show_capture(state.capture)
    else:  # which way is up is not known: y is taken as down, as most reconstructions have it
        page.server.scene.set_up_direction("-y")

    def serve() -> bool:
        drawn = page.frames.serve(lambda: state, 0, running=False)
        if drawn:
            page.say(line)
        return drawn

    return serve


def open_state(path: Path, device: torch.device, given: Config | None = None) -> ModelState:
    """A run's newest model or a file's, on a device, its photos in host memory.

    Args:
        path: folder of a run, or the file of a model.
        given: the capture of a model from a file, and how to render it; None: a run knows its own, and a file is shown
            without one, its middle at the origin and half of it within distance 1.

    Raises:
        InputError: there is no usable model, or no usable capture of a run or where one was named.
    """
    if given is None and not RunFolder(path).config.is_file():
        alone, antialiased, _ = read_given(path)
        rows = alone.finite_rows()
        means = alone.means[rows] if rows.any() else torch.zeros(1, 3)
        middle = means.median(dim=0).values
        reach = float((means - middle).norm(dim=1).median()) or 1.0
        gaussians = placed(alone, Similarity.into(Frame(middle.numpy(), reach)), path)
        look = Look(gaussians.sh_degree, DEFAULT_SETTINGS, antialiased=antialiased)
        return ModelState(gaussians.map(lambda value: value.to(device)), look)
    model, scene, _ = load_with_capture(path, given, device)
    assert scene is not None, "the capture is needed"
    return ModelState(model.gaussians, model.own_look(scene.train), CaptureViews(scene.train, scene.test))
