"""What this installation has and lacks."""

from __future__ import annotations

import importlib.util
import shlex
import shutil
from importlib.metadata import PackageNotFoundError, version

import torch
from packaging.requirements import Requirement

from turbogs_plugin.engine import library
from turbogs_plugin.report.evaluation import LPIPS_PACKAGES
from turbogs_plugin.report.provenance import hardware, missing_bytecode, software
from turbogs_plugin.viewer.server import INSTALL as INSTALL_VIEWER

REQUIREMENTS = "pycolmap>=4.0 filelock>=3.12 scipy>=1.10 trimesh>=4.0 tyro>=1.0.17,<1.1 matplotlib>=3.8"
"""The extra ``train`` of pyproject.toml. The strategies and the gsplat bridge need none of it."""
COMMAND_PACKAGES = {requirement.partition(">=")[0]: requirement for requirement in REQUIREMENTS.split()}
"""Module -> requirement."""
INSTALL_COMMANDS = f"pip install {shlex.join(REQUIREMENTS.split())}"


def diagnosis() -> str:
    """Versions, devices, kernels and what is missing, for a person to read."""
    missing, usable = [], "not usable"
    if reason := library.unavailable_reason():
        missing.append(f"kernels: {reason}")
    else:
        usable = f"loaded from {library.library_path()}, for {', '.join(library.architectures())}"
    on_gpu = torch.cuda.is_available()
    lines = [f"{name:<16}{version}" for name, version in software()]
    lines += [f"{'machine':<16}{hardware('cuda' if on_gpu else 'cpu')}"]
    count = torch.cuda.device_count() if on_gpu else 0
    for index, gpu in enumerate(map(torch.cuda.get_device_properties, range(count))):
        lines.append(f"{'GPU':<16}{index}: {gpu.name}, sm_{gpu.major}{gpu.minor}, {gpu.total_memory / 2**30:.0f} GiB")
    lines += [f"{'nvcc':<16}{shutil.which('nvcc') or 'not found'}", f"{'kernels':<16}{usable}"]
    if not on_gpu:
        what = "a GPU that answers" if torch.version.cuda else "CUDA in PyTorch"
        missing.append(f"{what}: training runs on the CPU, by the torch reference")
    if reason := missing_bytecode():
        missing.append(reason)
    missing += [f"{name}: LPIPS is not computed" for name in LPIPS_PACKAGES if importlib.util.find_spec(name) is None]
    if importlib.util.find_spec("viser") is None:
        missing.append(f"viser: no live viewer; {INSTALL_VIEWER}")
    if lacking := lacking_packages():
        missing.append(f"{', '.join(lacking)}: commands that need them refuse; {INSTALL_COMMANDS}")
    return "\n".join([*lines, *(f"{'missing':<16}{line}" for line in missing)])


def lacking_packages() -> list[str]:
    """Requirements of the commands that are not met, with the version found where it is too old."""
    lacking = []
    for module, requirement in COMMAND_PACKAGES.items():
        wanted = Requirement(requirement)
        try:
            found = version(wanted.name) if importlib.util.find_spec(module) else None
        except PackageNotFoundError:  # there, but not installed: its version is not known
            continue
        except (ImportError, ValueError):
            found = None
        if found is None:
            lacking.append(wanted.name)
        elif not wanted.specifier.contains(found, prereleases=True):
            lacking.append(f"{requirement} ({found} is installed)")
    return lacking
