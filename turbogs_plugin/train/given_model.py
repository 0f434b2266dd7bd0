"""Models that were trained anywhere: read from a file, and brought into the coordinates of a capture.

A model is taken to be in its capture's own coordinates. gsplat's example trainer works in others unless it is told not
to (`turbogs_plugin.model.gsplat_world`); `train.init_world` says which.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from turbogs_plugin.captures.fingerprint import frame_of_state
from turbogs_plugin.errors import InputError
from turbogs_plugin.model.formats import FORMATS
from turbogs_plugin.model.gsplat_file import read_gsplat
from turbogs_plugin.model.gsplat_world import out_of_gsplat_world
from turbogs_plugin.model.similarity import Similarity, placed
from turbogs_plugin.model.torch_file import read_plain
from turbogs_plugin.scene import Scene
from turbogs_plugin.train.checkpoint import latest_checkpoint
from turbogs_plugin.types import PARAMETER_NAMES, Gaussians

KINDS = "a .ply, .splat, .spz or gsplat's .pt of a 3DGS model, a checkpoint of TurboGS, or a run's folder"


def require_model(path: str | Path) -> Path:
    """The file of a model: itself, or the newest checkpoint of a run's folder.

    Raises:
        InputError: there is none, or it is of no kind that is read.
    """
    path = Path(path)
    if path.is_dir():
        checkpoint = latest_checkpoint(path / "checkpoints")
        if checkpoint is None:
            raise InputError(f"'{path}' is a folder without a checkpoint of a run: give {KINDS}")
        return checkpoint
    if not path.is_file():
        raise InputError(f"no such model '{path}': give {KINDS}")
    if _format(path) not in FORMATS:
        raise InputError(f"'{path}' is no model: give {KINDS}")
    return path


def load_given(path: str | Path, scene: Scene, world: str = "capture") -> Gaussians:
    """A model from a file, in the frame of a scene. A warning counts Gaussians that are not finite, which are left out.

    Args:
        path: as `require_model` takes it.
        scene: the capture that it was trained on.
        world: `train.init_world`, the coordinates of a model that is not one of ours: ``capture`` or ``gsplat``.

    Returns:
        float32, on the CPU.

    Raises:
        InputError: the file is no such model, or the capture does not determine gsplat's world.
    """
    file = require_model(path)
    into = Similarity.into(scene.frame)
    gaussians, to_capture = _read(file)
    if to_capture is None and world == "gsplat":
        points = scene.frame.restore_points(scene.points.cpu().numpy())
        to_capture = out_of_gsplat_world(gaussians, _own_viewmats(scene), points, scene.point_colors.cpu().numpy())
        if to_capture is None:
            raise InputError(
                f"{file}: the cameras and points of {scene.name} do not determine gsplat's normalised world: train the "
                "model with --no-normalize-world-space, and leave train.init_world out"
            )
    return placed(gaussians, into if to_capture is None else into.after(to_capture), file)


def read_given(path: str | Path) -> Gaussians:
    """A model from a file alone, whatever capture it belongs to.

    Returns:
        float64, on the CPU, in the file's own coordinates; rows may be not finite.

    Raises:
        InputError: the file is no such model (`require_model`).
    """
    return _read(require_model(path))[0]


def _format(file: Path) -> str:
    return file.suffix.lower().removeprefix(".")


def _read(file: Path) -> tuple[Gaussians, Similarity | None]:
    """The model of a file in float64, and the change to the capture's own coordinates where the file knows it."""
    if _format(file) != "pt":
        return FORMATS[_format(file)].read(file), None
    state = _state(file)
    if isinstance(state, Mapping) and "splats" in state:
        parts = [read_gsplat(state, file), *(read_gsplat(_state(other), other) for other in _other_ranks(file))]
        if len({part.shN.shape[1] for part in parts}) > 1:
            raise InputError(f"{file}: the files of its ranks differ in degree: give those of one run")
        names = PARAMETER_NAMES
        return Gaussians(**{name: torch.cat([getattr(part, name) for part in parts]) for name in names}), None
    trainer = state.get("trainer") if isinstance(state, Mapping) else None
    if not (isinstance(trainer, Mapping) and isinstance(trainer.get("gaussians"), Mapping)):
        keys = ", ".join(sorted(map(str, state))[:6]) if isinstance(state, Mapping) else type(state).__name__
        raise InputError(
            f"{file} is neither gsplat's checkpoint (step, splats) nor one of TurboGS (it has {keys}): give {KINDS}"
        )
    gaussians = read_gsplat({"splats": trainer["gaussians"]}, file)
    try:
        return gaussians, Similarity.into(frame_of_state(state)).inverse()
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{file}: its frame cannot be read ({error}): give another checkpoint") from None


def _state(file: Path) -> object:
    return read_plain(file, f"'{file}'", "; save the model again, or as a .ply")


def _other_ranks(file: Path) -> list[Path]:
    """The files with the rest of a model that several GPUs trained: ckpt_STEP_rank1.pt beside ckpt_STEP_rank0.pt."""
    name = re.fullmatch(r"(.*_rank)\d+\.pt", file.name)
    if name is None:
        return []
    others = (path for path in file.parent.iterdir() if path != file and path.suffix == ".pt")
    return sorted(path for path in others if re.fullmatch(re.escape(name[1]) + r"\d+\.pt", path.name))


def _own_viewmats(scene: Scene) -> np.ndarray:
    """[V, 4, 4] float64 world to camera of all views, in the capture's own coordinates."""
    both = (scene.train.cameras.viewmats, scene.test.cameras.viewmats)
    viewmats = torch.cat([part.cpu() for part in both]).double().numpy()
    frame = scene.frame
    viewmats[:, :3, 3] = viewmats[:, :3, 3] * frame.scale - viewmats[:, :3, :3] @ frame.center
    return viewmats
