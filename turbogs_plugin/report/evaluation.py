"""Errors of a saved model on its test views, as `turbogs eval` prints them."""

from __future__ import annotations

import importlib.util
import json
from dataclasses import replace
from pathlib import Path

import torch

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.errors import InputError, refusal
from turbogs_plugin.files import write_text_atomically
from turbogs_plugin.report.tables import explained, short_table
from turbogs_plugin.scene import PosedImages, Scene
from turbogs_plugin.scene.offload import place_views
from turbogs_plugin.train.history import without_nan
from turbogs_plugin.train.inputs import resolve_device
from turbogs_plugin.train.look import Look, interpolated_exposures
from turbogs_plugin.train.metrics import ImageError, evaluate
from turbogs_plugin.train.saved_model import SavedModel, load_with_capture

LPIPS_PACKAGES = ("torchvision", "torchmetrics")
"""Packages with the network, and with LPIPS itself."""


def evaluate_run(path: Path, device_name: str, given: Config | None = None) -> str:
    """Errors of a run's newest model, or of a given one (see `open_saved`), on each test view, as a table. A run's
    folder gets all of them as ``metrics.json``, too."""
    model, scene = open_saved(path, device_name, given)
    views, look = views_of(model, scene, "test")
    views = place_views(views, model.gaussians.device, model.config.train.pixels_place)
    lpips, reason = load_lpips(model.gaussians.device)
    metrics = evaluate(model.gaussians, views, look, lpips, further=True)
    mean, notes = metrics.mean, explained(metrics) + ([f"LPIPS was not computed: {reason}"] if reason else [])
    if model.folder is not None:
        counts = {"iteration": model.iteration, "num_gaussians": len(model.gaussians), "fps": metrics.fps}
        end = {**counts, "mean": without_nan(mean), "views": [without_nan(view) for view in metrics.views]}
        try:
            write_text_atomically(model.folder.metrics, json.dumps(end, indent=1) + "\n")
        except OSError as error:  # somebody else's run
            notes.append(f"metrics.json was not written: {refusal(error)}")
    which = f"iteration {model.iteration}" if given is None else str(path)
    notes.insert(0, f"{which}, {len(model.gaussians)} Gaussians, {metrics.fps:.1f} views a second")
    return "\n".join([short_table(metrics), "", *notes])


def open_saved(path: Path, device_name: str, given: Config | None) -> tuple[SavedModel, Scene]:
    """`load_with_capture` of a model, on the device of a name, and of its capture, which is needed."""
    model, scene, _ = load_with_capture(path, given, resolve_device(device_name))
    assert scene is not None, "the capture is needed"
    return model, scene


def views_of(model: SavedModel, scene: Scene, split: str) -> tuple[PosedImages, Look]:
    """The views of a split, test or train, and how the model is shown beside them: with the exposures of training
    photos, where the run learnt them, or what these tell of the test photos."""
    views = scene.test if split == "test" else scene.train
    exposures = model.exposures
    if exposures is not None and len(exposures) != len(scene.train):
        raise InputError(f"the run has exposures of {len(exposures)} photos, its capture has {len(scene.train)}")
    if exposures is not None and split == "test":
        exposures = interpolated_exposures(exposures, scene.train.names, scene.test.names)
    return views, replace(model.own_look(views), exposures=exposures)


def load_lpips(device: torch.device) -> tuple[ImageError | None, str]:
    """LPIPS (VGG16) by torchmetrics, if `LPIPS_PACKAGES` are installed and the backbone's weights are in torch's cache;
    or None, and the reason. Nothing is downloaded, and what takes seconds to import is imported here."""
    missing = [name for name in LPIPS_PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        release = torch.__version__.partition("+")[0]  # or pip may bring another torch with torchvision
        return None, f"it needs {' and '.join(missing)}: pip install {' '.join(missing)} torch=={release}"
    weights = Path(torch.hub.get_dir()) / "checkpoints" / "vgg16-397923af.pth"  # torchvision's name
    if not weights.is_file():
        # Without the folder's path: studies keep the reason in their records, which others read.
        return None, f"there are no weights of VGG16: put torchvision's {weights.name} into torch's hub/checkpoints"
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    network = LearnedPerceptualImagePatchSimilarity(net_type="vgg", normalize=True).to(device)
    return lambda image, photo: network(image.permute(2, 0, 1)[None], photo.permute(2, 0, 1)[None]).item(), ""
