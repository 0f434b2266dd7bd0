"""What `turbogs export` and the films of `turbogs render` do."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.errors import InputError
from turbogs_plugin.export.contribution import contributions, pruned
from turbogs_plugin.export.fidelity import Change, Fidelity
from turbogs_plugin.export.film import film_cameras, require_film, write_film
from turbogs_plugin.files import require_new_file
from turbogs_plugin.model.formats import FORMATS
from turbogs_plugin.model.harmonics import band_energy, drop_faint_bands
from turbogs_plugin.model.similarity import Similarity
from turbogs_plugin.train.saved_model import load_with_capture
from turbogs_plugin.train.start import resolve_device
from turbogs_plugin.types import Gaussians

PAGE = "html"
"""The name of the page with everything in it, which is no format of models."""


@dataclass(frozen=True)
class Exported:
    """What was written, beside the model that it was made of.

    Args:
        file: the new one.
        bytes, gaussians: of the file.
        held_bytes, of: bytes of the model in float32, and its Gaussians.
        change: what the model lost; None where that was not measured.
        unmeasured: why; empty where it was.
        notes: what was left out on purpose.
    """

    file: Path
    bytes: int
    gaussians: int
    held_bytes: int
    of: int
    change: Change | None
    unmeasured: str = ""
    notes: tuple[str, ...] = ()

    def text(self) -> str:
        """Three lines: the file, sizes, and what was lost."""
        notes = f" ({'; '.join(self.notes)})" if self.notes else ""
        size = f"{self.held_bytes:,} bytes in float32 -> {self.bytes:,} bytes in the file"
        lost = f"PSNR   not measured: {self.unmeasured}" if self.change is None else self.change.text()
        return f"{self.file}{notes}\nsize   {size}, {self.gaussians} of {self.of} Gaussians\n{lost}"


def export_run(
    path: Path,
    file_format: str,
    out: Path | None,
    drop_bands: float | None = None,
    max_gaussians: int | None = None,
    given: Config | None = None,
) -> Exported:
    """Write a run's newest model or a given one, read it again, and compare.

    Args:
        path: folder of the run, or the file of a model.
        file_format: one of `FORMATS`, or `PAGE`: all of the run on one page.
        out: new file; None: beside the model in the run's folder.
        drop_bands: threshold of `drop_faint_bands`; None: all bands are written.
        max_gaussians: keep at most so many, those that add most to the training views.
        given: the capture of a model from a file, and how to render it; None: `path` is a run.
    """
    if file_format not in (*FORMATS, PAGE):
        known = ", ".join((*FORMATS, PAGE))
        raise InputError(f"--format {file_format}: there is no such format; choose one of {known}")
    if drop_bands is not None and not 0 <= drop_bands < 1:
        raise InputError(f"--drop-bands {drop_bands}: it must be a share, at least 0 and less than 1")
    if max_gaussians is not None and max_gaussians < 1:
        raise InputError(f"--max-gaussians {max_gaussians}: it must be at least 1")
    if out is not None:
        require_new_file(out, "--out")
        ending = PAGE if file_format == PAGE else FORMATS[file_format].suffix.rpartition(".")[2]
        if out.suffix.lower() != f".{ending}":
            raise InputError(f"--out '{out}': --format {file_format} needs a name that ends in .{ending}")
    if given is not None and out is None:
        raise InputError(f"'{path}' has no run's folder to export into: name a new file by --out")
    changed = "--max-gaussians" if max_gaussians is not None else "--drop-bands" if drop_bands is not None else ""
    if changed and out is None and file_format == "ply":
        raise InputError(f"{changed} would take the place of the run's own model.ply: name a new file by --out")
    needed = max_gaussians is not None or file_format == PAGE
    model, scene, absent = load_with_capture(path, given, resolve_device("auto"), needed)
    gaussians = whole = model.gaussians
    if max_gaussians is not None and max_gaussians < len(gaussians):
        gaussians = pruned(gaussians, contributions(gaussians, scene.train.cameras, model.config.raster), max_gaussians)
    kept = gaussians if drop_bands is None else drop_faint_bands(gaussians, drop_bands)
    notes = _notes(whole, gaussians, kept, drop_bands)
    if file_format == PAGE:
        from turbogs_plugin.export.page import write_page

        if not len(scene.test):
            raise InputError("--format html shows test views, and the capture has none")
        file = model.folder.path / "report.html" if out is None else out
        (count, change), reason = write_page(model, kept, scene, file), ""
    else:
        file = model.folder.model.with_suffix(FORMATS[file_format].suffix) if out is None else out
        FORMATS[file_format].write(kept, file, model.frame, model.iteration or 0)
        read = Similarity.into(model.frame).apply(FORMATS[file_format].read(file)).map(torch.Tensor.float)
        count = len(read)
        reason = absent or ("" if len(scene.test) else "the capture has no test views")
        change = None if reason else Fidelity(whole, scene.test, model.own_look(scene.test)).change(read)
    held = sum(value.numel() * 4 for _, value in whole.items())
    return Exported(file, file.stat().st_size, count, held, len(whole), change, reason, notes)


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
    model, scene, _ = load_with_capture(path, given, resolve_device(device_name))
    write_film(model.gaussians, model.own_look(scene.train), film_cameras(camera_path, scene, seconds), video)
    return video


def _notes(whole: Gaussians, kept: Gaussians, written: Gaussians, drop_bands: float | None) -> tuple[str, ...]:
    """What was left out."""
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
    return tuple(notes)
