"""What `turbogs export` and the films of `turbogs render` do."""

from __future__ import annotations

from pathlib import Path

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.errors import InputError
from turbogs_plugin.export.contribution import contributions, pruned
from turbogs_plugin.export.fidelity import Fidelity
from turbogs_plugin.export.film import film_cameras, require_film, write_film
from turbogs_plugin.export.formats import FORMATS, PAGE, require_format, written_and_read
from turbogs_plugin.model.harmonics import band_energy, drop_faint_bands
from turbogs_plugin.scene import Scene
from turbogs_plugin.train.saved_model import SavedModel, load_given_model, load_model
from turbogs_plugin.train.start import open_scene, resolve_device
from turbogs_plugin.types import Gaussians


def export_run(
    path: Path,
    file_format: str,
    out: Path | None,
    drop_bands: float | None = None,
    max_gaussians: int | None = None,
    given: Config | None = None,
) -> str:
    """Write a run's newest model or a given one, read it again, and compare; returns in words what was written.

    Args:
        path: folder of the run, or the file of a model.
        file_format: one of `FORMATS`, or `PAGE`: all of the run on one page.
        out: new file; None: beside the model in the run's folder.
        drop_bands: threshold of `drop_faint_bands`; None: all bands are written.
        max_gaussians: keep at most so many, those that add most to the training views.
        given: the capture of a model from a file, and how to render it; None: `path` is a run.
    """
    require_format(file_format)
    if drop_bands is not None and not 0 <= drop_bands < 1:
        raise InputError(f"--drop-bands {drop_bands}: it must be a share, at least 0 and less than 1")
    if max_gaussians is not None and max_gaussians < 1:
        raise InputError(f"--max-gaussians {max_gaussians}: it must be at least 1")
    if out is not None and out.exists():
        raise InputError(f"--out '{out}' exists: choose a new file")
    if out is not None and not out.absolute().parent.is_dir():
        raise InputError(f"--out '{out}': there is no folder '{out.parent}'")
    if given is not None and out is None:
        raise InputError(f"'{path}' has no run's folder to export into: name a new file by --out")
    if max_gaussians is not None and out is None and file_format == "ply":
        raise InputError("--max-gaussians would take the place of the run's own model.ply: name a new file by --out")
    model, scene, absent = _opened(path, given, needed=max_gaussians is not None or file_format == PAGE)
    whole = model.gaussians
    gaussians = whole
    if max_gaussians is not None and max_gaussians < len(gaussians):
        gaussians = pruned(gaussians, contributions(gaussians, scene.train.cameras, model.config.raster), max_gaussians)
    kept = gaussians if drop_bands is None else drop_faint_bands(gaussians, drop_bands)
    notes = _notes(whole, gaussians, kept, drop_bands)
    if file_format == PAGE:
        return _export_page(model, kept, scene, out, notes)
    target = model.folder.model.with_suffix(FORMATS[file_format].suffix) if out is None else out
    read = written_and_read(file_format, kept, target, model.frame, model.iteration or 0)
    lines = [f"{target}{notes}", _size(target.stat().st_size, len(read), whole)]
    if scene is None:
        return "\n".join([*lines, f"PSNR   not measured: {absent}"])
    if not len(scene.test):
        return "\n".join([*lines, "PSNR   not measured: the capture has no test views"])
    change = Fidelity(whole, scene.test, model.sh_degree, model.config.raster).change(read)
    return "\n".join([*lines, change.text()])


def film_run(
    path: Path, camera_path: str, video: Path, seconds: float, device_name: str, given: Config | None = None
) -> Path:
    """Write a film of a run's newest model or of a given one.

    Args:
        path, given: as in `export_run`.
        camera_path: orbit, views, or a file of cameras.
        video: new file.
        seconds: of the film.
        device_name: where to render.
    """
    require_film(camera_path, video, seconds)
    model, scene, _ = _opened(path, given, needed=True, device_name=device_name)
    write_film(model, film_cameras(camera_path, scene, seconds), video)
    return video


def _export_page(model: SavedModel, kept: Gaussians, scene: Scene, out: Path | None, notes: str) -> str:
    from turbogs_plugin.export.page import write_page

    if not len(scene.test):
        raise InputError("--format html shows test views, and the capture has none")
    target = model.folder.path / "report.html" if out is None else out
    written = write_page(model, kept, scene, target)
    size = _size(written.bytes, written.gaussians, model.gaussians)
    return f"{target}{notes}\n{size}\n{written.change.text()}"


def _size(written: int, count: int, whole: Gaussians) -> str:
    """Bytes and Gaussians before and after."""
    held = sum(value.numel() * 4 for _, value in whole.items())
    return f"size   {held:,} bytes in float32 -> {written:,} bytes in the file, {count} of {len(whole)} Gaussians"


def _opened(
    path: Path, given: Config | None, needed: bool, device_name: str = "auto"
) -> tuple[SavedModel, Scene | None, str]:
    """The model on a device, its capture, and why that is None: it is not there, and not `needed`."""
    device = resolve_device(device_name)
    if given is not None:
        return *load_given_model(path, given, device), ""
    model = load_model(path, device)
    try:
        return model, open_scene(model.config, model.folder), ""
    except InputError as error:
        if needed:
            raise
        return model, None, str(error)


def _notes(whole: Gaussians, kept: Gaussians, written: Gaussians, drop_bands: float | None) -> str:
    """In brackets, what was left out."""
    notes = []
    if len(kept) < len(whole):
        notes.append(f"the {len(kept)} of {len(whole)} Gaussians that add most to the training views")
    if drop_bands is not None:
        before, after = kept.sh_degree, written.sh_degree
        if before == after:
            notes.append(f"degree {before} stays: it has {band_energy(kept)[-1]:.2g} of the colours' energy")
        else:
            share = sum(band_energy(kept)[after + 1 :])
            notes.append(f"degree {before} -> {after}, without {share:.2g} of the colours' energy")
    return f" ({'; '.join(notes)})" if notes else ""
