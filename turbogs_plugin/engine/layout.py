"""Sizes and layouts that Python and the kernels of csrc/ share, defined here and nowhere else. Constants of a formula
stand beside it, in engine/reference and in the kernel.

The build makes a C++ header from this file (csrc/generate_headers.py), so it must not import torch. In C++ a number
``NAME`` is ``kName``, a class is a struct of such constants, and a slice of columns is the number of its first column.
"""

MAX_VIEWS = 128
"""Views of one batch: their image sizes travel as an argument of the kernels."""

MAX_SH_DEGREE = 3
"""Highest degree of the spherical harmonics that the engines evaluate."""

WARP_SIZE = 32
"""Lanes of a warp. A chunk, the sample slots of a tile that a warp renders together, has the same size."""

BUCKET = 32
"""Splats that a warp stages at once. Each has a bit of a 32-bit mask."""

INTERSECTIONS_MAX = (1 << 31) - 1
"""The count of a pass's intersections of tiles and splats saturates here."""

SCAN_TILES = 1024
"""Tiles of one block of the kernels that find each tile's first intersection."""

SORT_RUN = 512
"""Intersections of a tile that one warp sorts. A tile with more is sorted in runs of this length, which are merged."""

SAMPLE_UNITS = ("pixel", "tile")
"""Units of a draw: pixels, or whole tiles of 16x16. The kernels number them in this order."""

STRUCTURES = ("none", "ncc", "ssim", "printed_ncc")
"""Similarities of a tile's samples that a loss may use beside its l1 term. The kernels number them in this order."""

WINDOW_RADIUS = 5
"""Pixels from the middle of a window of SSIM to its edge, along each axis."""

UPDATE_KINDS = ("adam", "moment_lm", "unscaled_lm")
"""Kinds of a step of the parameters. The kernels number them in this order."""

MAX_PEERS = 8
"""Processes, of one host, that use each other's memory in place."""


class PassStatus:
    """Report of a process on a pass: int32."""

    INTERSECTIONS = 0  # of tiles and splats
    OVERFLOW = 1  # not 0: there was too little memory, and the pass draws nothing
    STOP = 2  # number of the signal by which the process wants all to stop; 0: none
    SIZE = 3


class ScreenRecord:
    """Gradients and sums of one Gaussian in one view: a row of float32.

    w is the weight of a sample (transmittance times alpha), e its error, D its distance from the mean in standard
    deviations (Mahalanobis). Sums run over the samples. `ABSOLUTE`, `DISTANCE_SUM` and `SQUARE_SUM` are for density
    control alone: the kernels leave them zero where it does not ask for them. Without the pixels' errors, they leave
    `ERROR_SUM` and `DISTANCE_SUM` zero.
    """

    MEAN = slice(0, 2)  # d loss / d projected mean, in pixels
    CONIC = slice(2, 5)  # d loss / d (a, b, c) of the inverse covariance; b counts for both off-diagonal entries
    COLOR = slice(5, 8)  # d loss / d color, after the clamp at 0
    OPACITY = 8  # d loss / d opacity, after the sigmoid
    ABSOLUTE = slice(9, 11)  # sums of the absolute values of each sample's d loss / d mean (AbsGS)
    ERROR_SUM = 11  # sum of e * w
    DISTANCE_SUM = 12  # sum of D * w
    WEIGHT_SUM = 13  # sum of w
    DEPTH = 14  # d loss / d depth
    SQUARE_SUM = 15  # sum of the squares of each sample's o * d loss / d o, o the opacity
    SIZE = 16


class ParameterRow:
    """Gradients or moments of the parameters of one Gaussian, without the higher bands: a row of float32.

    Moment-damped LM solves two blocks of it: the geometry, up to the quaternions, and the appearance.
    """

    MEANS = slice(0, 3)
    SCALES = slice(3, 6)
    QUATS = slice(6, 10)
    SH0 = slice(10, 13)
    OPACITIES = slice(13, 14)
    SIZE = 14


class InstanceRow:
    """A splat on the screen, one Gaussian in one view: a row of float32. `Instance` in csrc/raster/raster_params.h."""

    MEAN = slice(0, 2)  # pixels
    CONIC = slice(2, 5)
    OPACITY = 5  # after the sigmoid
    DEPTH = 6
    LOG_REACH = 7  # log(opacity / alpha_min)
    COLOR = slice(8, 11)  # after the clamp at 0
    INVERSE_SIGMA_Y = 11  # 1 / standard deviation along y
    SIZE = 12


class CameraRow:
    """A view inside the raster kernels: a row of 4-byte numbers that only they read."""

    SIZE = 32


class ImageRow:
    """A view of a batch, as input of the rasterizer: a row of integers."""

    WIDTH = 0
    HEIGHT = 1
    CAMERA = 2  # row of its camera, among those that the launch is given
    SIZE = 3


class ViewRow:
    """A view of a batch, as input of the loss: a row of integers."""

    FIRST_PIXEL = 0  # of the view, among the flat pixels of all training views
    WIDTH = 1
    HEIGHT = 2
    NUMBER = 3  # of the training view
    SIZE = 4


class DrawRow(ViewRow):
    """A view of a batch, as input of the sampler: a row of integers, `ViewRow` first."""

    FIRST_SLOT = 4  # for unit = tile the first chosen tile
    STAGES = slice(5, 8)  # units of the hard, the stable and the mixed stage: of a tile, or for unit = tile of the view
    FIRST_LIVE = 8  # with masks: of the view, among the live tiles of all training views
    LIVE = 9  # tiles to draw from: with masks the live ones of the view, else all
    SIZE = 10


def columns(row: type) -> dict[str, slice]:
    """Name of each column in lower case -> where it lies; the columns of a base class come first."""
    found = {}
    for base in reversed(row.__mro__):
        for name, place in vars(base).items():
            if name.isupper() and name != "SIZE":
                found[name.lower()] = place if isinstance(place, slice) else slice(place, place + 1)
    return found


def interface(launches: list) -> str:
    """Order of the fields of `launches` (classes of `Launch`) and the numbers of this file, as text, which differs for
    a library from other sources."""
    lines = [f"{cls.operator}: " + "; ".join(" ".join(names) for names in cls.paths) for cls in launches]
    for name, value in globals().items():
        if isinstance(value, type):
            places = (f"{column} {place.start}:{place.stop}" for column, place in columns(value).items())
            value = f"{', '.join(places)} of {vars(value)['SIZE']}"
        if name[0].isupper():
            lines.append(f"{name}: {value}")
    return "\n".join(lines)
