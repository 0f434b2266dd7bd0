"""The page on scaling has the tables that its model prints; measurements are printed beside the predictions."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from turbogs_plugin.bench.ranks import line_of
from turbogs_plugin.train.history import Evaluation, append_evaluation

ROOT = Path(__file__).resolve().parents[2]


def test_the_page_has_what_the_model_prints():
    printed = subprocess.run(
        [sys.executable, ROOT / "docs/scaling_model.py"], capture_output=True, text=True, check=True
    ).stdout
    page = (ROOT / "docs/scaling.md").read_text()
    tables = printed.strip().split("\n\n")
    assert len(tables) == 7
    for table in tables:
        assert table in page, f"docs/scaling.md is older than its model: {table.splitlines()[0]}"


def test_results_are_printed_as_they_come(tmp_path):
    """From lines of a bench that was cut short, whole runs and the ends of a study's cells."""
    passes = [(1, 10, 1.0, "none", 3.5), (2, 10, 1.0, "owners of rows", 2.5), (2, 10, 1.0, "records to all", 3.0)]
    lines = [
        line_of(
            {"gpus": gpus, "gaussians": 600_000, "views": views, "pixel_budget": images, "exchange": exchange}
            | {"wall": {"median_ms": time}, "parts_ms_of_ranks": {"draw": [0.1]}}
        )
        for gpus, views, images, exchange, time in [*passes, (2, 20, 2.0, "owners of rows", 5.0)]
    ]
    (tmp_path / "ranks.txt").write_text("\n".join(lines))
    for name, seconds in (("one-0", 4.0), ("two-0", 3.0), ("batch-0", 2.0)):
        run = tmp_path / "runs" / name
        run.mkdir(parents=True)
        for place, psnr in enumerate((20.0, 30.0, 31.0)):
            line = Evaluation(place, place * seconds, psnr, 0.9, 0.1, 1000 + place, 0)
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
        "| 600k, K = 10, 2 GPUs, owners of rows | 2.50 ms, 1.40x | 2.68 ms, 1.28x |",
        "| 600k, K = 10, 2 GPUs, records to all | 3.00 ms, 1.17x | 3.09 ms, 1.11x |",
        "| 600k, K = 20, 2 times the batch, 2 GPUs, owners of rows | 5.00 ms, 1.40x | 4.87 ms, 1.41x |",
        "600k, K = 10: 1.40 times one GPU, wanted at least 1.3: reached",
        "| one-0 | 8.00 s | 7.00 s | 6.00 s | 4.00 s | 8.00 s | 31.00 dB | 0.9000 | 1002 | 2 |",
        "two, 1 seeds: 1.33, 1.33, 1.33, 1.33 times as soon as one GPU; PSNR 31.00 where one GPU has 31.00 [31.00,",
        "study on GPUs 0: 6.0 cells a minute",
        "two GPUs: 2.00 times one (wanted: 1.9)",
    ):
        assert expected in printed, (expected, printed)
    for partial in (tmp_path / "ranks.txt", *tmp_path.glob("runs/*/history.jsonl")):
        partial.unlink()
    again = [sys.executable, ROOT / "docs/scaling_results.py", tmp_path]
    assert "no run has ended" in subprocess.run(again, capture_output=True, text=True, check=True).stdout
