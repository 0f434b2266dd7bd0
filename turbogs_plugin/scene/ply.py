"""Reads the vertices of a .ply file: plain numbers, binary little-endian or ASCII."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from turbogs_plugin.errors import InputError

LONGEST_HEADER = 1 << 16
C_TYPES = ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")
NUMPY_TYPES = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64")
TYPES = dict(zip(C_TYPES + NUMPY_TYPES, 2 * NUMPY_TYPES, strict=True))
"""The numpy types of the names that a header may have for them."""


def read_vertices(path: str | Path) -> np.ndarray:
    """[N] structured array of the ``vertex`` element, a field a property, in the file's order and types.

    Nothing is allocated before the file is known to be long enough for what its header announces.

    Raises:
        InputError: no such file, not a .ply, a header or a body that is not as announced, properties of varying
            length ("list").
    """
    path = Path(path)
    header, offset = read_header(path)
    binary, count, layout, alone = _parse_header(path, header)
    body = path.stat().st_size - offset
    # In ASCII a number takes a digit and a separator, though the last separator may be missing.
    wanted = count * (layout.itemsize if binary else 2 * len(layout)) - (not binary)
    if body < wanted or (binary and alone and body > wanted):
        raise InputError(
            f"{path} announces {count} vertices, which its {body} bytes after the header do not match: it is cut short "
            "or damaged; copy it again"
        )
    if binary:
        return np.fromfile(path, dtype=layout, count=count, offset=offset)
    return _read_ascii(path, offset, count, layout)


def read_header(path: Path) -> tuple[list[str], int]:
    """The lines of a .ply's header but for the first and the last, and the byte at which its body begins.

    Raises:
        InputError: no such file, or not a .ply.
    """
    try:
        with path.open("rb") as file:
            head = file.read(LONGEST_HEADER)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
    header, separator, _ = head.partition(b"end_header\n")
    if not separator:
        header, separator, _ = head.partition(b"end_header\r\n")
    if not head.startswith(b"ply") or not separator:
        raise InputError(f"{path} is not a .ply file: it has no header; copy or export it again")
    # Comments may be in any encoding: this one takes all bytes.
    return [line.decode("latin-1") for line in header.splitlines()[1:]], len(header) + len(separator)


def read_colors(path: Path, vertices: np.ndarray) -> np.ndarray | None:
    """[N, 3] uint8 red, green and blue of what `read_vertices` gave; None where there are none.

    Numbers of 8 bits are taken as they are. The type of others does not say what white is. Of whole numbers it is
    65535 where one is above 255. Of floats it is 1, unless their mean is above that: a few may be a bit above white.
    Otherwise it is 255.

    Raises:
        InputError: colours that are not finite.
    """
    channels = ("red", "green", "blue")
    if not set(channels) <= set(vertices.dtype.names):
        return None
    given = np.stack([vertices[channel] for channel in channels], axis=1)
    if given.dtype.itemsize == 1 or not len(given):
        return given.astype(np.uint8)
    values = given.astype(np.float64)
    bad = ~np.isfinite(values).all(axis=1)
    if bad.any():
        raise InputError(f"{path}: the colours of {bad.sum()} of {len(bad)} points are not finite: export it again")
    if np.issubdtype(given.dtype, np.floating):
        white = 1.0 if values.mean() <= 1.0 else 255.0
    else:
        white = 65535.0 if values.max() > 255.0 else 255.0
    return np.rint((values / white * 255.0).clip(0.0, 255.0)).astype(np.uint8)


def _parse_header(path: Path, lines: list[str]) -> tuple[bool, int, np.dtype, bool]:
    """Whether the body is binary, the number of vertices, their layout, and whether nothing follows them."""

    def fail(line: str, trouble: str, remedy: str = "export it again") -> InputError:
        return InputError(f"{path}: the line '{line[:80]}' of its header {trouble}; {remedy}")

    formats = {"binary_little_endian": True, "ascii": False}
    binary: bool | None = None
    elements: list[str] = []
    count, properties = 0, {}
    for line in lines:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) == 3 and binary is None:
            if words[1] not in formats:
                raise fail(line, "names a format that is not read here: binary_little_endian and ascii are")
            binary = formats[words[1]]
        elif words[0] == "element" and len(words) == 3 and words[2].isdecimal() and len(words[2]) <= 20:
            elements.append(words[1])
            if elements == ["vertex"]:
                count = int(words[2])
            elif elements == ["chunk"]:
                compressed = "is that of SuperSplat's compressed .ply, not read here"
                raise fail(line, compressed, "give the .ply that it was made of")
            elif len(elements) == 1:
                raise fail(line, "comes before the vertices: they must be the first element")
        elif words[0] == "property" and elements:
            if len(elements) > 1:
                continue
            if len(words) != 3 or words[1] not in TYPES:
                raise fail(line, "is not a property that is a single number")
            if words[2] in properties:
                raise fail(line, "names a property for the second time")
            properties[words[2]] = TYPES[words[1]]
        else:
            raise fail(line, "is not understood")
    if binary is None or not properties:
        raise InputError(
            f"{path}: its header has no {'format' if binary is None else 'vertex properties'}; export it again"
        )
    return binary, count, np.dtype(list(properties.items())).newbyteorder("<"), len(elements) == 1


def _read_ascii(path: Path, offset: int, count: int, layout: np.dtype) -> np.ndarray:
    vertices = np.empty(count, dtype=layout)
    with path.open("rb") as file:
        file.seek(offset)
        for row in range(count):
            words = file.readline(64 * len(layout)).split()
            try:
                vertices[row] = tuple(float(word) for word in words)
            except (ValueError, OverflowError) as error:
                raise InputError(
                    f"{path}: vertex {row} is not {len(layout)} numbers in their types' ranges; export it again"
                ) from error
    return vertices
