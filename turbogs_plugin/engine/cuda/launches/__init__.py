"""The arguments of the operators of csrc/: a class for each operator, a field for each argument.

`library.launch` calls an operator with four lists: the tensors, integers, reals and rows of views of the launch. Each
list is in the order of the fields; those of a nested class stand in its place. The build writes the same order into a
C++ header (csrc/generate_headers.py). So no order is written down twice, and these files must not import torch, nor
anything of the package but each other.

Letters in shapes: K views, N Gaussians, T tiles with samples, P sample slots, M the most intersections of tiles and
splats, B harmonics above band 0, X flat pixels, V training views and C cameras. An instance is a Gaussian in a view,
its row k * N + n. All tensors are contiguous and on one CUDA device. Where a tensor may be None, a comment says when.
"""

from __future__ import annotations

from .base import LAUNCHES, Launch, annotations, nested_type
from .common import (
    NO_STATS,
    GaussianArrays,
    GridOrigin,
    SampleArrays,
    Scene,
    ScreenBackward,
    Splats,
    StatSums,
    TileLists,
)
from .optimizer import NO_COPIES, Copies, FusedStep, Moments, ProjectionBackward, Rates
from .peers import CollectRecords, GatherColors, Peers, Sources
from .raster import (
    Background,
    RasterBackward,
    RasterCountIntersections,
    RasterForward,
    RasterProject,
    RasterSortIntersections,
)
from .training import (
    NO_MAPS,
    NO_MASKS,
    NO_SCRATCH,
    CountFilled,
    ExposeColors,
    ExposureArrays,
    ExposureBackward,
    ExposureStep,
    LossSettings,
    MapArrays,
    SamplePixels,
    SparseLoss,
    TileScratch,
)

__all__ = [
    "LAUNCHES",
    "NO_COPIES",
    "NO_MAPS",
    "NO_MASKS",
    "NO_SCRATCH",
    "NO_STATS",
    "Background",
    "CollectRecords",
    "Copies",
    "CountFilled",
    "ExposeColors",
    "ExposureArrays",
    "ExposureBackward",
    "ExposureStep",
    "FusedStep",
    "GatherColors",
    "GaussianArrays",
    "GridOrigin",
    "Launch",
    "LossSettings",
    "MapArrays",
    "Moments",
    "Peers",
    "ProjectionBackward",
    "RasterBackward",
    "RasterCountIntersections",
    "RasterForward",
    "RasterProject",
    "RasterSortIntersections",
    "Rates",
    "SampleArrays",
    "SamplePixels",
    "Scene",
    "ScreenBackward",
    "Sources",
    "SparseLoss",
    "Splats",
    "StatSums",
    "TileLists",
    "TileScratch",
    "annotations",
    "nested_type",
]
