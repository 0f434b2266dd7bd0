"""The machine and the software that a result depends on, in words."""

from __future__ import annotations

import importlib.util
import platform
import shlex
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch

from turbogs_plugin import __version__
from turbogs_plugin.device import processor_cores

PACKAGES = ("torch", "gsplat", "numpy", "pycolmap")


def software() -> list[tuple[str, str]]:
    """(name, version) of what a result depends on."""
    versions = [("turbogs-plugin", __version__), ("Python", platform.python_version())]
    for package in PACKAGES:
        try:
            versions.append((package, version(package)))
        except PackageNotFoundError:
            versions.append((package, "not installed"))
    return [*versions, ("CUDA of torch", torch.version.cuda or "none")]


def hardware(device: str) -> str:
    """The machine in words."""
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
    """What to do where Python has to compile all of torch each time that a command begins; empty where it has not."""
    if Path(importlib.util.cache_from_source(torch.__file__)).is_file():
        return ""
    packages = shlex.quote(str(Path(torch.__file__).parents[1]))
    return (
        "bytecode of torch: every command compiles it anew, for seconds; make it once by  "
        f"{shlex.quote(sys.executable)} -m compileall -q -j 0 {packages}"
    )
