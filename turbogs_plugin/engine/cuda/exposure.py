"""Python functions for the kernels of exposures, the twins of `engine.reference.exposure`.

Each is enqueued on torch's current stream and does not wait.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.engine.cuda import launches, library
from turbogs_plugin.engine.cuda.training import view_rows
from turbogs_plugin.engine.exposures import BETA1, BETA2, EPSILON, PULL, Exposures
from turbogs_plugin.types import PixelSamples


def expose_colors(exposures: Exposures, colors: Tensor, samples: PixelSamples) -> Tensor:
    """`Engine.expose`. `samples`: of at most `MAX_VIEWS` views."""
    library.require()
    views = _exposed_views(exposures, colors, samples)
    launch = launches.ExposeColors(**vars(views), exposed=torch.empty_like(views.colors))
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
    backward = launches.ExposureBackward(
        **vars(_exposed_views(exposures, colors, samples)),
        gradients=gradients.detach().float().contiguous(),
        sums=torch.zeros(len(samples.view_ids), 3, 4, dtype=torch.float64, device=colors.device),
    )
    library.launch(backward)
    adam = {"rate": rate, "beta1": BETA1, "beta2": BETA2, "eps": EPSILON, "pull": PULL}
    library.launch(launches.ExposureStep(backward.sums, backward.views, exposures, overflow, **adam))
    return backward.gradients


def _exposed_views(exposures: Exposures, colors: Tensor, samples: PixelSamples) -> launches.ExposedViews:
    """What both launches have in common."""
    rows = view_rows(np.zeros(len(samples.view_ids), dtype=np.int64), samples.sizes, samples.view_ids)
    colors = colors.detach().float().contiguous()
    return launches.ExposedViews(colors, samples.tile_ids, samples.tile_offsets, rows, exposures.offsets)
