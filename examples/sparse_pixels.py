"""Sparse pixels in a gsplat trainer: three edits (render call, ground truth, loss), under gsplat's DefaultStrategy."""

from __future__ import annotations

from typing import Any

import torch
from gsplat import DefaultStrategy
from gsplat_host import Batch, Options, command_line, render_arguments, report, train
from torch import Tensor

from turbogs_plugin.gsplat_bridge import gather_pixels, maps_of_photos, sparse_budget, sparse_loss, sparse_rasterization
from turbogs_plugin.scene import Scene
from turbogs_plugin.strategies import CharbonnierNccLoss, ErrorGuidedPixelSampler, Step


class SparseForward:
    """The forward part of a step on a share of the pixels, drawn by the errors of their last visits.

    Args:
        scene: its training views get error maps.
        rate: the share.
        iterations: of the run.
    """

    def __init__(self, scene: Scene, rate: float, iterations: int) -> None:
        self.rate, self.iterations = rate, iterations
        device = "cuda" if torch.cuda.is_available() else "cpu"
        trainset = [{"image": scene.train.photos.image(view)} for view in range(len(scene.train))]  # [H, W, 3], 0 .. 1
        self.maps = maps_of_photos(trainset, device, white=1.0)
        self.sampler, self.loss = ErrorGuidedPixelSampler(), CharbonnierNccLoss()

    def __call__(self, splats: torch.nn.ParameterDict, batch: Batch, step: int, **render: Any) -> tuple[Tensor, dict]:
        now = Step(step, self.iterations, self.iterations)
        samples = self.sampler.sample(self.maps, tuple(batch.image_ids), self.rate, now)
        # 1. the render call, at samples
        colors, _, info = sparse_rasterization(**render_arguments(splats, batch), samples=samples, **render)
        pixels = gather_pixels(batch.pixels, samples)  # 2. the ground truth there
        loss = sparse_loss(self.loss, colors, pixels, samples, self.maps, now)  # 3. the loss, which updates the maps
        info.update(prediction=colors, ground_truth=pixels)  # for error-driven strategies; others do not mind
        return loss, info


def main(options: Options, batch_size: int | None = None) -> None:
    """Train on a share of the pixels, as large as `sparse_budget` has it.

    Args:
        batch_size: views an iteration; None leaves it to `sparse_budget`.
    """
    capture, strategy = options.capture(), options.strategy(DefaultStrategy)
    budget = sparse_budget(len(capture.train), batch_size)
    forward = SparseForward(capture, budget.rate, options.iterations)
    result = train(capture, options.iterations, strategy, forward=forward, batch_size=budget.views)
    report(f"{budget.rate:.0%} of the pixels of {budget.views} views", result)


if __name__ == "__main__":
    command_line(main)
