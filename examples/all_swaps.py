"""Everything at once in a gsplat trainer: sparse pixels, moment-damped LM and error-driven density control."""

from __future__ import annotations

import tyro
from gsplat_host import demo_scene, report, train
from sparse_pixels import SparseForward
from turbogs_plugin.strategies.optimizers.moment_lm import MomentLMOptimizer

from turbogs_plugin.gsplat_bridge import SharedOptimizer, TurboDensityStrategy
from turbogs_plugin.scene import load_scene


def main(
    scene: str = "", iterations: int = 300, rate: float = 0.25, refine_start_iter: int = 50, refine_every: int = 50
) -> None:
    """Train on a share of the pixels of four views an iteration.

    Args:
        scene: a capture's folder; a demo capture where empty.
        rate: share of the pixels.
    """
    capture = load_scene(scene) if scene else demo_scene()
    result = train(
        capture,
        iterations,
        TurboDensityStrategy(refine_start_iter=refine_start_iter, refine_every=refine_every),
        SharedOptimizer(MomentLMOptimizer()),
        SparseForward(capture, rate, iterations),
        batch_size=4,
    )
    report("all swaps", result)


if __name__ == "__main__":
    tyro.cli(main)
