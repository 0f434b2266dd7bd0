"""Measurements of several GPUs are printed beside the predictions."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from turbogs_plugin.bench.ranks import line_of
from turbogs_plugin.train.history import Evaluation, append_evaluation

ROOT = Path(__file__).resolve().parents[2]


def test_results_are_printed_as_they_come(tmp_path):
    """From lines of a bench that was cut short, whole runs and the ends of a study's cells."""
    owners, to_all = "owners of rows, in place", "records to all, messages"
    passes = [(1, 10, 1.0, "none", 3.5), (2, 10, 1.0, owners, 2.5), (2, 10, 1.0, to_all, 3.0)]
    lines = [
        line_of(
            {"gpus": gpus, "gaussians": 600_000, "views": views, "pixel_budget": images, "exchange": exchange}
            | {"wall": {"median_ms": time}, "parts_ms_of_ranks": {"draw": [0.1]}}
        )
        for gpus, views, images, exchange, time in [*passes, (2, 20, 2.0, owners, 5.0)]
    ]
    (tmp_path / "ranks.txt").write_text("\n".join(lines))
    for name, seconds in (("one-0", 4.0), ("two-0", 3.0), ("batch-0", 2.0)):
        run = tmp_path / "runs" / name
        run.mkdir(parents=True)
        for place, psnr in enumerate((20.0, 30.0, 31.0)):
            line = Evaluation(place, place * seconds, psnr, 0.9 + place / 100, 0.1, 1000 + place, 0)
            append_evaluation(run / "history.jsonl", line)
    for gpus, ends in (("0", range(0, 60, 10)), ("0,1", (0, 1, 10, 11, 20, 21))):
        for cell, end in enumerate(ends):
            file = tmp_path / f"study-{gpus}/cells/scene/turbogs--seed{cell}.json"
            file.parent.mkdir(parents=True, exist_ok=True)
            file.touch()
            os.utime(file, (1e9 + end, 1e9 + end))
    printed = subprocess.run(
        [sys.executable, ROOT / "docs/scaling_results.py", tmp_path], capture_output=True, text=True, check=True
    ).stdout
    for expected in (
        "| 600k, K = 10, 2 GPUs, owners of rows, in place | 2.50 ms, 1.40x | 2.56 ms, 1.62x |",
        "| 600k, K = 10, 2 GPUs, records to all, messages | 3.00 ms, 1.17x | 3.44 ms, 1.21x |",
        "| 600k, K = 20, 2 times the batch, 2 GPUs, owners of rows, in place | 5.00 ms, 1.40x | 4.91 ms, 1.69x |",
        "600k, K = 10: 1.40 times one GPU, wanted at least 1.3: reached",
        "| one-0 | 8.00 s | 7.00 s | 6.00 s | 4.00 s | 8.00 s | 7.20 s | 6.00 s | 4.00 s | 8.00 s | 31.00 dB |",
        "| two GPUs (1) | 1.33x | 1.33x | 1.33x | 1.33x | 1.33x | 1.33x | 1.33x | 1.33x | 1.33x | +0.00 dB | +0.0000 |",
        "A study on GPUs 0: 6.0 cells a minute.",
        "2 GPUs: 2.00 times one (wanted: 1.9).",
    ):
        assert expected in printed, (expected, printed)
    kept = tmp_path / "kept"
    kept.mkdir()
    (tmp_path / "scaling.json").rename(kept / "scaling.json")
    again = [sys.executable, ROOT / "docs/scaling_results.py", kept]
    from_file = subprocess.run(again, capture_output=True, text=True, check=True).stdout
    assert printed.endswith(from_file.partition("| run |")[2]), "what is kept says the same"
    for partial in (tmp_path / "ranks.txt", *tmp_path.glob("runs/*/history.jsonl")):
        partial.unlink()
    again = [sys.executable, ROOT / "docs/scaling_results.py", tmp_path]
    assert "no run has ended" in subprocess.run(again, capture_output=True, text=True, check=True).stdout


STAND_IN = """#!/bin/sh
# In the place of Python: runs, a bench and studies that take no time. The second seed's runs on two GPUs fail. Results
# are printed as the last run is there, and named before.
case "$*" in
docs/*) [ -d "$2/runs/batch-2" ] && exec PYTHON "$@"; echo "$@ with $(ls "$2/runs")" ;;
*" train "*--gpus\\ 2*train.seed=1*) echo "turbogs: error: lost" >&2; exit 1 ;;
*" train "*)
    mkdir -p "$6" && echo large >"$6/model.ply"
    echo '{"iteration": 5, "train_seconds": 2.0, "psnr": 30.0, "ssim": 0.9, "l1": 0.1, "num_gaussians": 7,' \\
        '"memory_bytes": 0}' >"$6/history.jsonl" ;;
*" bench ranks "*) echo "1 GPU  M=600000 K=10 lambda=1 (none): 3.400 ms; draw 0.10"; exit 1 ;;
*" ablate "*) mkdir -p "${21}/cells/scene"; touch "${21}/cells/scene/a.json" ;;
esac
"""


def test_the_script_goes_on_whatever_fails_and_leaves_out_what_has_no_time(tmp_path):
    python = tmp_path / "python"
    python.write_text(STAND_IN.replace("PYTHON", sys.executable))
    python.chmod(0o755)
    variables = {**os.environ, "PYTHON": str(python), "SCRATCH": str(tmp_path / "scratch")}
    command = ["sh", "docs/measure_scaling.sh", str(tmp_path / "out"), "fox", "caliterra", "cpu"]
    ended = subprocess.run(command, cwd=ROOT, env=variables, capture_output=True, text=True)
    stages = (tmp_path / "out/stages.txt").read_text()
    names = [line.split()[2].rstrip(":") for line in stages.splitlines()]
    runs = [[f"run-{kind}-{seed}" for kind in ("one", "two", "batch")] for seed in "012"]
    assert names == ["machine", "ranks", *runs[0], "study-0", "study-0,1", *runs[1], *runs[2]], ended.stderr
    failed = [line for line in stages.splitlines() if line.endswith("exit code 1")]
    assert len(failed) == 3 and "turbogs: error: lost" in ended.stdout
    results = (tmp_path / "out/results.txt").read_text()
    assert "| 600k, K = 10, 1 GPU | 3.40 ms, 1.00x |" in results and results in ended.stdout
    assert "| two GPUs (2) | " in results and "| one-2 | " in results
    assert not (tmp_path / "scratch").exists() and not list((tmp_path / "out").rglob("model.ply"))
    none = subprocess.run(
        [*command[:2], str(tmp_path / "none"), *command[3:]], cwd=ROOT, env={**variables, "WITHIN": "9"}
    )
    assert none.returncode == 0
    assert (tmp_path / "none/stages.txt").read_text().count("left out") == 12
