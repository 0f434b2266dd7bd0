"""Photo files: their sizes, and their pixels as training wants them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import torch
from PIL import ExifTags, Image, UnidentifiedImageError

from turbogs_plugin.captures.undistort import Lens
from turbogs_plugin.device import processor_cores
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.host_arrays import host_array
from turbogs_plugin.scene.photos import Photos, pixel_offsets

SMALLEST_SIDE = 4  # the shorter side of a reduced photo has at least this many pixels; of fewer, nothing is left to see
OPAQUE_SUFFIXES = (".jpg", ".jpeg")  # suffixes of formats without alpha, whose headers need not be read again
CONVERT = "convert it to JPEG"
KINDS = (
    (rb".{4}ftyp(hei|hev|mif1|msf1)", "HEIC", CONVERT),
    (rb"\x76\x2f\x31\x01", "OpenEXR", CONVERT),
    (rb"FUJIFILM|II[*RU]\0|MM\0[*]|IIRO|.{4}ftypcrx|\0MRM", "a camera's raw data", CONVERT),
    (rb"RIFF.{4}WEBP|.{4}ftypavi|\xff\x0a|.{4}JXL |GIF8|8BPS|%(!PS|PDF)|\s*<(svg|[?]xml)", "of another kind", CONVERT),
    (rb".{4}ftyp|\x1aE\xdf\xa3|RIFF.{4}AVI", "a video", "take photos out of it"),
    (rb"version https://git-lfs", "a pointer of Git LFS", "fetch it by 'git lfs pull'"),
    (rb"(/|[.]git/)annex/", "a pointer of git-annex", "fetch it by 'git annex get'"),
    (rb"\s*<(!doctype|html|head)", "a web page", "download it again"),
    (rb"PK\x03\x04|\x1f\x8b|7z\xbc\xaf|Rar!", "an archive", "unpack it"),
)
"""What files under the names of photos may be that Pillow does not read: their first bytes, and what to do."""
FORMATS = ("JPEG", "PNG", "TIFF", "BMP")
"""Formats of images, told by content. Pillow would try dozens, PostScript among them, for which it starts a program."""
OTHER_FORMATS = {".webp": "WEBP", ".avif": "AVIF", ".jp2": "JPEG2000"}  # suffix -> format that it may have
PIXELS_A_BYTE, ALWAYS_PIXELS = 96, 1 << 25
"""Most pixels of an image for each byte of its file, and pixels that any file may have: files of a few kilobytes can
unpack to gigabytes. A photo has 1 to 20 pixels a byte, an even grey one of JPEG 64."""
MOST_SCANS = 200  # of a progressive JPEG, each of which goes over all pixels; programs write about ten
MOST_THREADS = 16  # photos that are decoded at a time; undistorted and reduced, each takes up to 24 bytes a pixel


def reduced_sizes(sizes: np.ndarray, factor: float) -> np.ndarray:
    """[V, 2] int64: sizes over `factor`, to the nearest pixel. Raises `InputError` for sides below `SMALLEST_SIDE`."""
    reduced = np.floor(sizes / factor + 0.5).astype(np.int64)
    if factor > 1 and reduced.min() < SMALLEST_SIDE:
        width, height = sizes[sizes.min(axis=1).argmin()].tolist()
        largest = max(1, int(min(width, height) / (SMALLEST_SIDE - 0.5)))
        remedy = f"the largest that keeps {SMALLEST_SIDE} pixels a side is {largest}"
        raise InputError(f"--factor {factor:g} leaves too little of photos of {width}x{height}: {remedy}")
    return reduced


def photo_size(path: Path) -> tuple[int, int]:
    """(width, height) from the file's header alone; `InputError` where it cannot be read, or has more than 8 bits."""
    with opened_image(path) as image:
        require_8_bits(image, path)
        return image.size


def require_8_bits(image: Image.Image, path: Path) -> None:
    if image.mode.startswith(("I", "F")):
        raise InputError(f"photo {path} has more than 8 bits a channel: convert it to 8-bit RGB")


def is_transparent(path: Path) -> bool:
    """True where a photo may have pixels that are not opaque, by its header."""
    if path.suffix.lower() in OPAQUE_SUFFIXES:
        return False
    with opened_image(path) as image:
        return "A" in image.getbands() or "transparency" in image.info


def photo_sizes(paths: Sequence[Path]) -> np.ndarray:
    """[V, 2] int64 (width, height), from the headers; `InputError` names the first file that cannot be read."""
    with decoding_threads() as pool:
        return np.array(list(pool.map(photo_size, paths)), dtype=np.int64).reshape(-1, 2)


