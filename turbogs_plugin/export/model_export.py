"""Models written for other programs: in every format, or as a page to turn them on (`turbogs export`).

A file of single precision would round the places of a capture that lies far from its origin (UTM metres), so it is
about a `local_origin`, which is said; the run's own ``model.ply`` has doubles.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.engine.layout import ScreenRecord
from turbogs_plugin.engine.render import dense_samples, rasterize
from turbogs_plugin.engine.render_pass import RasterSettings
from turbogs_plugin.errors import InputError
from turbogs_plugin.export.html_page import html_page, page_gaussians
from turbogs_plugin.export.scene_files import read_splat, save_glb, save_splat, save_usda
from turbogs_plugin.files import require_new_file, write_text_atomically
from turbogs_plugin.model.formats import FORMATS, Read, Write
from turbogs_plugin.model.similarity import Similarity, local_origin
from turbogs_plugin.model.spz import VERSION, read_spz, save_spz
from turbogs_plugin.scene import Frame
from turbogs_plugin.scene.geometry import evenly
from turbogs_plugin.scene.offload import place_views
from turbogs_plugin.train.inputs import resolve_device
from turbogs_plugin.train.metrics import evaluate
from turbogs_plugin.train.saved_model import given_model, load_with_capture
from turbogs_plugin.types import Cameras, Gaussians

PAGE = "html"
"""Name of the page with the model to turn, which is made of more than a model and read by no program."""
EXPORTS: dict[str, tuple[Write, Read | None]] = {
    **FORMATS,
    "spz2": (partial(save_spz, version=2), read_spz),
    "splat": (save_splat, read_splat),
    "glb": (save_glb, None),
    "usda": (save_usda, None),
}
"""Name, as on the command line, whose letters are the file's suffix -> how a file is written and read again, None where
every number is as it was."""
MOST_ON_PAGE = 800_000
"""Largest model of a page: 36 bytes a Gaussian make about 30 MB, which mail and chat programs take."""
MOST_VIEWS = 8
"""Test views that are measured, evenly spread: each is rendered once more for the file's model."""


def export_run(
    path: Path, file_format: str, out: Path | None, max_gaussians: int | None = None, given: Config | None = None
) -> str:
    """Write a run's newest model or a given one, and compare what was written with it.

    Args:
        path: folder of the run, or the file of a model.
        file_format: one of `EXPORTS`, or `PAGE`.
        out: new file; None: in the run's folder, where ``model.ply`` is the training's own.
        max_gaussians: largest number of Gaussians to keep, those that add most to the training views; None: all.
        given: the capture of a model from a file, and how to render it; None: `path` is a run.

    Returns:
        Three lines for the user: the file, sizes, and PSNR before and after.

    Raises:
        InputError: an option does not fit, no such model, or no usable capture where it is needed.
    """
    file, is_page = _required_file(path, file_format, out, max_gaussians, given), file_format == PAGE
    most = min(max_gaussians or MOST_ON_PAGE, MOST_ON_PAGE) if is_page else max_gaussians
    model, scene, absent = load_with_capture(path, given, resolve_device("auto"), needed=most is not None)
    kept, whole, frame, antialiased, notes = model.gaussians, model.gaussians, model.frame, False, []
    if scene is not None and most is not None and most < len(whole):
        kept = pruned(whole, contributions(whole, scene.train.cameras, model.config.raster), most)
        notes.append(f"the {len(kept)} of {len(whole)} Gaussians that add most to the training views")
    if is_page and scene is not None:
        written = page_gaussians(kept, scene.train.cameras, model.sh_degree)
    else:
        if (origin := local_origin(frame)).any():
            frame = Frame(frame.center - origin, frame.scale)
            notes.append(f"about the local origin {' '.join(f'{value:.12g}' for value in origin)}")
        if file_format.startswith("spz"):
            newest = f"version {VERSION}; older viewers need --format spz2"
            notes.append("version 2" if file_format == "spz2" else newest)
        write, read = EXPORTS[file_format]
        write(kept, file, frame, model.iteration or 0, model.antialiased)
        written = kept
        if read is not None:
            found, antialiased = read(file)
            written = Similarity.into(frame).apply(found).map(torch.Tensor.float)
    if model.antialiased and not antialiased:
        notes.append("of antialiased training, which this file does not say: viewers draw it thicker")
    lost = f"not measured: {absent or 'the capture has no test views'}"
    caption = f"{len(written):,} Gaussians, one colour each"
    if scene is not None and len(scene.test):
        test, chosen = place_views(scene.test, whole.device, "host"), evenly(len(scene.test), MOST_VIEWS)
        look = model.own_look(test)
        other = replace(look, sh_degree=min(look.sh_degree, written.sh_degree), antialiased=antialiased)
        shown = ((whole, look), (written.map(lambda value: value.to(whole.device)), other))
        before, after = (evaluate(each, test, seen, view_ids=chosen).mean.psnr for each, seen in shown)
        lost = f"{before:.3f} -> {after:.3f} dB on {len(chosen)} of {len(test)} test views"
        caption += f": PSNR {after:.2f} dB on test views, {before:.2f} dB in the trained model"
    if is_page and scene is not None:
        background = model.own_look(scene.train).background
        write_text_atomically(file, html_page(written, scene.train.cameras, background, scene.name, caption))
    held = sum(value.numel() * 4 for _, value in whole.items())
    size = f"{held:,} bytes in float32 -> {file.stat().st_size:,} bytes in the file"
    said = f" ({'; '.join(notes)})" if notes else ""
    return f"{file}{said}\nsize   {size}, {len(written)} of {len(whole)} Gaussians\nPSNR   {lost}"


def _required_file(
    path: Path, file_format: str, out: Path | None, max_gaussians: int | None, given: Config | None
) -> Path:
    """The new file. Raises `InputError` where options do not fit each other, before anything is loaded."""
    if file_format not in (names := (*EXPORTS, PAGE)):
        raise InputError(f"--format {file_format}: there is no such format; choose one of {', '.join(names)}")
    if max_gaussians is not None and max_gaussians < 1:
        raise InputError(f"--max-gaussians {max_gaussians}: it must be at least 1")
    suffix = file_format.rstrip("2")
    if out is not None:
        require_new_file(out, "--out")
        if out.suffix.lower() != f".{suffix}":
            raise InputError(f"--out '{out}': --format {file_format} needs a name that ends in .{suffix}")
    elif given is not None:
        raise InputError(f"'{given_model(path)}' has no run's folder to export into: name a new file by --out")
    return out or path / ("export.ply" if suffix == "ply" else f"model.{suffix}")


@torch.no_grad()
def contributions(gaussians: Gaussians, cameras: Cameras, settings: RasterSettings) -> Tensor:
    """[N] float64: the sum of each Gaussian's blending weights T * alpha over all pixels of some views."""
    cameras = cameras.to(gaussians.device)
    sums = torch.zeros(len(gaussians), dtype=torch.float64, device=gaussians.device)
    for view in range(len(cameras)):
        samples = dense_samples(cameras, [view])
        rendered = rasterize(gaussians, cameras.select([view]), samples, sh_degree=0, settings=settings)
        sums += rendered.backward(torch.zeros_like(rendered.colors)).full_records()[0, :, ScreenRecord.WEIGHT_SUM]
    return sums


def pruned(gaussians: Gaussians, weights: Tensor, count: int) -> Gaussians:
    """The `count` Gaussians with the largest of the `weights` [N], in their order."""
    kept = torch.argsort(weights, descending=True, stable=True)[:count].sort().values
    return gaussians.map(lambda value: value[kept])
