"""Models to render, measure, hand over or start from: a run's newest one, or one that was trained anywhere, which is in
its capture's own coordinates, in nerfstudio's by the file beside it, or in gsplat's by `train.init_world`."""

from __future__ import annotations

import operator
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.errors import InputError
from turbogs_plugin.model.formats import FORMATS
from turbogs_plugin.model.placement import TRANSFORMS, gsplat_worlds, nearest_change, out_of_nerfstudio
from turbogs_plugin.model.similarity import Similarity, local_origin, placed
from turbogs_plugin.model.torch_file import read_gsplat, read_plain
from turbogs_plugin.scene import Frame, PosedImages, Scene
from turbogs_plugin.train.checkpoint import COUNT_LIMIT, latest_checkpoint, load_checkpoint
from turbogs_plugin.train.inputs import open_scene
from turbogs_plugin.train.look import Background, Look
from turbogs_plugin.train.run_files import RunFolder
from turbogs_plugin.types import PARAMETER_NAMES, Gaussians

REMEDY = "; save the model again, or as a .ply"
KINDS = "a .ply, .spz or gsplat's .pt of a 3DGS model, a checkpoint of TurboGS, or a run's folder"
_OTHERS = {
    "sog splat ksplat lcc": "convert it by  npx @playcanvas/splat-transform '{}' model.ply",
    "glb gltf usd usda usdc usdz splatv": "export a .ply from the program that made it",
    "ckpt": "export it by  ns-export gaussian-splat --load-config CONFIG.yml --output-dir FOLDER",
    "pth": "give the point_cloud/iteration_N/point_cloud.ply of its training",
}
"""Suffixes of models that are not read -> how to make a `.ply` of one."""
_SAVED = ("checkpoints/iteration-*.pt", "point_cloud/iteration_*/point_cloud.ply", "ckpts/ckpt_*_rank0.pt", "ply/*.ply")
"""Models in folders of trainings: of TurboGS, Inria's 3DGS and gsplat."""


@dataclass
class SavedModel:
    """The parts of a run needed to render or export its model, with `exposures` [V, 3, 4] of training photos if learnt;
    or a model from a file, without `folder`, `iteration` and `iterations`, which may be `antialiased`."""

    folder: RunFolder | None
    config: Config
    gaussians: Gaussians
    frame: Frame
    iteration: int | None
    iterations: int | None = None
    exposures: Tensor | None = None
    antialiased: bool = False

    @property
    def sh_degree(self) -> int:
        """Degree of the bands in use; all bands of a model from a file, which does not say."""
        return self.gaussians.sh_degree if self.iteration is None else self.config.train.sh_degree_at(self.iteration)

    def own_look(self, views: PosedImages | None = None) -> Look:
        """Look of the model's own colours, without exposures, beside views of its capture if there is one."""
        transparent = views is not None and views.photos.transparent
        background = Background.of(self.config.train.background, transparent).evaluated
        return Look(self.sh_degree, self.config.raster, background, antialiased=self.antialiased)


def load_model(path: Path, device: torch.device) -> SavedModel:
    """The newest saved model of a run. Raises `InputError`: no run there, no checkpoint, or an unusable one."""
    folder = RunFolder(path)
    if path.is_file():
        raise InputError(f"'{path}' is a file, not a run's folder: name the capture of a model by --scene SCENE")
    config = folder.read_config()
    folder.require_own()
    checkpoint = latest_checkpoint(folder.checkpoints)
    if checkpoint is None:
        raise InputError(f"'{path}' has no checkpoint: let the run go on with --resume, or give its model and --scene")
    state = load_checkpoint(checkpoint)
    try:
        trained, iteration = state["trainer"], operator.index(state["trainer"]["iteration"])
        loaded = read_gsplat({"splats": trained["gaussians"]}, checkpoint)
        gaussians = loaded.map(lambda value: value.float().to(device))
        exposures = trained["exposures"]["offsets"].to(device) if config.train.exposure is True else None
        if not (gaussians.finite_rows().all() and 0 <= iteration < COUNT_LIMIT):
            raise ValueError("its Gaussians are not finite, or its iteration is none")
        if exposures is not None and not (exposures.shape[1:] == (3, 4) and exposures.isfinite().all()):
            raise ValueError("its exposures are none")
        iterations = operator.index(state["pace"]["iterations"])  # which a time budget changes
        return SavedModel(folder, config, gaussians, Frame(**state["frame"]), iteration, iterations, exposures)
    except (KeyError, TypeError, AttributeError, IndexError, ValueError, RuntimeError) as error:
        raise InputError(f"checkpoint '{checkpoint}' is not one of a run: {error}") from None


def load_with_capture(
    path: Path, given: Config | None, device: torch.device, needed: bool = True
) -> tuple[SavedModel, Scene | None, str]:
    """The newest model of a run, or a model's file, whose capture and rendering are `given`; its capture; and why that
    is None: it is not there, and not `needed`. Warns of an unfinished run. Raises `InputError`: no such model, or no
    usable capture if needed."""
    if given is not None:
        given_model(path)  # before its capture is read
        scene = open_scene(given.scene, given.train.refine_cameras)
        gaussians, antialiased = load_given(path, scene, given.train.init_world)
        gaussians = gaussians.map(lambda value: value.to(device))
        return SavedModel(None, given, gaussians, scene.frame, None, antialiased=antialiased), scene, ""
    model = load_model(path, device)
    found: tuple[Scene | None, str]
    try:
        found = open_scene(model.config.scene, model.config.train.refine_cameras, trained=RunFolder(path).config), ""
    except InputError as error:
        if needed:
            raise
        found = None, str(error)
    if model.iteration != model.iterations:  # said last, as an error is one line alone
        warnings.warn(f"{path} is not finished: iteration {model.iteration} of {model.iterations}", stacklevel=2)
    return model, *found


