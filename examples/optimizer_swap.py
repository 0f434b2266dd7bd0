"""Sparse Adam and moment-damped LM in the place of a gsplat trainer's optimizer class."""

from __future__ import annotations

import torch
import tyro
from gsplat import DefaultStrategy
from gsplat_host import demo_scene, l1_of_images_with_errors, report, train
from turbogs_plugin.strategies.optimizers.moment_lm import MomentLMOptimizer
from turbogs_plugin.strategies.optimizers.sparse_adam import SparseAdam

from turbogs_plugin.gsplat_bridge import SharedOptimizer, TurboDensityStrategy
from turbogs_plugin.scene import load_scene


def main(scene: str = "", iterations: int = 300, refine_start_iter: int = 50, refine_every: int = 50) -> None:
    """Train with torch's Adam, with sparse Adam, and with LM, which takes the errors that `info` has.

    Args:
        scene: a capture's folder; a demo capture where empty.
    """
    capture = load_scene(scene) if scene else demo_scene()
    when = {"refine_start_iter": refine_start_iter, "refine_every": refine_every}
    report("Adam", train(capture, iterations, DefaultStrategy(**when), torch.optim.Adam))
    report("SparseAdam", train(capture, iterations, DefaultStrategy(**when), SharedOptimizer(SparseAdam())))
    # TurboDensityStrategy shows `info` to the optimizers; in front of another strategy, call
    # optimizers["means"].observe(info) before the optimizers' steps.
    lm = SharedOptimizer(MomentLMOptimizer())
    report("LM", train(capture, iterations, TurboDensityStrategy(**when), lm, l1_of_images_with_errors))


if __name__ == "__main__":
    tyro.cli(main)
