"""The compiled CUDA library: where it is, and whether it can be used here. Importing this file never fails."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import torch

from turbogs_plugin.engine import layout
from turbogs_plugin.engine.cuda import launches
from turbogs_plugin.errors import InputError

LIBRARY_VARIABLE = "TURBOGS_LIBRARY"
"""Environment variable with the path of another build of the library, to compare builds."""

FIRST_TORCH = (2, 10)
"""The library uses the stable interface of this version of torch."""


OLDEST_CAPABILITY = (8, 0)
"""GPUs before this lack an instruction that the kernels use."""


def library_path() -> Path:
    """Where the library should be, whether or not it is there."""
    named = os.environ.get(LIBRARY_VARIABLE)
    return Path(named) if named else Path(__file__).parents[2] / "_C.abi3.so"


@lru_cache(maxsize=1)
def _load_failure() -> str:
    """Load the library once. Returns "" on success, else the reason in one line."""
    path = library_path()
    if not path.is_file():
        return f"{path.name} is not built (TURBOGS_CUDA=require pip install --no-build-isolation . says why)"
    version = tuple(int(part) for part in re.findall(r"\d+", torch.__version__)[:2])
    if version < FIRST_TORCH:
        return f"the library needs torch >= {'.'.join(map(str, FIRST_TORCH))}, this is {torch.__version__}"
    try:
        torch.ops.load_library(str(path))
    except OSError as error:
        return f"{path.name} does not load: {str(error).splitlines()[0]}"
    if _interface() != layout.interface(launches.LAUNCHES):
        return f"{path.name} was built from other sources than this package: build it again"
    return ""


def _interface() -> str:
    """The order of fields and the sizes that the loaded library was built with, as text."""
    tell = getattr(torch.ops.turbogs, "interface", None)  # older libraries have none
    return "" if tell is None else tell()


def _runs_on(architecture: str, capability: tuple[int, int]) -> bool:
    """Whether code of this name (``sm_90``, ``sm_90a``, PTX: ``compute_90``) runs on a GPU of this capability."""
    match = re.fullmatch(r"(sm|compute)_(\d+)(\d)([af]?)", architecture)
    if match is None:
        return False
    kind, major, minor, kin = match.groups()
    built = int(major), int(minor)
    if kin == "a":  # only for that GPU
        return built == capability
    if kind == "compute" and not kin:
        return built <= capability
    return built[0] == capability[0] and built[1] <= capability[1]


def _mismatch(architectures: tuple[str, ...], capability: tuple[int, int]) -> str:
    """Why a library of these architectures has no code for such a GPU, in one line; "" if it has."""
    if any(_runs_on(architecture, capability) for architecture in architectures):
        return ""
    present = "{}{}".format(*capability)
    if capability < OLDEST_CAPABILITY:
        return f"this GPU is sm_{present}: the kernels need compute capability 8.0 or newer"
    return f"built for {', '.join(architectures)}, this GPU is sm_{present}: rebuild with TURBOGS_CUDA_ARCH={present}"


@lru_cache(maxsize=1)
def unavailable_reason() -> str:
    """Why the kernels cannot run here, in one line; "" if they can. The GPU is torch's current one."""
    if failure := _load_failure():
        return failure
    if not torch.cuda.is_available():
        return "torch sees no CUDA device"
    return _mismatch(architectures(), torch.cuda.get_device_capability())


def available() -> bool:
    """The library is loaded, torch sees a CUDA device, and the library has code for it."""
    return not unavailable_reason()


def require() -> None:
    """Load the library.

    Raises:
        InputError: the kernels cannot run here.
    """
    if reason := unavailable_reason():
        raise InputError(f"CUDA kernels: {reason}")


class _Operators:
    """The library's operators as attributes, each kept: to look one up for each launch takes a third of the call."""

    def __getattr__(self, name: str) -> Callable[..., None]:
        operator = getattr(torch.ops.turbogs, name).default  # the only overload
        setattr(self, name, operator)
        return operator


operators = _Operators()
"""What `launch` calls. A recorder of launches puts its own functions here."""


def launch(arguments: launches.Launch) -> None:
    """Call the operator of a launch. It is enqueued on torch's current stream of its tensors' device.

    Raises:
        RuntimeError: the operator does not accept a tensor; the message names it.
    """
    getattr(operators, arguments.operator)(*arguments.lists())


def architectures() -> tuple[str, ...]:
    """What the library holds code for: ``sm_90``, ..., or PTX, ``compute_90``. Empty if it is not loaded."""
    return () if _load_failure() else tuple(torch.ops.turbogs.architectures().split())
