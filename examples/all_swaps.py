"""Everything at once in a gsplat trainer: sparse pixels, moment-damped LM and error-driven density control."""

from __future__ import annotations

from gsplat_host import Options, command_line, report, train
from sparse_pixels import SparseForward
from turbogs_plugin.strategies.optimizers.moment_lm import MomentLMOptimizer

from turbogs_plugin.gsplat_bridge import SharedOptimizer, TurboDensityStrategy


def main(options: Options, rate: float = 0.25) -> None:
    """Train on a share of the pixels of four views an iteration.

    Args:
        rate: share of the pixels.
    """
    capture = options.capture()
    strategy, optimizer = options.strategy(TurboDensityStrategy), SharedOptimizer(MomentLMOptimizer())
    forward = SparseForward(capture, rate, options.iterations)
    report("all swaps", train(capture, options.iterations, strategy, optimizer, forward, batch_size=4))


if __name__ == "__main__":
    command_line(main)
