"""Small cases that run every kernel, for compute-sanitizer. From the repository's root, with a GPU::

    compute-sanitizer --tool memcheck --error-exitcode 1 python tests/gpu/sanitizer_case.py
    compute-sanitizer --tool racecheck --error-exitcode 1 python tests/gpu/sanitizer_case.py

Both must end with 0 errors.
"""

import sys
import tempfile
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from helpers.framework_runs import tiny_config
from helpers.raster_cases import samples_to
from helpers.rendering_scenes import make_cameras, make_gaussians, one_tile_of_a_wide_image, stacked_splats

from turbogs_plugin.captures import load_scene, write_demo_capture
from turbogs_plugin.engine.cuda.engine import CudaEngine
from turbogs_plugin.engine.layout import ScreenRecord
from turbogs_plugin.engine.render import dense_samples, rasterize
from turbogs_plugin.engine.render_pass import ScreenRecords
from turbogs_plugin.gsplat_bridge.autograd import rasterize_differentiable
from turbogs_plugin.train.loop import TrainingLoop
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import GaussianStats

DEVICE = "cuda"

VARIANTS = (
    (),
    ("optimizer.type=sparse_adam", "pixel_sampler.importance=0.5", "loss.ncc_weight=0.4"),
    ("optimizer.rows=summed", "pixel_sampler.unit=tile", "pixel_sampler.importance=0.5", "loss.type=sparse_ssim"),
    ("train.dropout=0.3",),
)
"""Overrides that lead through the kernels' other branches."""

NINE_VIEWS = ("schedule.min_views=9", "schedule.max_views=9")
"""More rows of a Gaussian than shared memory has room for."""


def train(capture: Path, *overrides: str, iterations: int | None = None) -> Trainer:
    """The iterations of a tiny run, or the first of them."""
    overrides = (f"train.device={DEVICE}", "density.top_fraction=0.9", *overrides)
    config = tiny_config(capture, *overrides).without_plan()
    trainer = Trainer(config, load_scene(capture), torch.device(DEVICE))
    trainer.initialise_maps()
    loop = TrainingLoop(trainer)
    for iteration in range(1, (iterations or config.train.iterations) + 1):
        loop.advance(iteration)
    trainer.require_finite()
    return trainer


def many_tiles():
    """1250 tiles, all active: more than one block finds the first intersections of."""
    cameras = make_cameras([(400, 400), (400, 400)], torch.float32)
    return make_gaussians(60, dtype=torch.float32), cameras, dense_samples(cameras)


def draw(gaussians, cameras, samples) -> None:
    """A pass forward and backward, with statistics."""
    gaussians = gaussians.map(lambda value: value.to(DEVICE))
    rendered = rasterize(gaussians, cameras.to(DEVICE), samples_to(samples, DEVICE))
    stats = GaussianStats.zeros(len(gaussians), DEVICE)
    ones = torch.ones_like(rendered.colors)
    gradients = rendered.backward(ones, pixel_errors=ones[:, 0].contiguous(), with_statistics=True)
    assert gradients.parameter_gradients(rows=True, stats=stats).means.isfinite().all()


def collect() -> None:
    """Rows of records that begin within a warp, of a view that is shared and two that are not; and colours of three
    processes, one of which has none."""
    first, second, target = (
        ScreenRecords(
            torch.ones(views, count, ScreenRecord.SIZE, device=DEVICE),
            torch.arange(2 * views * count, device=DEVICE).remainder(3).int().view(views, count, 2),
            False,
        )
        for views, count in ((2, 517), (2, 517), (3, 300))
    )
    CudaEngine().collect([first, second], [0, 1], target, row=4)
    parts = list(torch.zeros(3, 4000, device=DEVICE))
    seen = torch.empty(2, dtype=torch.int32, device=DEVICE)
    assert CudaEngine(torch.device(DEVICE)).gather(parts, 64, [1300, 0, 1], seen).shape == (1301, 3)


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        nine = write_demo_capture(Path(folder, "nine"), views=11, width=48, height=40)  # every 8th is a test view
        trainer = train(nine, *NINE_VIEWS, iterations=1)
        assert len(trainer.views) == 9
        capture = write_demo_capture(Path(folder, "eight"), views=8, width=48, height=40)
        for overrides in VARIANTS:
            trainer = train(capture, *overrides)
    cameras = trainer.views.cameras.select([0, 1])
    gaussians = trainer.gaussians.map(lambda value: value.requires_grad_())
    image = rasterize_differentiable(gaussians, cameras, dense_samples(cameras), with_depth=True)
    (image.colors.sum() + image.alphas.sum() + image.depths.sum()).backward()
    assert gaussians.means.grad.isfinite().all()
    draw(*one_tile_of_a_wide_image())  # more large splats than their list has room for
    draw(*stacked_splats(torch.full((4097,), 3.0)))  # runs of equal depths to merge, and a last one of one pair
    draw(*many_tiles())
    collect()
    torch.cuda.synchronize()
    print(f"{len(gaussians)} Gaussians, {len(VARIANTS)} variants, done")


if __name__ == "__main__":
    main()
