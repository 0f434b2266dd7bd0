"""`turbogs reconstruct` and `turbogs demo`, which write captures to train on."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg


def reconstruct(photos: Annotated[Positional[Path], arg(metavar="PHOTOS")], /, *, out: Path) -> int:
    """Find the cameras of photos alone, and write a capture to train on. The same call goes on where it stopped.

    Args:
        photos: folder of at least three photos of one scene.
        out: new folder for the capture, with images and sparse/0 (COLMAP).
    """
    from turbogs_plugin.reconstruct import reconstruct

    print(reconstruct(photos, out).text())
    return 0


def demo(path: Positional[Path], /) -> int:
    """Write a small synthetic capture to try things on: a textured scene as a COLMAP dataset.

    Args:
        path: new folder.
    """
    from turbogs_plugin.captures import write_demo_capture

    print(f"capture  {write_demo_capture(path)}")
    return 0
