"""What `turbogs eval`, `render` and `export` take from a run: its errors, its views, its model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.engine.rendering import render_image
from turbogs_plugin.errors import InputError
from turbogs_plugin.files import require_writable
from turbogs_plugin.model.gsplat_file import save_gsplat
from turbogs_plugin.model.harmonics import band_energy, drop_faint_bands
from turbogs_plugin.model.ply import save_ply
from turbogs_plugin.report.pictures import depth_picture, to_uint8
from turbogs_plugin.report.tables import views_table
from turbogs_plugin.scene import PosedImages
from turbogs_plugin.scene.offload import place_views
from turbogs_plugin.train.background import Background
from turbogs_plugin.train.evaluate import evaluate, load_lpips
from turbogs_plugin.train.flip import load_flip
from turbogs_plugin.train.run import SavedModel, load_given_model, load_model, open_scene, resolve_device


def evaluate_run(path: Path, device_name: str, given: Config | None = None) -> str:
    """Errors of a run's newest model, or of a given one, on each test view, as a table.

    Args:
        path: folder of the run, or the file of a model.
        device_name: where to render.
        given: the capture of a model from a file, and how to render it; None: `path` is a run.
    """
    model, views = _open(path, device_name, "test", given)
    views = place_views(views, model.gaussians.device, model.config.train.photos_place)
    lpips, reason = load_lpips(model.config.report.lpips_weights, model.gaussians.device)
    flip, no_flip = load_flip()
    background = Background.of(model.config.train.background, views.photos.transparent).evaluated
    settings = model.config.raster
    options = {"flip": flip, "background": background, "aligned": True}
    metrics = evaluate(model.gaussians, views, model.sh_degree, settings, lpips, **options)
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
    """Write the views of a split, rendered from a run's newest model or a given one, as PNGs.

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
    model, views = _open(path, device_name, split, given)
    target = model.folder.renders if out is None else out
    cameras = views.cameras.to(model.gaussians.device)
    folders = [target / name for name in ([split, f"{split}-depth"] if with_depth else [split])]
    for folder in folders:
        folder.mkdir(parents=True, exist_ok=True)
    background = Background.of(model.config.train.background, views.photos.transparent).evaluated
    for view_id, name in enumerate(distinct_stems(views.names)):
        options = {"sh_degree": model.sh_degree, "settings": model.config.raster, "with_depth": with_depth}
        options["background"] = background
        image = render_image(model.gaussians, cameras, view_id, **options)
        Image.fromarray(to_uint8(image.colors)).save(folders[0] / f"{name}.png")
        if with_depth:
            depths = (image.depths.cpu().double() * model.frame.scale).float().numpy()
            np.save(folders[1] / f"{name}.npy", depths)
            Image.fromarray(depth_picture(depths)).save(folders[1] / f"{name}.png")
    return folders


def distinct_stems(names: Sequence[str]) -> list[str]:
    """Names of photos without folders and suffixes; one that came before gets a number."""
    stems: dict[str, None] = {}
    for name in names:
        flat = stem = Path(name).with_suffix("").as_posix().replace("/", "__")
        number = 1
        while stem in stems:
            number += 1
            stem = f"{flat}-{number}"
        stems[stem] = None
    return list(stems)


def export_run(
    path: Path, file_format: str, out: Path | None, drop_bands: float | None = None, given: Config | None = None
) -> str:
    """Write a run's newest model or a given one; returns in words what was written.

    Args:
        path, given: as in `evaluate_run`.
        file_format: ply, or pt: as gsplat's trainer saves it.
        out: new file; None: the model in the run's folder.
        drop_bands: threshold of `drop_faint_bands`; None: all bands are written.
    """
    if drop_bands is not None and not 0 <= drop_bands < 1:
        raise InputError(f"--drop-bands {drop_bands}: it must be a share, at least 0 and less than 1")
    if out is not None and out.exists():
        raise InputError(f"--out '{out}' exists: choose a new file")
    if given is not None and out is None:
        raise InputError(f"'{path}' has no run's folder to export into: name a new file by --out")
    device = resolve_device("cpu")
    model = load_model(path, device) if given is None else load_given_model(path, given, device)[0]
    target = model.folder.model.with_suffix(f".{file_format}") if out is None else out
    gaussians = model.gaussians if drop_bands is None else drop_faint_bands(model.gaussians, drop_bands)
    if file_format == "pt":
        save_gsplat(gaussians, target, model.frame, model.iteration or 0)
    else:
        save_ply(gaussians, target, model.frame)
    if drop_bands is None:
        return f"{target}"
    before, after = model.gaussians.sh_degree, gaussians.sh_degree
    if before == after:
        return f"{target} (degree {before} stays: it has {band_energy(model.gaussians)[-1]:.2g} of the colours' energy)"
    share = sum(band_energy(model.gaussians)[after + 1 :])
    return f"{target} (degree {before} -> {after}, without {share:.2g} of the colours' energy)"


def _open(path: Path, device_name: str, split: str, given: Config | None) -> tuple[SavedModel, PosedImages]:
    """A run's newest model or a given one on a device, and the views of a split on the CPU."""
    device = resolve_device(device_name)
    if given is not None:
        model, scene = load_given_model(path, given, device)
    else:
        model = load_model(path, device)
        scene = open_scene(model.config, model.folder)
    return model, scene.test if split == "test" else scene.train
