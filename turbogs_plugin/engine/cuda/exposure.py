"""Python functions for the kernels of exposures, the twins of `engine.reference.exposure`.

Each is enqueued on torch's current stream and does not wait.
"""

from __future__ import annotations

import torch
from torch import Tensor

from turbogs_plugin.engine.cuda import launches, library
from turbogs_plugin.engine.cuda.raster import plain_floats
from turbogs_plugin.engine.cuda.training import view_rows
from turbogs_plugin.engine.exposures import BETA1, BETA2, EPSILON, PULL, Exposures
from turbogs_plugin.types import PixelSamples


def expose_colors(exposures: Exposures, colors: Tensor, samples: PixelSamples) -> Tensor:
    """`Engine.expose`. `samples`: of at most `MAX_VIEWS` views."""
    library.require()
    colors = plain_floats(colors)
    launch = launches.ExposeColors(
        colors=colors,
        tile_ids=samples.tile_ids,
        tile_offsets=samples.tile_offsets,
        views=_rows(samples),
        grid=launches.GridOrigin(*samples.origin),
        offsets=exposures.offsets,
        exposed=torch.empty_like(colors),
    )
    library.launch(launch)
    return launch.exposed


def learn_exposures(
    exposures: Exposures,
    colors: Tensor,
    gradients: Tensor,
    samples: PixelSamples,
    rate: float,
    overflow: Tensor | None = None,
) -> Tensor:
    """`Engine.learn_exposures`, in two launches; `gradients`, where float32 and contiguous, is changed in place."""
    library.require()
    rows, grid = _rows(samples), launches.GridOrigin(*samples.origin)
    backward = launches.ExposureBackward(
        colors=plain_floats(colors),
        tile_ids=samples.tile_ids,
        tile_offsets=samples.tile_offsets,
        views=rows,
        grid=grid,
        offsets=exposures.offsets,
        gradients=plain_floats(gradients),
        sums=torch.zeros(len(samples.view_ids), 3, 4, dtype=torch.float64, device=colors.device),
    )
    library.launch(backward)
    library.launch(
        launches.ExposureStep(
            sums=backward.sums,
            views=rows,
            grid=grid,
            exposures=exposures,
            overflow=overflow,
            rate=rate,
            beta1=BETA1,
            beta2=BETA2,
            eps=EPSILON,
            pull=PULL,
        )
    )
    return backward.gradients


def _rows(samples: PixelSamples) -> list[int]:
    return view_rows([0] * len(samples.view_ids), samples.sizes.tolist(), samples.view_ids)
