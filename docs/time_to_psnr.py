"""Prints when runs reached the test PSNR that all of them reach, and what they ended with.

python docs/time_to_psnr.py RUN RUN ...
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from turbogs_plugin.train.history import read_history


def main() -> None:
    histories = {path: read_history(path / "history.jsonl") for path in map(Path, sys.argv[1:])}
    wanted = min(max(line.psnr for line in history) for history in histories.values())
    for path, history in histories.items():
        best = np.maximum.accumulate([line.psnr for line in history])
        seconds = np.interp(wanted, best, [line.train_seconds for line in history])
        final = history[-1]
        print(
            f"{path.name}: {wanted:.2f} dB after {seconds:.2f} s; {final.psnr:.2f} dB, SSIM {final.ssim:.4f} with "
            f"{final.num_gaussians} Gaussians after {final.iteration} iterations, {final.train_seconds:.2f} s"
        )


if __name__ == "__main__":
    main()
