"""Makes README's picture of `make demo` from the run that this trains:

    python docs/demo_picture.py RUN FILE.png

Photo, render and error of the first two test views, as the run's report has them, twice as large.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from turbogs_plugin.report.images import GAP

VIEWS = 2
SCALE = 2


def main() -> None:
    run, file = map(Path, sys.argv[1:])
    strips = [np.asarray(Image.open(path)) for path in sorted((run / "report").glob("test-*.jpg"))[:VIEWS]]
    gap = np.full((GAP, strips[0].shape[1], 3), 255, dtype=np.uint8)
    pixels = np.concatenate([part for strip in strips for part in (strip, gap)][:-1])
    Image.fromarray(pixels.repeat(SCALE, axis=0).repeat(SCALE, axis=1)).save(file, optimize=True)


if __name__ == "__main__":
    main()
