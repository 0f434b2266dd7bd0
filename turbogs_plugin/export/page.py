"""A run on one page that opens from the disk, without a network: curves, tables, test views, the model in a viewer."""

from __future__ import annotations

import base64
import copy
import io
import json
import tempfile
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template

import numpy as np
import torch
from PIL import Image

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.errors import InputError
from turbogs_plugin.export.camera_path import focus_and_up
from turbogs_plugin.export.contribution import contributions, pruned
from turbogs_plugin.export.fidelity import Change, Fidelity
from turbogs_plugin.export.packing import PackedModel, pack, unpack
from turbogs_plugin.files import write_text_atomically
from turbogs_plugin.model.row_order import spatial_order
from turbogs_plugin.report.pictures import ERROR_FULL_SCALE, error_picture, to_uint8
from turbogs_plugin.report.plots import plot_against_seconds
from turbogs_plugin.report.tables import ERRORS, errors, history_rows, number
from turbogs_plugin.scene import Scene
from turbogs_plugin.study.document import CSS, Block, Heading, Paragraph, Table
from turbogs_plugin.train.history import Evaluation, read_history
from turbogs_plugin.train.metrics import compare
from turbogs_plugin.train.saved_model import SavedModel
from turbogs_plugin.types import Cameras, Gaussians

LARGEST_PAGE = 32_000_000
"""Bytes. Mail and chat programs take such files."""
WIDEST_PICTURE = 1200
"""Pixels of the longer side of a test view's pictures."""
JPEG_QUALITY = 88
MOST_TRIES = 4
"""Times that a model is made smaller until the page is small enough."""
CURVES = (
    ("psnr", "test PSNR in dB"),
    ("l1", "mean absolute error on test views (0 .. 1)"),
    ("num_gaussians", "Gaussians"),
)


def write_page(model: SavedModel, shown: Gaussians, scene: Scene, path: Path) -> tuple[int, Change]:
    """Write the page of a model, smaller than `LARGEST_PAGE`. The file is written whole or not at all.

    Args:
        model: what the test views show; on the device where it is rendered.
        shown: what the viewer shows: the model, or what was kept of it; on the same device.
        scene: its capture, on the CPU.

    Returns:
        The number of Gaussians in it, and what the model lost by being packed and pruned.

    Raises:
        InputError: no Gaussian is finite, or the pictures alone are too large.
    """
    finite = shown.finite_rows()
    gaussians = shown.map(lambda value: value[finite])
    if not len(gaussians):
        raise InputError("there are no Gaussians to write")
    order = spatial_order(gaussians.means, scene.extent)
    gaussians = gaussians.map(lambda value: value[order])
    look = model.own_look(scene.test)
    fidelity = Fidelity(model.gaussians, scene.test, look)
    history = read_history(model.folder.history) if model.folder is not None else []
    parts = {
        "title": escape(scene.name),
        "style": CSS + _web("page.css"),
        "viewer": _web("viewer.js"),
        "page": _web("page.js"),
        "full_scale": f"{ERROR_FULL_SCALE:g}",
        "background": "rgb({}, {}, {})".format(*(round(255 * value) for value in look.background)),
        "views": "\n".join(_view(fidelity, model.gaussians, scene, view) for view in fidelity.view_ids),
        "tables": _tables(model, scene, history),
    }

    def filled(packed: PackedModel, change: Change) -> str:
        blocks = {
            "summary": _summary(model, scene, fidelity, history),
            "cost": _cost(len(model.gaussians), packed, change),
            "scene": json.dumps(_scene(model, scene, packed)).replace("<", "\\u003c"),
            "model": base64.b64encode(packed.planes).decode("ascii"),
        }
        return Template(_web("page.html")).substitute({**parts, **blocks})

    packed = pack(gaussians)
    unmeasured = Change(0.0, 0.0, 0, 0)
    weights = None
    for _ in range(MOST_TRIES):
        size = len(filled(packed, unmeasured).encode())
        if size < LARGEST_PAGE - 1000:  # room for the words of what it costs
            break
        held = len(packed.planes) * 4 / 3
        share = 0.98 * (LARGEST_PAGE - (size - held)) / held
        if share < 0.01:
            raise InputError("the page's pictures alone take 32 MB: export the model of a smaller --factor")
        if weights is None:
            weights = contributions(gaussians, scene.train.cameras, model.config.raster)
        packed = pack(pruned(gaussians, weights, max(1, int(share * packed.count))))
    change = fidelity.change(unpack(packed))
    write_text_atomically(path, filled(packed, change))
    return packed.count, change


def _web(name: str) -> str:
    return files("turbogs_plugin.export").joinpath("web", name).read_text(encoding="utf-8")


def _html(blocks: Sequence[Block]) -> str:
    return "\n".join(block.html(Path()) for block in blocks)


def _summary(model: SavedModel, scene: Scene, fidelity: Fidelity, history: list[Evaluation]) -> str:
    views = f"{len(scene.train)} training views, {len(scene.test)} test views"
    if not history or history[-1].iteration != model.iteration:  # a run that was stopped between two evaluations
        trained = "" if model.iteration is None else f" after {model.iteration} iterations"
        measured = f"PSNR {fidelity.before:.2f} dB on {len(fidelity.view_ids)} of the test views"
        return _html([Paragraph(f"{len(model.gaussians)} Gaussians{trained}; {views}. {measured}.")])
    last = history[-1]
    header = (*ERRORS.values(), "training in s", "iterations", "Gaussians")
    row = (*errors(last), f"{last.train_seconds:.1f}", str(last.iteration), str(last.num_gaussians))
    said = f"{views}; seed {model.config.train.seed}. Errors are means over the test views."
    if model.exposures is not None:
        said += " They are of the model with each photo's exposure; below, all is in the model's own colours."
    return _html([Table(header, [row]), Paragraph(said)])


