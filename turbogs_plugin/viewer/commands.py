"""What `turbogs view` and `turbogs train --viewer` do."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.model.similarity import Similarity, placed
from turbogs_plugin.scene import Frame, Scene
from turbogs_plugin.train.checkpoint import latest_checkpoint, load_checkpoint
from turbogs_plugin.train.given_model import read_given
from turbogs_plugin.train.inputs import resolve_device
from turbogs_plugin.train.saved_model import load_with_capture
from turbogs_plugin.types import Gaussians, Step
from turbogs_plugin.viewer.controls import Controls
from turbogs_plugin.viewer.frames import Frames
from turbogs_plugin.viewer.live import LiveViewer, described
from turbogs_plugin.viewer.page import Page, require_free, require_viser
from turbogs_plugin.viewer.subject import CaptureViews, Subject
from turbogs_plugin.viewer.texts import plain

MOST = 0.9
"""Share of a model's Gaussians, those nearest to its middle, that is seen at first where there is no capture."""
FIRST_DISTANCE = 2.5
"""From its middle, where those lie within 1."""


@dataclass(frozen=True)
class Shown:
    """A model to look at.

    Args:
        subject: the model with what is known of it.
        title: for the page.
        note: what is lacking, in a line; empty if nothing is.
    """

    subject: Subject
    title: str
    note: str = ""


@contextmanager
def attached(port: int, host: str) -> Iterator[LiveViewer]:
    """A viewer for a training, which listens while entered.

    Raises:
        InputError: viser is not installed, or the port is not free.
    """
    with closing(Page(host, port, Controls())) as page:
        yield LiveViewer(page)


def view(path: Path, port: int, host: str, device_name: str, given: Config | None = None) -> int:
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
    require_viser()
    require_free(host, port)
    shown = open_shown(path, resolve_device(device_name), given)
    with suppress(KeyboardInterrupt), closing(Page(host, port)) as page:
        if shown.note:
            print(f"turbogs: {shown.note}", file=sys.stderr)
        print(f"viewer  {page.url}  (Ctrl-C ends)", flush=True)
        show(shown, page, lambda: False)
    return 0


def show(shown: Shown, page: Page, until: Callable[[], bool]) -> None:
    """Draw frames of a model whenever a page wants another one, until told to end."""
    subject = shown.subject
    if subject.capture is not None:
        page.show_capture(subject.capture)
    else:
        page.show_model(FIRST_DISTANCE)
    frames = Frames(page.screens, page.wish)
    line = f"**{plain(shown.title)}** · {len(subject.gaussians):,} Gaussians"
    while not until():
        drawn = frames.serve(lambda: subject, 0, running=False)
        page.say("\n\n".join([line, *described(subject, page)]))
        if not drawn:
            page.controls.wait(0.05)


def open_shown(path: Path, device: torch.device, given: Config | None = None) -> Shown:
    """The model to look at, on a device; its photos stay in host memory.

    Raises:
        InputError: there is no usable model, or no usable capture where one was named.
    """
    if given is None and not path.is_dir():
        gaussians = alone(read_given(path), path).map(lambda value: value.to(device))
        return Shown(Subject(gaussians, gaussians.sh_degree), path.name)
    model, scene, absent = load_with_capture(path, given, device, needed=False)
    capture = None if scene is None else CaptureViews(scene.train, scene.test)
    look = model.own_look(None if scene is None else scene.train)
    subject = Subject(model.gaussians, look.sh_degree, look.settings, look.background, capture)
    if given is not None:
        return Shown(subject, path.name)
    if scene is not None:
        subject.maps, subject.step = _saved_maps(path, scene, model.config, model.iteration)
    note = f"shown without its capture: {absent}" if absent else ""
    return Shown(subject, f"{path.name}, iteration {model.iteration}", note)


def alone(gaussians: Gaussians, path: Path) -> Gaussians:
    """A file's model without a capture, float32: its middle at the origin, most of it within distance 1.

    Args:
        gaussians: float64, in any coordinates.
        path: the file, for messages.

    Raises:
        InputError: no Gaussian is finite.
    """
    means = gaussians.means.numpy()
    means = means[np.isfinite(means).all(axis=1)]
    middle = np.median(means, axis=0) if len(means) else np.zeros(3)
    reach = float(np.quantile(np.linalg.norm(means - middle, axis=1), MOST)) if len(means) else 1.0
    return placed(gaussians, Similarity.into(Frame(middle, reach if reach > 0 else 1.0)), path)


def _saved_maps(
    folder: Path, scene: Scene, config: Config, iteration: int
) -> tuple[ErrorMaps, Step] | tuple[None, None]:
    """The error maps of a run's newest checkpoint, and its time; nothing where they are not of these views."""
    maps = ErrorMaps(scene.train.cameras.sizes, beta=config.maps.beta)
    try:
        maps.load_state_dict(load_checkpoint(latest_checkpoint(folder / "checkpoints"))["trainer"]["maps"])
    except (KeyError, TypeError, AttributeError, ValueError, RuntimeError):
        return None, None
    return maps, Step(iteration, config.train.iterations, config.train.refine_until, config.train.seed, scene.extent)