def load_photos(
    paths: Sequence[Path],
    targets: np.ndarray,
    lenses: Sequence[Lens | None],
    channels: int = 3,
    progress: Callable[[int, int], object] | None = None,
    meanwhile: Callable[[], object] = lambda: None,
) -> Photos:
    """Decode V photos in parallel, undistorted, then reduced to their target sizes by area averaging. They are taken as
    stored: an orientation in EXIF is ignored, as COLMAP does.

    Args:
        targets: [V, 2] int64 (width, height) to give them.
        channels: 3, where photos that are transparent lose their alpha and keep their colours as stored; or 4, where
            3 are kept after all if every pixel is opaque.
        progress: called with the number of photos decoded so far, and of all.
        meanwhile: called while threads decode.

    Raises:
        InputError: a photo that cannot be decoded, the first one in order; more photos than fit in memory or on disk.
    """
    # Pillow's mode with an a has colours that are multiplied by alpha.
    offsets, mode = pixel_offsets(targets), "RGBa" if channels == 4 else "RGB"
    room = partial(host_array, dtype=torch.uint8, what=f"{len(targets)} photos")
    colors = room((int(offsets[-1]), channels))
    pixels = colors.numpy()

    def load(view: int) -> bool:
        """Decode a photo; True where it is opaque."""
        target, lens = tuple(targets[view].tolist()), lenses[view]
        with opened_image(paths[view]) as image:
            image.load()
            whole = image.convert("RGBA") if channels == 4 or image.mode == "P" else image
            photo = whole if whole.mode == mode else whole.convert(mode)  # which copies where nothing is to be done
        if lens is not None:
            photo = lens.undistort(photo)
        if photo.size != target:
            photo = photo.resize(target, Image.Resampling.BOX)
        pixels[offsets[view] : offsets[view + 1]] = (values := np.asarray(photo)).reshape(-1, channels)
        return channels == 3 or bool((values[..., 3] == 255).all())

    opaque = True
    with decoding_threads() as pool:
        decoded = pool.map(load, range(len(paths)))
        meanwhile()
        # The first error in order is raised, and ends what was not begun.
        for count, own in enumerate(decoded, start=1):
            opaque &= own
            if progress is not None:
                progress(count, len(paths))
    if opaque and channels == 4:
        colors = room((len(colors), 3)).copy_(colors[:, :3])
    return Photos(colors, targets)


def decoding_threads() -> ThreadPoolExecutor:
    """Threads to decode photos: one a processor of this process, at most `MOST_THREADS`."""
    return ThreadPoolExecutor(max(1, min(MOST_THREADS, processor_cores())))


@contextmanager
def opened_image(
    path: Path, what: str = "photo", remedy: str = "copy it there again", pixels: int = ALWAYS_PIXELS
) -> Iterator[Image.Image]:
    """The file with its header read, as stored; `InputError` for whatever goes wrong with it while entered, for more
    pixels than its bytes may have (`pixels` are allowed whatever they are), and for a TIFF that Pillow would turn, as
    it turns no other kind: cameras are by the pixels as they are stored."""
    other = OTHER_FORMATS.get(path.suffix.lower())
    try:
        with Image.open(path, formats=(*FORMATS, other) if other else FORMATS) as image:
            stored = path.stat().st_size
            if image.width * image.height > max(pixels, PIXELS_A_BYTE * stored):
                size = f"{image.width}x{image.height} pixels in {stored} bytes"
                raise InputError(f"{what} {path} has {size}, which no {what} has: replace it or take it out")
            if image.info.get("progressive") and path.read_bytes().count(b"\xff\xda") > MOST_SCANS:
                raise InputError(f"{what} {path} is a JPEG of more than {MOST_SCANS} scans: save it again")
            if image.format == "TIFF" and image.getexif().get(ExifTags.Base.Orientation, 1) != 1:
                upright = "take that out, or save it upright before cameras are found"
                raise InputError(f"{what} {path} is a TIFF with an orientation in its EXIF data: {upright}")
            yield image
    except InputError:
        raise
    except Exception as error:  # a broken file can raise anything in its decoder
        reason = " ".join((getattr(error, "strerror", None) or str(error) or type(error).__name__).split())
        if isinstance(error, UnidentifiedImageError):
            with path.open("rb") as file:
                start = file.read(64)
            known = (said for form, *said in KINDS if re.match(form, start, re.DOTALL | re.IGNORECASE))
            kind, remedy = next(known, ["no image of a known kind", remedy])
            reason = f"it is {kind}" if start else "the file is empty"
        raise InputError(f"cannot read the {what} {path}: {reason}; {remedy}") from error
