"""Models that tests of several rooms share."""

import torch

from turbogs_plugin.types import Gaussians


def random_gaussians(count: int = 40, sh_degree: int = 3, seed: int = 0, dtype=torch.float32) -> Gaussians:
    """All numbers are standard normal."""
    generator = torch.Generator().manual_seed(seed)
    bands = (sh_degree + 1) ** 2 - 1
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": (bands, 3)}
    values = {name: torch.randn(count, *shape, generator=generator, dtype=dtype) for name, shape in shapes.items()}
    return Gaussians(**values)
