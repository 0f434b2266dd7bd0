"""Files of strangers, damaged for some minutes: `python tests/stability/fuzz_files.py SECONDS`, tests/ on the path.

Each goes to its reader in a process of its own, which may take `SECONDS_A_FILE` and `MEMORY`, and ends in a result or
in one `InputError`. A file that does anything else is kept and named. Prints the files of each kind, and the longest
time and the largest memory.
"""

from __future__ import annotations

import gzip
import io
import json
import os
import random
import resource
import signal
import sys
import tempfile
import time
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import torch
from helpers.bounded_memory import damaged
from helpers.framework_runs import tiny_capture, tiny_config
from helpers.models import random_gaussians
from test_readers import with_another

from turbogs_plugin.captures import load_scene
from turbogs_plugin.errors import InputError
from turbogs_plugin.model.formats import FORMATS
from turbogs_plugin.scene import Frame
from turbogs_plugin.study.results import StudyFolder
from turbogs_plugin.study.runs import study_of_runs
from turbogs_plugin.study.study_report import write_report
from turbogs_plugin.train import run
from turbogs_plugin.train.run_files import RunFolder
from turbogs_plugin.train.saved_model import load_model, read_given

SECONDS_A_FILE, MEMORY = 20, 2 << 30


def unzipped(content: bytes, choice: random.Random) -> bytes:
    """A .spz whose unpacked numbers are damaged."""
    return gzip.compress(damaged(gzip.decompress(content) or b"0", choice))


def rezipped(content: bytes, choice: random.Random) -> bytes:
    """A .pt whose pickled values are damaged, and that is a whole archive."""
    with zipfile.ZipFile(io.BytesIO(content)) as source, zipfile.ZipFile(made := io.BytesIO(), "w") as target:
        for name in source.namelist():
            part = source.read(name)
            target.writestr(name, damaged(part or b"0", choice) if name.endswith(".pkl") else part)
    return made.getvalue()


def other_json(content: bytes, choice: random.Random) -> bytes:
    return json.dumps(with_another(json.loads(content), choice)).encode()


Change = Callable[[bytes, random.Random], bytes]


def kinds(folder: Path) -> dict[str, tuple[Path, Callable[[], object], list[Change]]]:
    """Kind -> the file, what reads it, and how it is damaged."""
    capture = tiny_capture(folder)
    place = run.train(tiny_config(capture, "train.iterations=2"), folder / "run").folder
    models = {kind: folder / f"model.{kind}" for kind in FORMATS}
    for kind, file in models.items():
        FORMATS[kind][0](random_gaussians(200, sh_degree=1), file, Frame(torch.zeros(3).numpy(), 1.0), 0, False)
    frames = [
        {"file_path": f"images/{file.name}", "transform_matrix": torch.eye(4).tolist()}
        for file in sorted((capture / "images").iterdir())
    ]
    transforms = folder / "frames"
    transforms.mkdir()
    (transforms / "images").symlink_to(capture / "images")
    (transforms / "transforms.json").write_text(json.dumps({"fl_x": 40.0, "k1": 0.01, "frames": frames}))
    photo = sorted((capture / "images").iterdir())[1]
    (capture / "masks").mkdir()
    mask = capture / "masks" / photo.name
    mask.write_bytes(photo.read_bytes())
    checkpoint, study = next(place.checkpoints.glob("*.pt")), StudyFolder(folder / "study")
    study.write_study(study_of_runs([place.path]))
    scene = lambda of=capture: load_scene(of)  # noqa: E731
    return {
        **{kind: (file, lambda file=file: read_given(file), [damaged]) for kind, file in models.items()},
        "unpacked .spz": (models["spz"], lambda: read_given(models["spz"]), [unzipped]),
        "values of .pt": (models["pt"], lambda: read_given(models["pt"]), [rezipped]),
        "checkpoint": (checkpoint, lambda: load_model(place.path, torch.device("cpu")), [damaged, rezipped]),
        "config.yaml": (place.config, lambda: RunFolder(place.path).read_config(True), [damaged]),
        "results.json": (study.file, lambda: study.read_study().results and write_report(study), [damaged, other_json]),
        **{
            f"{name}.bin": (capture / "sparse/0" / f"{name}.bin", scene, [damaged])
            for name in ("cameras", "images", "points3D", "frames")
        },
        "transforms.json": (transforms / "transforms.json", lambda: scene(transforms), [damaged, other_json]),
        "photo": (photo, scene, [damaged]),
        "mask": (mask, scene, [damaged]),
    }


def outcome(read: Callable[[], object]) -> tuple[str, float, int]:
    """What came of a reader in a process of its own, its seconds and its bytes."""
    began, process = time.monotonic(), os.fork()
    if not process:
        signal.alarm(SECONDS_A_FILE)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        sys.stderr = io.StringIO()
        try:
            read()
            os._exit(0)
        except InputError as error:
            os._exit(2 if "\n" not in str(error) else 3)
        except BaseException:
            os._exit(4)
    _, status, usage = os.wait4(process, 0)
    taken = time.monotonic() - began, usage.ru_maxrss * 1024
    code = os.waitstatus_to_exitcode(status)
    words = {0: "read", 2: "refused"}.get(code, f"ended by {code}")
    return (words if taken[1] < MEMORY else "too large"), *taken


def main(seconds: float) -> None:
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    folder, choice, counts = Path(tempfile.mkdtemp(prefix="fuzz-")), random.Random(time.time_ns()), {}
    files, end, longest, largest = kinds(folder), time.monotonic() + seconds, 0.0, 0
    while time.monotonic() < end:
        kind, (file, read, changes) = choice.choice(list(files.items()))
        intact = content = file.read_bytes()
        change = choice.choice(changes)
        for _ in range(choice.choice((1, 1, 2, 4))):
            content = change(content or intact, choice)
        file.write_bytes(content)
        said, took, size = outcome(read)
        if said not in ("read", "refused"):
            kept = folder / f"{said} {len(counts)} {time.time_ns()} {file.name}"
            kept.write_bytes(content)
            print(f"{kind}: {said}, {took:.1f} s: {kept}", flush=True)
        file.write_bytes(intact)
        counts.setdefault(kind, {}).setdefault(said, []).append(1)
        longest, largest = max(longest, took), max(largest, size)
    for kind, of_kind in counts.items():
        print(kind, {said: len(each) for said, each in of_kind.items()})
    total = sum(len(each) for of_kind in counts.values() for each in of_kind.values())
    print(f"{total} files, {longest:.1f} s, {largest >> 20} MiB")


if __name__ == "__main__":
    main(float(sys.argv[1]))
