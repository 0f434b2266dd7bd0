"""A small case that runs every kernel once, for compute-sanitizer. From the repository's root, with a GPU::

    compute-sanitizer --tool memcheck --error-exitcode 1 python tests/gpu/sanitizer_case.py
    compute-sanitizer --tool racecheck --error-exitcode 1 python tests/gpu/sanitizer_case.py

Both must end with 0 errors.
"""

import sys
import tempfile
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from framework_runs import tiny_capture, tiny_config

from turbogs_plugin.rendering import dense_samples, rasterize_differentiable
from turbogs_plugin.scene import load_scene
from turbogs_plugin.trainer import Trainer

VARIANTS = (
    (),
    ("optimizer.type=sparse_adam", "pixel_sampler.unit=cell", "loss.ncc_weight=1.0"),
    ("optimizer.rows=summed", "pixel_sampler.unit=tile", "pixel_sampler.importance=0.5"),
)
"""Overrides that lead through the kernels' other branches."""


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        capture = tiny_capture(Path(folder))
        for overrides in VARIANTS:
            config = tiny_config(capture, "train.device=cuda", *overrides)
            trainer = Trainer(config, load_scene(capture), torch.device("cuda"))
            trainer.initialise_maps()
            for iteration in range(1, config.train.iterations + 1):
                trainer.step_towards(iteration)
            trainer.require_finite()
    cameras = trainer.views.cameras.select([0, 1])
    gaussians = trainer.gaussians.map(lambda value: value.requires_grad_())
    image = rasterize_differentiable(gaussians, cameras, dense_samples(cameras), with_depth=True)
    (image.colors.sum() + image.alphas.sum() + image.depths.sum()).backward()
    assert gaussians.means.grad.isfinite().all()
    torch.cuda.synchronize()
    print(f"{len(gaussians)} Gaussians, {len(VARIANTS)} variants, done")


if __name__ == "__main__":
    main()
