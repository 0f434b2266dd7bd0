"""The compiled CUDA library: where it is, and whether it can be used here. Importing this file never fails."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace

import torch

from turbogs_plugin.engine import layout
from turbogs_plugin.engine.cuda import launches

LIBRARY_VARIABLE = "TURBOGS_LIBRARY"
"""Environment variable with the path of another build of the library, to compare builds."""


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
    try:
        torch.ops.load_library(str(path))
    except OSError as error:
        return f"{path.name} does not load: {str(error).splitlines()[0]}"
    interface = getattr(torch.ops.turbogs, "interface", str)  # older libraries have none
    if interface() != layout.interface(launches.LAUNCHES):
        return f"{path.name} was built from other sources than this package: build it again"
    return ""


def _mismatch(architectures: tuple[str, ...], capability: tuple[int, int]) -> str:
    """Why a library of these architectures has no code for a GPU of this capability, in one line; "" if it has.

    Machine code (``sm_90``) runs on its capability and later ones of its generation, PTX (``compute_90``) on all later.
    Code with a letter (``sm_90a``) counts for its capability alone.
    """
    for kind, number in (architecture.split("_") for architecture in architectures):
        built = divmod(int(number.rstrip("af")), 10)
        later = number.isdigit() and built <= capability and (kind == "compute" or built[0] == capability[0])
        if later or built == capability:
            return ""
    present = "{}{}".format(*capability)
    return f"built for {', '.join(architectures)}, this GPU is sm_{present}: rebuild with TURBOGS_CUDA_ARCH={present}"


@lru_cache(maxsize=1)
def unavailable_reason() -> str:
    """Why the kernels cannot run here, in one line; "" if they can. The GPU is torch's current one."""
    if failure := _load_failure():
        return failure
    if not torch.cuda.is_available():
        return "torch sees no CUDA device"
    for cls in launches.LAUNCHES:
        setattr(operators, cls.operator, getattr(torch.ops.turbogs, cls.operator).default)  # the only overload
    return _mismatch(architectures(), torch.cuda.get_device_capability())


operators = SimpleNamespace()
"""What `launch` calls, by name, once the library is known to run: to look an operator up takes a third of a call. A
recorder of launches puts its own functions here."""


def launch(arguments: launches.Launch) -> None:
    """Call the operator of a launch. It is enqueued on torch's current stream of its tensors' device. Raises
    `RuntimeError`: the operator does not accept a tensor; the message names it."""
    getattr(operators, arguments.operator)(*arguments.lists())


def architectures() -> tuple[str, ...]:
    """What the library holds code for: ``sm_90``, ..., or PTX, ``compute_90``. Empty if it is not loaded."""
    return () if _load_failure() else tuple(torch.ops.turbogs.architectures().split())
