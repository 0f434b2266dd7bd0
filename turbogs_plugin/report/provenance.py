"""The conditions of a measurement besides its inputs: machine, versions, kernels, commit and day."""

from __future__ import annotations

import importlib.util
import os
import platform
import shlex
import subprocess
import sys
from dataclasses import dataclass
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch

from turbogs_plugin import __version__
from turbogs_plugin.device import processor_cores
from turbogs_plugin.engine import library

PACKAGES = ("torch", "gsplat", "numpy", "pycolmap")
"""Packages whose versions change results."""
COMMIT_VARIABLE = "TURBOGS_COMMIT"
"""Environment variable that names the commit where the sources are a copy without their history."""
MODIFIED = "-modified"
"""End of the commit's name where the sources differ from it."""


@dataclass
class Provenance:
    """Where a measurement was made and with what."""

    machine: str  # in words
    software: dict[str, str]  # name -> version
    kernels: str  # the CUDA library that ran, or why the torch reference did
    commit: str  # of the sources, or "" where unknown
    day: str = ""  # 2026-11-25, in UTC, when the process began to measure; "" where it was not recorded


def provenance(device_type: str) -> Provenance:
    """The provenance of results of this process, computed on `cpu` or `cuda`."""
    reason = library.unavailable_reason() if device_type == "cuda" else "the device is the CPU"
    built = f"{library.library_path().name} for {', '.join(library.architectures())}"
    engine = f"none, the torch reference ran: {reason}" if reason else built
    day = datetime.now(timezone.utc).date().isoformat()
    return Provenance(hardware(device_type), dict(software()), engine, source_commit(), day)


def software() -> list[tuple[str, str]]:
    """Name and version of the software that a result depends on."""
    versions = [("turbogs-plugin", __version__), ("Python", platform.python_version())]
    for package in PACKAGES:
        try:
            versions.append((package, version(package)))
        except PackageNotFoundError:
            versions.append((package, "not installed"))
    return [*versions, ("CUDA of torch", torch.version.cuda or "none")]


def hardware(device: str) -> str:
    """The machine in words: its processor, and on `cuda` its first GPU."""
    processor = f"{_processor_name()}, {processor_cores()} cores"
    if device != "cuda":
        return processor
    properties = torch.cuda.get_device_properties(0)
    return f"{properties.name} ({properties.total_memory / 2**30:.0f} GiB), {processor}"


def _processor_name() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            names = [line.split(":", 1)[1].strip() for line in file if line.startswith("model name")]
    except OSError:
        names = []
    return names[0] if names else platform.processor() or platform.machine()


def missing_bytecode() -> str:
    """A remedy where Python compiles all of torch each time that a command begins; empty where it does not."""
    if Path(importlib.util.cache_from_source(torch.__file__)).is_file():
        return ""
    command = f"{shlex.quote(sys.executable)} -m compileall -q -j 0 {shlex.quote(str(Path(torch.__file__).parents[1]))}"
    return f"bytecode of torch: every command compiles it anew, for seconds; make it once by  {command}"


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
