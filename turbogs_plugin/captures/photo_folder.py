"""Folders that hold photos and nothing that says where they were taken from."""

from __future__ import annotations

import re
from pathlib import Path

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")
"""Files that are photos: what both pillow and COLMAP read."""
OTHER_SUFFIXES = (".heic", ".heif", ".webp", ".avif", ".jxl", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2")
"""Photos that at least one of them does not read."""
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".insv")
FRAMES_OF_VIDEO = "ffmpeg -i VIDEO -vf fps=2 -q:v 2 PHOTOS/%05d.jpg"
MASKS = "masks?(_images)?"
"""Names of folders of masks, in any letters; one of them is read (`mask_files.FOLDER`)."""
NO_PHOTOS = re.compile(rf"\..*|images_\d+|{MASKS}", re.IGNORECASE)
"""Folders that hold none: hidden ones, copies reduced by a factor (``images_4``), masks."""
FOLDER_DEPTH = 1
"""Photos are looked for in a folder and in the folders in it. Those of several captures beside each other lie deeper,
in the ``images`` of each."""


def find_photos(folder: Path) -> tuple[Path, list[Path]]:
    """The photos of a folder; where it has a folder ``images``, of that one.

    Returns:
        The folder that their names are relative to; the photos in the order of their names.
    """
    for place in (folder / "images", folder):
        if photos := [path for path in _files(place, FOLDER_DEPTH) if path.suffix.lower() in PHOTO_SUFFIXES]:
            break
    return place, sorted(photos, key=lambda path: path.relative_to(place).as_posix())


def unread(path: Path) -> str:
    """What to do about photos and videos that are not read: the file `path` itself, or those in a folder; empty where
    there are none."""
    files = _files(path, FOLDER_DEPTH) if path.is_dir() else [path] if path.is_file() else []
    photos = [file for file in files if file.suffix.lower() in OTHER_SUFFIXES]
    videos = [file for file in files if file.suffix.lower() in VIDEO_SUFFIXES]
    if photos:
        which = "1 file is" if len(photos) == 1 else f"{len(photos)} files are"
        return f"{which} of a kind that is not read ({photos[0].name}): convert to JPEG"
    if videos:
        return f"{videos[0].name} is a video: take photos out of it, as by  {FRAMES_OF_VIDEO}"
    return ""


def _files(folder: Path, depth: int) -> list[Path]:
    entries = sorted(folder.iterdir()) if folder.is_dir() else []
    files = [entry for entry in entries if entry.name[0] != "." and entry.is_file()]
    if depth:
        inner = [entry for entry in entries if not NO_PHOTOS.fullmatch(entry.name) and entry.is_dir()]
        files += [file for entry in inner for file in _files(entry, depth - 1)]
    return files