def _cost(count: int, packed: PackedModel, change: Change) -> str:
    kept = f"all {count} Gaussians"
    if packed.count < count:
        kept = f"{packed.count} of {count} Gaussians, those that add most to the training views"
    text = f"The model here has {kept}, rounded to {packed.stride} bytes each. What that costs: {change.text()}."
    return _html([Paragraph(text)])


def _view(fidelity: Fidelity, gaussians: Gaussians, scene: Scene, view: int) -> str:
    photo, image = fidelity.photo(view), fidelity.image(gaussians, view)
    name = scene.test.names[view]
    measured = compare(name, image, photo, fidelity.mask(view))
    error = error_picture(photo, image).cpu().numpy()
    pictures = (("photo", to_uint8(photo)), ("render", to_uint8(image)), ("error", error))
    images = "".join(f'<img alt="{kind} of {escape(name)}" src="{_jpeg(pixels)}">' for kind, pixels in pictures)
    return (
        f'<figure class="view"><div class="pictures">{images}</div>'
        f'<input type="range" min="0" max="2" step="0.01" value="1" aria-label="photo, render, error">'
        f"<figcaption><span>{escape(name)}: {number(measured.psnr, 2)} dB, SSIM {number(measured.ssim, 4)}</span>"
        f'<b class="named"></b><button data-look="{len(scene.train) + view}">in the model</button></figcaption>'
        "</figure>"
    )


def _jpeg(pixels: np.ndarray) -> str:
    """A data URL of a picture [H, W, 3] uint8, reduced to `WIDEST_PICTURE`."""
    picture = Image.fromarray(pixels)
    picture.thumbnail((WIDEST_PICTURE, WIDEST_PICTURE), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    picture.save(buffer, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    return f"data:image/jpeg;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"


def _scene(model: SavedModel, scene: Scene, packed: PackedModel) -> dict[str, object]:
    """What the viewer is told besides the model, in the scene's normalised frame. Training views come first."""
    cameras = _joined(scene)
    lenses = cameras.Ks[:, [0, 1, 0, 1], [0, 1, 2, 2]]
    target, up = focus_and_up(cameras)
    raster = model.config.raster
    return {
        "model": {
            "count": packed.count,
            "stride": packed.stride,
            "bands": packed.bands,
            "ranges": packed.ranges,
            "eps2d": raster.eps2d,
            "alpha_min": raster.alpha_min,
        },
        "cameras": [
            {
                "name": name,
                "test": view >= len(scene.train),
                "rotation": cameras.viewmats[view, :3, :3].flatten().tolist(),
                "translation": cameras.viewmats[view, :3, 3].tolist(),
                "center": cameras.centers[view].tolist(),
                "lens": lenses[view].tolist(),
                "size": cameras.sizes[view].tolist(),
            }
            for view, name in enumerate((*scene.train.names, *scene.test.names))
        ],
        "first": len(scene.train),
        "target": target.tolist(),
        "up": up.tolist(),
    }


def _joined(scene: Scene) -> Cameras:
    parts = [part.cameras.to("cpu") for part in (scene.train, scene.test)]
    viewmats, Ks = (torch.cat([getattr(part, name) for part in parts]) for name in ("viewmats", "Ks"))
    return Cameras(viewmats, Ks, np.concatenate([part.sizes for part in parts]))


def _tables(model: SavedModel, scene: Scene, history: list[Evaluation]) -> str:
    """Curves, the history and the configuration; nothing of a model that is no run's."""
    if not history:
        return ""
    curves = []
    with tempfile.TemporaryDirectory() as folder:
        for name, label in CURVES:
            file = Path(folder) / f"{name}.svg"
            seconds, values = zip(*((entry.train_seconds, getattr(entry, name)) for entry in history), strict=True)
            plot_against_seconds(file, seconds, values, label, scene.name)
            data = base64.b64encode(file.read_bytes()).decode("ascii")
            curves.append(f'<img alt="{escape(label)} against seconds" src="data:image/svg+xml;base64,{data}">')
    header = ("iteration", "training in s", *ERRORS.values(), "Gaussians", "memory in MiB")
    plan = model.folder.read_plan()
    blocks: list[Block] = [Table(header, history_rows(history))]
    if plan is not None:
        decided = [(entry.setting, entry.text, entry.made, entry.reason) for entry in plan.decisions]
        blocks += [Heading("Plan"), Table(("setting", "value", "made", "reason"), decided, numeric=False)]
    settings = f"<h2>Configuration</h2>\n<pre>{escape(_settings(model.config))}</pre>"
    return f'<h2>Error against run time</h2>\n<div class="curves">{"".join(curves)}</div>\n{_html(blocks)}\n{settings}'


def _settings(config: Config) -> str:
    """The run's YAML. Of paths on this machine only the last part is handed over."""
    shown = copy.deepcopy(config)
    shown.scene.path = Path(config.scene.path).name
    shown.train.init = Path(config.train.init).name  # "points" and "random" stay as they are
    if config.report.lpips_weights is not None:
        shown.report.lpips_weights = Path(config.report.lpips_weights).name
    return shown.to_yaml().rstrip()
