"""Models that were trained anywhere: read from a file, and brought into the coordinates of a capture.

A model is expected in its capture's own coordinates. gsplat's example trainer works in others unless it is told not to
(`turbogs_plugin.model.gsplat_world`), so a model is first seen by a few training cameras. If it does not fit their
photos, and does after it is brought back from gsplat's world, that is done and said.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.captures.fingerprint import frame_of_state
from turbogs_plugin.engine.rendering import DEFAULT_SETTINGS, render_image
from turbogs_plugin.errors import InputError
from turbogs_plugin.model.formats import FORMATS
from turbogs_plugin.model.gsplat_file import read_gsplat
from turbogs_plugin.model.gsplat_world import gsplat_worlds
from turbogs_plugin.model.similarity import Similarity, placed
from turbogs_plugin.model.torch_file import read_plain
from turbogs_plugin.scene import Scene
from turbogs_plugin.scene.geometry import evenly
from turbogs_plugin.train.background import Background
from turbogs_plugin.train.checkpoint import latest_checkpoint
from turbogs_plugin.train.evaluate import psnr
from turbogs_plugin.types import PARAMETER_NAMES, Cameras, Gaussians

TRIAL_VIEWS = 3
"""Training views, evenly spread, that a model is compared with."""
TRIAL_SIDE = 400
"""They are reduced to at most this many pixels a side."""
CLEAR_GAIN = 3.0
"""PSNR in dB by which a model must fit better in gsplat's world before it is taken for one of that world."""
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


def load_given(path: str | Path, scene: Scene, device: torch.device) -> Gaussians:
    """A model from a file, in the frame of a scene.

    A warning counts Gaussians that are not finite, which are left out. Others say that the model was brought back from
    gsplat's normalised world, or that it does not fit the photos.

    Args:
        path: as `require_model` takes it.
        scene: the capture that it was trained on.
        device: where it is tried on training views.

    Returns:
        float32, on the CPU.

    Raises:
        InputError: the file is no such model.
    """
    file = require_model(path)
    into = Similarity.into(scene.frame)
    gaussians, frame_change = _read(file)
    if frame_change is not None:  # one of ours, whose coordinates are known
        return placed(gaussians, into.after(frame_change), file)
    return _fitted(gaussians, into, scene, device, file)


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
    """The model of a file in float64, and where it knows that, the change to the capture's own coordinates."""
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


def _fitted(gaussians: Gaussians, into: Similarity, scene: Scene, device: torch.device, file: Path) -> Gaussians:
    """A file's model in the scene's frame, from the capture's own coordinates or from gsplat's world."""
    as_given = placed(gaussians, into, file)
    trial = _TrialViews(scene, device)
    found, needed = trial.psnr(as_given), trial.flat_psnr
    if found >= needed:
        return as_given
    best, fit = None, max(needed, found + CLEAR_GAIN)  # in this order: what is found may be NaN
    for world in gsplat_worlds(_own_viewmats(scene), scene.frame.restore_points(scene.points.cpu().numpy())):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # rows that are left out were counted above
            brought_back = placed(gaussians, into.after(world.inverse()), file)
        reached = trial.psnr(brought_back)
        if reached > fit:
            best, fit = brought_back, reached
    views = f"on {len(trial.photos)} training views"
    if best is not None:
        warnings.warn(
            f"{file} is in gsplat's normalised world (PSNR {fit:.1f} dB {views} from there, {found:.1f} as it is): "
            "brought back into the capture's own coordinates",
            stacklevel=2,
        )
        return best
    warnings.warn(
        f"{file} does not fit the photos of {scene.name}: PSNR {found:.1f} dB {views}, whose mean colours alone have "
        f"{needed:.1f}, nor from gsplat's normalised world: it is hardly trained, or belongs to another capture, or "
        "was trained in other coordinates than this capture's own (gsplat: --no-normalize-world-space keeps them)",
        stacklevel=2,
    )
    return as_given


def _own_viewmats(scene: Scene) -> np.ndarray:
    """[V, 4, 4] float64 world to camera of all views, in the capture's own coordinates."""
    both = (scene.train.cameras.viewmats, scene.test.cameras.viewmats)
    viewmats = torch.cat([part.cpu() for part in both]).double().numpy()
    frame = scene.frame
    viewmats[:, :3, 3] = viewmats[:, :3, 3] * frame.scale - viewmats[:, :3, :3] @ frame.center
    return viewmats


class _TrialViews:
    """A few reduced training views.

    Attributes:
        photos: [H, W, 3] each.
        flat_psnr: mean PSNR of pictures that are each photo's mean colour.
    """

    def __init__(self, scene: Scene, device: torch.device) -> None:
        views, self._device = scene.train, device
        self._background = Background.of("auto", views.photos.transparent).evaluated
        chosen = evenly(len(views), TRIAL_VIEWS)
        cameras = views.cameras.to(device).select(chosen)
        sizes = cameras.sizes
        reductions = np.maximum(1.0, sizes.max(axis=1) / TRIAL_SIDE)  # [V]
        small = np.maximum(1, (sizes / reductions[:, None]).round()).astype(np.int64)
        ratios = torch.from_numpy(small / sizes).to(cameras.Ks)  # [V, 2]
        Ks = torch.cat([cameras.Ks[:, :2] * ratios[:, :, None], cameras.Ks[:, 2:]], dim=1)
        self._cameras = Cameras(cameras.viewmats, Ks, small)
        # A pixel stands for several of the photo, so its blur is less.
        self._settings = [replace(DEFAULT_SETTINGS, eps2d=DEFAULT_SETTINGS.eps2d / by**2) for by in reductions]
        kept = (_kept(views.mask(view), *size) for view, size in zip(chosen, small.tolist(), strict=True))
        self._masks = [mask.to(device) for mask in kept]
        self.photos = [
            _area_means(views.photos.image(view, self._background).to(device), *size)
            for view, size in zip(chosen, small.tolist(), strict=True)
        ]
        flat = (photo[mask].mean(dim=0) for photo, mask in zip(self.photos, self._masks, strict=True))
        self.flat_psnr = fmean(map(self._psnr, range(len(self.photos)), flat))

    def psnr(self, gaussians: Gaussians) -> float:
        """Mean PSNR of a model in the scene's frame, with all its bands."""
        model = gaussians.map(lambda value: value.to(self._device))
        values = []
        for view, settings in enumerate(self._settings):
            options = {"sh_degree": model.sh_degree, "settings": settings, "background": self._background}
            image = render_image(model, self._cameras, view, **options)
            values.append(self._psnr(view, image.colors.clamp(0.0, 1.0)))
        return fmean(values)

    def _psnr(self, view: int, image: Tensor) -> float:
        """Of an image [H, W, 3] or a colour [3], over the pixels that are not masked."""
        photo, mask = self.photos[view], self._masks[view]
        return psnr(image.expand_as(photo)[mask], photo[mask])


def _kept(mask: Tensor | None, width: int, height: int) -> Tensor:
    """[height, width] bool, the reduced pixels of which nothing is masked; all where nothing is, or none is left."""
    kept = torch.ones(height, width, dtype=torch.bool)
    if mask is not None:
        kept = _area_means(mask[:, :, None].float(), width, height)[:, :, 0] > 0.999
    return kept if kept.any() else torch.ones_like(kept)


def _area_means(photo: Tensor, width: int, height: int) -> Tensor:
    """[height, width, 3]: the means over areas."""
    channels = photo.permute(2, 0, 1)[None]
    return torch.nn.functional.interpolate(channels, (height, width), mode="area")[0].permute(1, 2, 0)
