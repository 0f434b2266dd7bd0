"""Films of a model: 60 frames a second along a path of cameras, encoded by the ffmpeg of imageio-ffmpeg."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from turbogs_plugin.engine.rendering import render_image
from turbogs_plugin.errors import InputError
from turbogs_plugin.export.camera_path import from_file, orbit, through_views
from turbogs_plugin.files import require_writable
from turbogs_plugin.report.pictures import to_uint8
from turbogs_plugin.scene import Scene
from turbogs_plugin.train.saved_model import SavedModel
from turbogs_plugin.types import Cameras

RATE = 60
"""Frames a second."""
PATHS = ("orbit", "views")
SUFFIXES = (".mp4", ".mkv", ".mov")
CODEC = "libx264"
"""Of H.264, which all of these hold; named, because imageio-ffmpeg would try others first."""
INSTALL = 'pip install "turbogs-plugin[video]"'
QUALITY = 8
"""Of imageio-ffmpeg, 0 .. 10."""


def require_film(path: str, video: Path, seconds: float) -> None:
    """Raise `InputError`, before anything is loaded, where a film cannot be made."""
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        raise InputError(f"--video needs imageio-ffmpeg: {INSTALL}")
    if not 0 < seconds <= 3600:
        raise InputError(f"--seconds {seconds:g}: it must be more than 0 and at most 3600")
    if video.suffix.lower() not in SUFFIXES:
        raise InputError(f"--video '{video}': name a new file that ends in {', '.join(SUFFIXES)}")
    if video.exists():
        raise InputError(f"--video '{video}' exists: choose a new file")
    if path not in PATHS and not Path(path).is_file():
        raise InputError(f"--path '{path}': it must be orbit, views, or a file of cameras")
    if not video.parent.is_dir():
        raise InputError(f"--video '{video}': there is no folder '{video.parent}'")
    require_writable(video.parent, f"--video '{video}'")


def film_cameras(path: str, scene: Scene, seconds: float) -> Cameras:
    """The cameras of a film's frames, in the scene's frame."""
    frames = max(1, round(RATE * seconds))
    if path not in PATHS:
        return from_file(Path(path), scene.frame, frames)
    return (orbit if path == "orbit" else through_views)(scene.train.cameras, frames)


def write_film(model: SavedModel, cameras: Cameras, video: Path) -> None:
    """Render and encode a film. Nothing is left behind where this fails.

    Args:
        cameras: of the frames, all of one size; an odd side loses a pixel, which the encoder needs.
        video: a new file, whose suffix says which container.

    Raises:
        InputError: the encoder refused.
    """
    import imageio_ffmpeg

    width, height = (cameras.sizes[0] // 2 * 2).tolist()
    cameras = cameras.to(model.gaussians.device)
    # Its own suffix last, by which ffmpeg knows the container.
    temporary = video.with_name(f".{video.stem}.part{video.suffix}")
    options = {"fps": RATE, "codec": CODEC, "quality": QUALITY, "macro_block_size": 1, "ffmpeg_log_level": "error"}
    writer = imageio_ffmpeg.write_frames(str(temporary), (width, height), **options)
    try:
        writer.send(None)
        with _progress(len(cameras)) as advance:
            for frame in range(len(cameras)):
                settings = model.config.raster
                image = render_image(model.gaussians, cameras, frame, sh_degree=model.sh_degree, settings=settings)
                writer.send(np.ascontiguousarray(to_uint8(image.colors)[:height, :width]))
                advance()
        writer.close()
        temporary.replace(video)
    except OSError as error:  # of the pipe to the encoder
        raise InputError(f"--video '{video}' cannot be encoded: {' '.join(str(error).split())[:200]}") from None
    finally:
        writer.close()
        temporary.unlink(missing_ok=True)


@contextmanager
def _progress(total: int) -> Iterator:
    """Gives a function to be called after each frame: a bar on a terminal, a line for each tenth elsewhere."""
    if not sys.stderr.isatty():
        done = 0

        def tell() -> None:
            nonlocal done
            done += 1
            if done * 10 // total != (done - 1) * 10 // total:
                print(f"frame {done}/{total}", file=sys.stderr, flush=True)

        yield tell
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True)) as bar:
        task = bar.add_task("frames", total=total)
        yield lambda: bar.advance(task)
