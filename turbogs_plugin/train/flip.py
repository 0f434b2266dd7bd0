"""FLIP: the difference a viewer sees when two pictures take turns (Andersson et al. 2020), by its authors' library.

It runs on the CPU and takes about 1.7 s a megapixel on one core, so only `turbogs eval` and the end of a study's cell
compute it: a run's wall clock does not pay for it. The library holds Python's lock and gains little from many threads,
so several views are compared at a time, each by a process that runs this module. So it does without torch.
"""

from __future__ import annotations

import importlib.util
import math
import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache
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

    It waits only where twice as many pictures are under way as there are processes at a time.
    """
    from turbogs_plugin.device import processor_cores

    if not (image.isfinite().all() and photo.isfinite().all()):  # the library calls these equal
        return _known(math.nan)
    pair = [np.ascontiguousarray(picture.detach().cpu().numpy(), dtype=np.float32) for picture in (photo, image)]
    at_a_time = processor_cores() // CORES_EACH
    if at_a_time < 2 or image[..., 0].numel() < SMALL_PIXELS:
        return _known(_mean_flip(*pair))
    threads, room = _threads(at_a_time)
    room.acquire()
    result = threads.submit(_by_process, *pair)
    result.add_done_callback(lambda _: room.release())
    return result


def _known(value: float) -> Future[float]:
    result: Future[float] = Future()
    result.set_result(value)
    return result


@lru_cache(maxsize=1)
def _threads(count: int) -> tuple[ThreadPoolExecutor, BoundedSemaphore]:
    """Threads that wait for a process each, and room for the pictures of twice as many."""
    return ThreadPoolExecutor(count, "flip"), BoundedSemaphore(2 * count)


def _by_process(photo: np.ndarray, image: np.ndarray) -> float:
    height, width, _ = photo.shape
    command = [sys.executable, "-m", "turbogs_plugin.train.flip", str(height), str(width)]
    done = subprocess.run(
        command,
        input=photo.tobytes() + image.tobytes(),
        stdout=subprocess.PIPE,
        env={**os.environ, "OMP_NUM_THREADS": str(CORES_EACH)},
        start_new_session=True,  # Ctrl-C is for the process that waits
        check=True,
    )
    return float(done.stdout)


def _mean_flip(photo: np.ndarray, image: np.ndarray) -> float:
    from flip_evaluator import evaluate

    settings = {"ppd": PIXELS_PER_DEGREE}
    _, mean, _ = evaluate(
        photo, image, "LDR", inputsRGB=True, applyMagma=False, computeMeanError=True, parameters=settings
    )
    return float(mean)


def main() -> None:
    """What such a process does: height and width are its arguments, photo and image come by its input."""
    height, width = map(int, sys.argv[1:])
    given = bytearray(sys.stdin.buffer.read())  # the library wants arrays that could be written to
    print(_mean_flip(*np.frombuffer(given, dtype=np.float32).reshape(2, height, width, 3)))


if __name__ == "__main__":
    main()
