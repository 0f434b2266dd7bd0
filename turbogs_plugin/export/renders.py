"""Renders of a saved model from its capture's cameras, as PNGs (`turbogs render`)."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.engine.render import render_image
from turbogs_plugin.errors import InputError
from turbogs_plugin.files import naming, require_writable, unused_name
from turbogs_plugin.report.evaluation import open_saved, views_of
from turbogs_plugin.report.images import depth_picture, save_image, to_uint8


def render_run(
    path: Path,
    split: str,
    device_name: str,
    with_depth: bool = False,
    given: Config | None = None,
    out: Path | None = None,
) -> list[Path]:
    """Write the views of a split, rendered from a run's newest model or a given one, as PNGs, and say what was done
    with the capture's photos: where they were undistorted, the cameras are, too.

    Args:
        path: folder of the run, or the file of a model.
        split: test or train.
        device_name: where to render.
        with_depth: also write each view's expected depth along the camera's axis, in the capture's own units, 0 where
            nothing was hit: as ``.npy`` ([H, W] float32) and as a coloured PNG (`depth_picture`).
        given: the capture of a model from a file, and how to render it; None: `path` is a run.
        out: folder for the folder of the views; None: ``renders`` of the run.

    Returns:
        The folder of the views, and with depth the folder of the depths.

    Raises:
        InputError: no such model, no usable capture, or no folder to write to.
    """
    if out is not None:
        require_writable(out, f"--out '{out}'")
    elif given is not None:
        raise InputError(f"'{path}' has no run's folder to render into: name one by --out FOLDER")
    model, scene = open_saved(path, device_name, given)
    views, look = views_of(model, scene, split)
    target = model.folder.renders if out is None and model.folder is not None else Path(out or ".")
    cameras = views.cameras.to(model.gaussians.device)
    folders = [target / name for name in ([split, f"{split}-depth"] if with_depth else [split])]
    for folder in folders:
        folder.mkdir(parents=True, exist_ok=True)
    for view_id, name in enumerate(distinct_stems(views.names)):
        image = render_image(model.gaussians, cameras, view_id, with_depth=with_depth, **look.options)
        save_image(folders[0] / f"{name}.png", to_uint8(look.colors(image.colors, view_id)))
        if image.depths is not None:
            depths = (image.depths.cpu().double() * model.frame.scale).float().numpy()
            with naming(folders[1] / f"{name}.npy"):
                np.save(folders[1] / f"{name}.npy", depths)
            save_image(folders[1] / f"{name}.png", depth_picture(depths))
    print("\n".join(scene.notes), file=sys.stderr)  # last, as an error is one line alone
    return folders


def distinct_stems(names: Sequence[str]) -> list[str]:
    """Names of photos without folders and suffixes; a name that came before gets a number."""
    stems: dict[str, None] = {}
    for name in names:
        stems[unused_name(Path(name).with_suffix("").as_posix().replace("/", "__"), stems)] = None
    return list(stems)
