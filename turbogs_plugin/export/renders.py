"""Renders of a saved model: PNGs from its capture's cameras, and films by imageio-ffmpeg (`turbogs render`)."""

from __future__ import annotations

import importlib.util
import sys
import tempfile
from contextlib import closing
from pathlib import Path

import numpy as np

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.engine.render import render_image
from turbogs_plugin.errors import InputError
from turbogs_plugin.export.camera_path import LARGEST_FILM, from_file, orbit, resized, through_views
from turbogs_plugin.files import naming, new_file, require_new_file, require_writable, unused_name
from turbogs_plugin.report.evaluation import open_saved, views_of
from turbogs_plugin.report.images import depth_picture, save_image, to_uint8
from turbogs_plugin.train.look import Look
from turbogs_plugin.train.run_files import RunFolder
from turbogs_plugin.train.saved_model import given_model
from turbogs_plugin.types import Cameras, Gaussians

PATHS = {"orbit": orbit, "views": through_views}
SUFFIXES = (".mp4", ".mkv", ".mov")
CODEC, QUALITY = "libx264", 8
"""Encoder of H.264, which all of these files hold (imageio-ffmpeg would try others first), and its quality, 0 .. 10."""
INSTALL = 'pip install "imageio-ffmpeg>=0.5"'


def render_run(
    path: Path, split: str, device_name: str, with_depth: bool, given: Config | None = None, out: Path | None = None
) -> list[Path]:
    """Write the views of a split, rendered from the model of `open_saved`, as PNGs, and say what was done with the
    capture's photos: where they were undistorted, the cameras are, too.

    Args:
        with_depth: also write each view's expected depth along the camera's axis, in the capture's own units, 0 where
            nothing was hit: as ``.npy`` ([H, W] float32) and as a coloured PNG (`depth_picture`).
        out: folder for the folder of the views; None: ``renders`` of the run.

    Returns:
        The folder of the views, and with depth the folder of the depths.

    Raises:
        InputError: as of `open_saved`, or there is no folder to write to.
    """
    if out is not None:
        require_writable(out, f"--out '{out}'")
    elif given is not None:
        raise InputError(f"'{given_model(path)}' has no run's folder to render into: name one by --out FOLDER")
    model, scene = open_saved(path, device_name, given)
    views, look = views_of(model, scene, split)
    target = out or RunFolder(path).renders
    cameras = views.cameras.to(model.gaussians.device)
    folders = [target / name for name in (split, f"{split}-depth")[: 1 + with_depth]]
    for folder in folders:
        folder.mkdir(parents=True, exist_ok=True)
    for view_id, name in enumerate(distinct_stems(views.names)):
        image = render_image(model.gaussians, cameras, view_id, with_depth=with_depth, **look.options)
        save_image(folders[0] / f"{name}.png", to_uint8(look.colors(image.colors, view_id)))
        if image.depths is not None:
            depths = (image.depths.cpu().double() * model.frame.scale).float().numpy()
            with naming(folders[1] / f"{name}.npy"), new_file(folders[1] / f"{name}.npy") as file:
                np.save(file, depths)
            save_image(folders[1] / f"{name}.png", depth_picture(depths))
    print("\n".join(scene.notes), file=sys.stderr)  # last, as an error is one line alone
    return folders


def distinct_stems(names: tuple[str, ...]) -> list[str]:
    """Names of photos without folders and suffixes; a name that came before gets a number."""
    stems: dict[str, None] = {}
    for name in names:
        stems[unused_name(Path(name).with_suffix("").as_posix().replace("/", "__"), stems)] = None
    return list(stems)


def film_run(
    path: Path,
    camera_path: str,
    video: Path,
    device_name: str,
    given: Config | None = None,
    seconds: float | None = None,
    fps: float | None = None,
    size: str | None = None,
) -> Path:
    """Write a film of the model of `open_saved` into a new file, along orbit, views, or a file of cameras: 10 `seconds`
    where absent, 60 frames a second, and the `size` (``WIDTHxHEIGHT``) that the path's cameras have. Errors as of
    `open_saved`; `InputError`, too, where an option does not fit."""
    seconds, fps = 10.0 if seconds is None else seconds, 60.0 if fps is None else fps
    for name, value, most in (("seconds", seconds, 3600), ("fps", fps, 240)):
        if not 0 < value <= most:
            raise InputError(f"--{name} {value:g}: it must be more than 0 and at most {most}")
    sides = [int(side) for side in (size or "").split("x") if side.isdecimal()]
    if size is not None and (len(sides) != 2 or not all(2 <= side <= LARGEST_FILM for side in sides)):
        raise InputError(f"--size '{size}': write WIDTHxHEIGHT in pixels, as 1920x1080, at most {LARGEST_FILM}")
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        raise InputError(f"a film needs imageio-ffmpeg: {INSTALL}")
    if camera_path not in PATHS and not Path(camera_path).is_file():
        raise InputError(f"--path '{camera_path}': it must be orbit, views, or a file of cameras")
    if video.suffix.lower() not in SUFFIXES:
        raise InputError(f"--out '{video}': a film needs a new file that ends in {', '.join(SUFFIXES)}")
    require_new_file(video, "--out")
    require_writable(video.parent, f"--out '{video}'")
    model, scene = open_saved(path, device_name, given)
    frames = max(1, round(fps * seconds))
    along = PATHS.get(camera_path)
    cameras = along(scene.train.cameras, frames) if along else from_file(Path(camera_path), scene, frames)
    cameras = resized(cameras, *sides) if sides else cameras
    write_film(model.gaussians, model.own_look(scene.train), cameras, video, fps)
    return video


def write_film(gaussians: Gaussians, look: Look, cameras: Cameras, video: Path, fps: float) -> None:
    """Render a model, as it looks, and encode a film. Nothing is left behind where this fails: by `InputError`, where
    the encoder refuses.

    Args:
        cameras: of the frames, all of one size; an odd side loses a pixel, which the encoder needs.
        video: a new file, whose suffix says which container.
    """
    import imageio_ffmpeg

    width, height = (cameras.sizes[0] // 2 * 2).tolist()
    cameras = cameras.to(gaussians.device)
    options = {"fps": fps, "codec": CODEC, "quality": QUALITY, "macro_block_size": 1, "ffmpeg_log_level": "error"}
    with tempfile.TemporaryDirectory(dir=video.parent, prefix=".") as hidden:
        temporary = Path(hidden) / video.name  # ffmpeg knows the container by the suffix
        try:
            with closing(imageio_ffmpeg.write_frames(str(temporary), (width, height), **options)) as writer:
                writer.send(None)
                for frame in range(len(cameras)):
                    image = render_image(gaussians, cameras, frame, **look.options)
                    writer.send(np.ascontiguousarray(to_uint8(image.colors)[:height, :width]))
            if (found := imageio_ffmpeg.count_frames_and_secs(str(temporary))[0]) != len(cameras):
                raise OSError(f"{found} of {len(cameras)} frames are in it")  # the encoder's end says nothing
            temporary.replace(video)
        except (OSError, RuntimeError) as error:  # of the pipe to the encoder, and of what it wrote
            reason = f"{error}.".splitlines()[0].rstrip(".: ")  # without ffmpeg's command and version
            raise InputError(f"--out '{video}' cannot be encoded ({reason}): is its disk full?") from None
