"""FLIP: the difference a viewer sees when two pictures take turns (Andersson et al. 2020), by its authors' library.

It runs on the CPU and takes about 1.7 s a megapixel on one core, so only `turbogs eval` and the end of a study's cell
compute it: a run's wall clock does not pay for it. The library holds Python's lock and gains little from many threads,
so several views are compared at a time, each by a process of its own. These import this module: it does without torch.
"""

from __future__ import annotations

import importlib.util
import math
import os
import signal
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from functools import lru_cache
from multiprocessing import get_context
from threading import BoundedSemaphore
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from torch import Tensor

FLIP_PACKAGE = "flip_evaluator"

PIXELS_PER_DEGREE = 67.0
"""How far off a viewer is thought to be: the paper's 0.7 m before a 4K screen 0.7 m wide."""

CORES_EACH = 2
"""Threads of the library in each process."""

SMALL_PIXELS = 1 << 17
"""Smaller pictures are compared in this process, sooner than another one begins."""

Flip = Callable[["Tensor", "Tensor"], "Future[float]"]
"""Mean FLIP of an image against a photo, both [H, W, 3], 0 .. 1: 0 for equal ones, below 1."""


def load_flip() -> tuple[Flip | None, str]:
    """FLIP, if its package is installed: the function, or None; and the reason for None."""
    if importlib.util.find_spec(FLIP_PACKAGE) is None:
        return None, 'flip-evaluator is not installed; pip install "turbogs-plugin[flip]"'
    return flip, ""


def flip(image: Tensor, photo: Tensor) -> Future[float]:
    """Mean FLIP of an image against a photo, both [H, W, 3] float, 0 .. 1, in sRGB; NaN if a value is not finite.

    It waits only where as many pictures are under way already as the processes can hold.
    """
    if not (image.isfinite().all() and photo.isfinite().all()):  # the library calls these equal
        return _known(math.nan)
    arrays = [np.ascontiguousarray(picture.detach().cpu().numpy(), dtype=np.float32) for picture in (photo, image)]
    from turbogs_plugin.device import processor_cores

    workers = processor_cores() // CORES_EACH
    if workers < 2 or image[..., 0].numel() < SMALL_PIXELS:
        return _known(_mean_flip(*arrays))
    pool, room = _processes(workers)
    room.acquire()
    result = pool.submit(_mean_flip, *arrays)
    result.add_done_callback(lambda _: room.release())
    return result


def _known(value: float) -> Future[float]:
    result: Future[float] = Future()
    result.set_result(value)
    return result


@lru_cache(maxsize=1)
def _processes(count: int) -> tuple[ProcessPoolExecutor, BoundedSemaphore]:
    """Processes that end with this one, and room for the pictures of twice as many."""
    return ProcessPoolExecutor(count, get_context("spawn"), _begin), BoundedSemaphore(2 * count)


def _begin() -> None:
    """In each process: Ctrl-C is for the first one."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ["OMP_NUM_THREADS"] = str(CORES_EACH)  # read when the library is imported


def _mean_flip(photo: np.ndarray, image: np.ndarray) -> float:
    from flip_evaluator import evaluate

    settings = {"ppd": PIXELS_PER_DEGREE}
    _, mean, _ = evaluate(
        photo, image, "LDR", inputsRGB=True, applyMagma=False, computeMeanError=True, parameters=settings
    )
    return float(mean)
