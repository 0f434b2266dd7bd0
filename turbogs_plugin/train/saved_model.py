"""Models to render, measure or hand over: a run's newest one, or one that was trained anywhere."""

from __future__ import annotations

import operator
import shlex
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from turbogs_plugin.captures.fingerprint import frame_of_state
from turbogs_plugin.config.configuration import Config
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene import Frame, PosedImages, Scene
from turbogs_plugin.train.checkpoint import gaussians_of_state, latest_checkpoint, load_checkpoint
from turbogs_plugin.train.given_model import load_given, require_model
from turbogs_plugin.train.inputs import open_scene
from turbogs_plugin.train.look import Background, Look
from turbogs_plugin.train.run_files import RunFolder
from turbogs_plugin.types import Gaussians


@dataclass
class SavedModel:
    """The parts of a run needed to render or export its model, or a model from a file.

    Args:
        folder, iteration: of the run; None for a model from a file.
        exposures: [V, 3, 4] of the training photos; None where none were learnt, and for a model from a file.
    """

    folder: RunFolder | None
    config: Config
    gaussians: Gaussians
    frame: Frame
    iteration: int | None
    exposures: Tensor | None = None

    @property
    def sh_degree(self) -> int:
        """Degree of the bands in use; all bands of a model from a file, which does not say."""
        given = self.iteration is None
        return self.gaussians.sh_degree if given else self.config.train.sh_degree_at(self.iteration)

    def own_look(self, views: PosedImages | None = None) -> Look:
        """Look of the model's own colours, on the background of evaluations and without exposures, beside views of its
        capture if there is one."""
        transparent = views is not None and views.photos.transparent
        background = Background.of(self.config.train.background, transparent).evaluated
        return Look(self.sh_degree, self.config.raster, background)


def load_model(path: Path, device: torch.device) -> SavedModel:
    """The newest saved model of a run.

    Raises:
        InputError: no run there, no checkpoint, or an unusable one.
    """
    folder = RunFolder(path)
    if path.is_file():
        raise InputError(f"'{path}' is a file, not a run's folder: name the capture of a model by --scene SCENE")
    config = folder.read_config()
    checkpoint = latest_checkpoint(folder.checkpoints)
    if checkpoint is None:
        quoted = shlex.quote(str(path))
        if folder.model.is_file():
            scene = shlex.quote(config.scene.path)
            raise InputError(
                f"'{path}' has no checkpoint: give its model by  {shlex.quote(str(folder.model))} --scene {scene}"
            )
        raise InputError(f"'{path}' has no checkpoint yet: let the run go on with  turbogs train --resume {quoted}")
    state = load_checkpoint(checkpoint)
    try:
        frame = frame_of_state(state)
        trained = state["trainer"]
        iteration = operator.index(trained["iteration"])
        exposures = trained["exposures"]["offsets"].to(device) if config.train.exposure is True else None
        return SavedModel(folder, config, gaussians_of_state(trained, device), frame, iteration, exposures)
    except (KeyError, TypeError, AttributeError, IndexError, ValueError, RuntimeError) as error:
        raise InputError(f"checkpoint '{checkpoint}' is not one of a run: {error}") from None


def load_with_capture(
    path: Path, given: Config | None, device: torch.device, needed: bool = True
) -> tuple[SavedModel, Scene | None, str]:
    """A run's newest model or a given one, its capture, and why that is None: it is not there, and not `needed`.

    Args:
        path: folder of the run, or a model as `require_model` takes it.
        given: says which capture a file's model belongs to, and how to render; None: `path` is a run.

    Raises:
        InputError: no such model, or no usable capture where it is needed.
    """
    if given is not None:
        require_model(path)  # before its capture is read
        scene = open_scene(given)
        gaussians = load_given(path, scene, given.train.init_world).map(lambda value: value.to(device))
        return SavedModel(None, given, gaussians, scene.frame, None), scene, ""
    model = load_model(path, device)
    try:
        return model, open_scene(model.config, model.folder), ""
    except InputError as error:
        if needed:
            raise
        return model, None, str(error)
