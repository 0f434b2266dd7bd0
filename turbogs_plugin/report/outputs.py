"""What `turbogs eval` and `render` take from a run: its errors and its views."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.engine.rendering import render_image
from turbogs_plugin.errors import InputError
from turbogs_plugin.files import naming, require_writable, unused_name
from turbogs_plugin.report.pictures import depth_picture, to_uint8
from turbogs_plugin.report.tables import views_table
from turbogs_plugin.scene import PosedImages
from turbogs_plugin.scene.offload import place_views
from turbogs_plugin.train.inputs import resolve_device
from turbogs_plugin.train.look import Look, interpolated_exposures
from turbogs_plugin.train.metrics import evaluate
from turbogs_plugin.train.perceptual import load_flip, load_lpips
from turbogs_plugin.train.saved_model import SavedModel, load_with_capture


def evaluate_run(path: Path, device_name: str, given: Config | None = None) -> str:
    """Errors of a run's newest model, or of a given one, on each test view, as a table.

    Args:
        path: folder of the run, or the file of a model.
        device_name: where to render.
        given: the capture of a model from a file, and how to render it; None: `path` is a run.
    """
    model, views, look, _ = _open(path, device_name, "test", given)
    views = place_views(views, model.gaussians.device, model.config.train.photos_place)
    lpips, reason = load_lpips(model.config.report.lpips_weights, model.gaussians.device)
    flip, no_flip = load_flip()
    metrics = evaluate(model.gaussians, views, look, lpips, flip, aligned=True, refined=True)
    note = f"\nLPIPS was not computed: {reason}" if reason else ""
    note += f"\nFLIP was not computed: {no_flip}" if no_flip else ""
    which = f"iteration {model.iteration}" if given is None else str(path)
    speed = f"{len(model.gaussians)} Gaussians, {metrics.fps:.1f} views a second"
    return f"{views_table(metrics, with_means=True)}\n\n{which}, {speed}{note}"


def render_run(
    path: Path,
    split: str,
    device_name: str,
    with_depth: bool = False,
    given: Config | None = None,
    out: Path | None = None,
) -> list[Path]:
    """Write the views of a split, rendered from a run's newest model or a given one, as PNGs, and say what was done
    with the capture's photos: where they were undistorted, the views are those of the undistorted cameras.

    Args:
        path, given: as in `evaluate_run`.
        split: test or train.
        device_name: where to render.
        with_depth: also write each view's expected depth along the camera's axis, in the capture's own units, 0 where
            nothing was hit: as ``.npy`` ([H, W] float32) and as a coloured PNG (`depth_picture`).
        out: folder for the folder of the views; None: ``renders`` of the run.

    Returns:
        The folder of the views, and with depth that of the depths.
    """
    if given is not None and out is None:
        raise InputError(f"'{path}' has no run's folder to render into: name one by --out FOLDER")
    if out is not None:
        require_writable(out, f"--out '{out}'")
    model, views, look, notes = _open(path, device_name, split, given)
    target = model.folder.renders if out is None else out
    cameras = views.cameras.to(model.gaussians.device)
    folders = [target / name for name in ([split, f"{split}-depth"] if with_depth else [split])]
    for folder in folders:
        folder.mkdir(parents=True, exist_ok=True)
    for view_id, name in enumerate(distinct_stems(views.names)):
        image = render_image(model.gaussians, cameras, view_id, with_depth=with_depth, **look.options)
        with naming(folders[0] / f"{name}.png"):
            Image.fromarray(to_uint8(look.colors(image.colors, view_id))).save(folders[0] / f"{name}.png")
        if with_depth:
            depths = (image.depths.cpu().double() * model.frame.scale).float().numpy()
            with naming(folders[1] / f"{name}.npy"):
                np.save(folders[1] / f"{name}.npy", depths)
                Image.fromarray(depth_picture(depths)).save(folders[1] / f"{name}.png")
    print("\n".join(notes), file=sys.stderr)  # last, as an error is one line alone
    return folders


def distinct_stems(names: Sequence[str]) -> list[str]:
    """Names of photos without folders and suffixes; one that came before gets a number."""
    stems: dict[str, None] = {}
    for name in names:
        stems[unused_name(Path(name).with_suffix("").as_posix().replace("/", "__"), stems)] = None
    return list(stems)


def _open(
    path: Path, device_name: str, split: str, given: Config | None
) -> tuple[SavedModel, PosedImages, Look, tuple[str, ...]]:
    """A run's newest model or a given one on a device, the views of a split on the CPU, how it is shown beside them,
    and the capture's notes. Training views have their own exposures, where the run learnt them."""
    model, scene, _ = load_with_capture(path, given, resolve_device(device_name))
    views = scene.test if split == "test" else scene.train
    exposures = model.exposures
    if exposures is not None and split == "test":
        exposures = interpolated_exposures(exposures, scene.train.names, scene.test.names)
    return model, views, replace(model.own_look(views), exposures=exposures), scene.notes
