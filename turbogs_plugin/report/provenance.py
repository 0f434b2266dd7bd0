"""What a measurement depends on besides its inputs: machine, versions, kernels, commit; and its day."""

from __future__ import annotations

import os
import subprocess
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

from turbogs_plugin.engine import compiled_kernels
from turbogs_plugin.report.machine import hardware, software

COMMIT_VARIABLE = "TURBOGS_COMMIT"
"""Environment variable that names the commit where the sources are a copy without their history."""

MODIFIED = "-modified"
"""End of the commit of sources that differ from it."""


@dataclass
class Provenance:
    """Where a measurement was made and with what.

    Args:
        machine: in words.
        software: name -> version.
        kernels: the CUDA library that ran, or why the torch reference did.
        commit: of the sources, or "" where unknown.
        day: ``2026-11-25``, in UTC, when the process began to measure; "" where it was not recorded.
    """

    machine: str
    software: dict[str, str]
    kernels: str
    commit: str
    day: str = ""


def provenance(device_type: str) -> Provenance:
    """The provenance of results of this process, computed on `cpu` or `cuda`."""
    kernels = compiled_kernels()
    reason = kernels.unavailable if device_type == "cuda" else "the device is the CPU"
    engine = f"{kernels.path.name} for {', '.join(kernels.architectures)}"
    if reason:
        engine = f"none, the torch reference ran: {reason}"
    day = datetime.now(timezone.utc).date().isoformat()
    return Provenance(hardware(device_type), dict(software()), engine, source_commit(), day)


def source_commit() -> str:
    """The commit of these sources, with `MODIFIED` at its end where they differ from it; "" without a history."""
    if named := os.environ.get(COMMIT_VARIABLE):
        return named
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return ""
    describe = ["describe", "--always", "--exclude=*", "--abbrev=12", f"--dirty={MODIFIED}"]
    try:
        result = subprocess.run(["git", "-C", root, *describe], capture_output=True, text=True, timeout=20, check=True)
    except (OSError, subprocess.SubprocessError):
        return ""
    return result.stdout.strip()
