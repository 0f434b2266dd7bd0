"""TurboGS in a gsplat trainer: its whole step as one object, or parts, each named in the place of gsplat's own.

- `TurboStep` draws, renders, computes the loss, updates and refines; imported when it is first used;
- `TurboDensityStrategy` for `gsplat.DefaultStrategy`;
- `SharedOptimizer` for the optimizer class, with `SparseAdam` or `MomentLMOptimizer` in it;
- `sparse_rasterization`, `gather_pixels` and `sparse_loss` for the render call, the ground truth and the loss;
  before the loop, `sparse_budget` and `maps_of_photos`.
"""

from turbogs_plugin import lazy_face
from turbogs_plugin.gsplat_bridge.density_swap import TurboDensityStrategy, apply_row_update
from turbogs_plugin.gsplat_bridge.optimizer_swap import SharedOptimizer
from turbogs_plugin.gsplat_bridge.sparse_pixels import gather_pixels, maps_of_photos, sparse_budget, sparse_loss
from turbogs_plugin.gsplat_bridge.sparse_rasterization import sparse_rasterization

__all__ = [
    "SharedOptimizer",
    "TurboDensityStrategy",
    "TurboStep",
    "apply_row_update",
    "gather_pixels",
    "maps_of_photos",
    "sparse_budget",
    "sparse_loss",
    "sparse_rasterization",
]
__getattr__, __dir__ = lazy_face(__name__, {"TurboStep": "turbogs_plugin.gsplat_bridge.turbo_step"})
