"""Writes a run's model in every format, as one page and as a film, and records what that takes and what is lost:

    python docs/measure_exports.py RUN FOLDER

FOLDER is new. From docs/results/h200/, `make pages` shows its exports.json in docs/formats.md. Seconds are of the whole
work, the capture's photos read again each time, but for the interpreter's start.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

from turbogs_plugin.export.commands import PAGE, export_run, film_run
from turbogs_plugin.export.film import RATE
from turbogs_plugin.files import write_text_atomically
from turbogs_plugin.model.formats import FORMATS
from turbogs_plugin.report.provenance import provenance
from turbogs_plugin.train.inputs import resolve_device
from turbogs_plugin.train.run_files import RunFolder

FILM_SECONDS = 10.0
Result = TypeVar("Result")


def main() -> None:
    run, folder = Path(sys.argv[1]), Path(sys.argv[2])
    folder.mkdir()
    scene = Path(RunFolder(run).read_config().scene.path).name
    record: dict[str, Any] = {"provenance": asdict(provenance(resolve_device("auto").type)), "scene": scene}
    record["exports"] = {}
    for name in (*FORMATS, PAGE):
        file = folder / f"model{FORMATS[name].suffix if name in FORMATS else '.html'}"
        written, seconds = _timed(lambda name=name, file=file: export_run(run, name, file))
        print(f"{written.text()}\n{seconds:.1f} s", flush=True)
        record |= {"gaussians": written.of, "held_bytes": written.held_bytes}
        change = None if written.change is None else asdict(written.change)
        entry = {"bytes": written.bytes, "gaussians": written.gaussians, "seconds": seconds, "change": change}
        record["exports"][name] = entry
    film, seconds = _timed(lambda: film_run(run, "orbit", folder / "orbit.mp4", FILM_SECONDS, "auto"))
    frames = round(RATE * FILM_SECONDS)
    record["film"] = {"path": "orbit", "frames": frames, "bytes": film.stat().st_size, "seconds": seconds}
    print(record["film"])
    write_text_atomically(folder / "exports.json", json.dumps(record, indent=1) + "\n")


def _timed(work: Callable[[], Result]) -> tuple[Result, float]:
    begun = time.perf_counter()
    return work(), time.perf_counter() - begun


if __name__ == "__main__":
    main()
