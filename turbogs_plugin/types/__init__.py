"""The data that the parts of TurboGS pass on: small dataclasses of tensors.

Every shape is written with these letters:

- ``V`` training views, ``K`` views of one iteration (a batch; ``k`` is the position in the batch);
- ``N`` Gaussians;
- ``P`` sample slots, ordered by (view of the batch, tile), ``T`` tiles that hold samples;
- ``X`` pixels of all training views laid end to end ("flat pixels").

`turbogs_plugin.types` imports nothing of the project but `errors` and `device`, so strategies and framework can both
import it.
"""

from turbogs_plugin.types.cameras import BLACK, WHITE, Cameras, Color
from turbogs_plugin.types.gaussians import (
    PARAMETER_NAMES,
    SH_C0,
    GaussianGradients,
    Gaussians,
    GaussianStats,
    RowUpdate,
)
from turbogs_plugin.types.samples import TILE_SIZE, LossOutput, PixelSamples, TileGrid, sample_order
from turbogs_plugin.types.step import SamplingBudget, Step
