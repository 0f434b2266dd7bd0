"""The page on scaling has the tables that its model prints."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

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