def given_model(path: Path) -> Path:
    """The file of a model that is given with a capture, as of `require_model`. Raises `InputError`, too, for the folder
    of a run, whose own capture and settings would not be used."""
    if (config := RunFolder(path).config).is_file():
        moved = f"if the capture has moved, write its new place into '{config}' as scene.path"
        raise InputError(f"'{path}' is a run's folder, which has its own settings: leave --scene out; {moved}")
    return require_model(path)


def require_model(path: str | Path) -> Path:
    """The file of a model: itself, or the newest one in the folder of a training (`_SAVED`). Raises `InputError`
    where there is none, or it is of no kind that is read."""
    path = Path(path)
    if path.is_dir():
        found = next(filter(None, (list(path.glob(pattern)) for pattern in _SAVED)), [])
        if not found:
            raise InputError(f"'{path}' is a folder without a checkpoint of a run: give {KINDS}")
        return max(found, key=lambda file: [int(number) for number in re.findall(r"\d+", str(file.relative_to(path)))])
    if not path.is_file():
        raise InputError(f"no such model '{path}': give {KINDS}")
    kind = kind_of(path)
    for kinds, remedy in _OTHERS.items():
        if kind in kinds.split():
            raise InputError(f"'{path}' is a .{kind}, which is not read: {remedy.format(path)}")
    if kind not in FORMATS:
        raise InputError(f"'{path}' is no model: give {KINDS}")
    return path


def kind_of(file: Path) -> str:
    """The suffix of a file, as of `FORMATS`."""
    return file.suffix.lower().removeprefix(".")


def load_given(path: str | Path, scene: Scene, world: str = "capture") -> tuple[Gaussians, bool]:
    """A model as `require_model` takes it, float32 on the CPU, in the frame of the scene that it was trained on; and
    whether its file says that it is drawn with antialiasing. Warnings count Gaussians that are not finite, which are
    left out, and say that it does not fit the capture's points.

    `world` is `train.init_world`, the coordinates of a model that is not one of ours: ``capture`` or ``gsplat``. Raises
    `InputError` where the file is no such model, or the capture does not determine gsplat's world.
    """
    gaussians, antialiased, to_capture = read_given(path)
    if to_capture is None:
        to_capture = _to_capture(gaussians, require_model(path), scene, world)
    return placed(gaussians, Similarity.into(scene.frame).after(to_capture), path), antialiased


def _to_capture(gaussians: Gaussians, path: Path, scene: Scene, world: str) -> Similarity:
    """The change of a file's model to its capture's own coordinates. Exports are about a `local_origin`; the .spz of
    splat-transform, whose x is left and z forward, is turned about y beside Niantic's."""
    points = scene.frame.restore_points(scene.points.cpu().numpy())
    if world == "gsplat":
        views = torch.cat([each.cameras.viewmats.cpu() for each in (scene.train, scene.test)])
        viewmats = scene.frame.restore_poses(views.numpy())  # [V, 4, 4], in the capture's own coordinates
        changes = [change.inverse() for change in gsplat_worlds(viewmats, points)]
        if not changes:
            remedy = "train the model with --no-normalize-world-space, and leave train.init_world out"
            raise InputError(f"{path}: {scene.name} does not determine gsplat's normalised world: {remedy}")
    else:
        turns = [np.eye(3), np.diag([-1.0, 1.0, -1.0])][: 2 if kind_of(path) == "spz" else 1]
        origins = dict.fromkeys(map(tuple, (np.zeros(3), local_origin(scene.frame))))
        changes = out_of_nerfstudio(path)
        changes += [Similarity(turn, 1.0, np.array(origin)) for turn in turns for origin in origins]
    if scene.drawn_points:
        return changes[0]
    change, fits = nearest_change(gaussians, changes, points, scene.point_colors.cpu().numpy())
    if not fits:
        said = f"{path} does not fit the points of {scene.name}: it is of another capture or in other coordinates"
        remedy = f"say train.init_world=gsplat for gsplat's normalised ones, or put nerfstudio's {TRANSFORMS} beside it"
        warnings.warn(f"{said}; {remedy}", stacklevel=3)
    return change


def read_given(path: str | Path) -> tuple[Gaussians, bool, Similarity | None]:
    """A model from a file alone, float64 on the CPU in the file's own coordinates, some rows perhaps not finite;
    whether it is drawn with antialiasing; and the change to its capture's own coordinates where the file knows it.
    Errors as of `require_model`."""
    file = require_model(path)
    if kind_of(file) != "pt":
        return *FORMATS[kind_of(file)][1](file), None
    state = read_plain(file, f"'{file}'", REMEDY)
    if isinstance(state, Mapping) and "splats" in state:
        of_ranks = re.compile(re.sub(r"_rank\d+$", r"_rank\\d+", re.escape(file.stem)))  # with several, each has a part
        files = sorted(path for path in file.parent.glob("*.pt") if of_ranks.fullmatch(path.stem))
        parts = [read_gsplat(read_plain(part, f"'{part}'", REMEDY), part) for part in files]
        whole = {name: torch.cat([getattr(part, name) for part in parts]) for name in PARAMETER_NAMES}
        return Gaussians(**whole), False, None
    try:
        gaussians = read_gsplat({"splats": state["trainer"]["gaussians"]}, file)
        return gaussians, False, Similarity.into(Frame(**state["frame"])).inverse()
    except (KeyError, TypeError):
        keys = ", ".join(sorted(map(str, state))[:6]) if isinstance(state, Mapping) else type(state).__name__
        said = f"{file} is neither gsplat's checkpoint (step, splats) nor one of TurboGS (it has {keys})"
        raise InputError(f"{said}: give {KINDS}") from None
