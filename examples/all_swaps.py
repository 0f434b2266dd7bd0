"""Everything at once in a gsplat trainer: sparse pixels, moment-damped LM and error-driven density control."""

from __future__ import annotations

from gsplat_host import Options, command_line, report, train
from sparse_pixels import SparseForward

from turbogs_plugin.gsplat_bridge import SharedOptimizer, TurboDensityStrategy, sparse_budget
from turbogs_plugin.strategies import MomentLMOptimizer


def main(options: Options) -> None:
    """Train on as many views and pixels an iteration as `sparse_budget` has it."""
    capture = options.capture()
    budget = sparse_budget(len(capture.train))
    strategy, optimizer = options.strategy(TurboDensityStrategy), SharedOptimizer(MomentLMOptimizer())
    forward = SparseForward(capture, budget.rate, options.iterations)
    report("all swaps", train(capture, options.iterations, strategy, optimizer, forward, batch_size=budget.views))


if __name__ == "__main__":
    command_line(main)
