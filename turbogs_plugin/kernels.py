"""The compiled CUDA library: where it is, whether it can be used here, and why not. Importing this never fails."""

from __future__ import annotations

import os
import re
from functools import lru_cache
from pathlib import Path

import torch

from turbogs_plugin.errors import InputError

LIBRARY_VARIABLE = "TURBOGS_LIBRARY"
"""Environment variable that names another build of the library, to compare builds."""

FIRST_TORCH = (2, 10)
"""The library is built on torch's stable interface of this version."""


def library_path() -> Path:
    """Where the library is looked for, whether or not it is there."""
    named = os.environ.get(LIBRARY_VARIABLE)
    return Path(named) if named else Path(__file__).with_name("_C.abi3.so")


@lru_cache(maxsize=1)
def _load_failure() -> str:
    """Load the library once; "" where that went well, else why not, in one line."""
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
    return ""


@lru_cache(maxsize=1)
def unavailable_reason() -> str:
    """Why the kernels cannot run here, in one line; "" where they can."""
    return _load_failure() or ("" if torch.cuda.is_available() else "torch sees no CUDA device")


def available() -> bool:
    """The library is loaded and torch sees a CUDA device."""
    return not unavailable_reason()


def require() -> None:
    """Load the library.

    Raises:
        InputError: the kernels cannot run here.
    """
    if reason := unavailable_reason():
        raise InputError(f"CUDA kernels: {reason}")


def architectures() -> tuple[str, ...]:
    """The architectures (``sm_90``, ...) that the library was built for; none where it is not loaded."""
    return () if _load_failure() else tuple(torch.ops.turbogs.architectures().split())
